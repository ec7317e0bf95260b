"""``tpgmm report``: a page about a model."""

import html
import re

import pytest

from tests.support import skills, soft_drives
from tests.support.command_line import output, refusal
from tpgmm_datasets import save_lerobot
from tpgmm_tools.report import leave_one_out, write_report
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.metrics import pose_errors
from tpgmm_torch.persistence import save


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """Make a folder with a model and what it was learned from."""
    folder = tmp_path_factory.mktemp("report")
    shown = skills.generator().demonstrations(4)
    model = skills.small_bottle()
    save(model, folder / "model")
    save_lerobot(shown, folder / "dataset", fps=20, task="shake")
    return folder, model, shown


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_errors_are_those_of_models_that_were_learned_without(example):
    _, model, shown = example
    found = leave_one_out(model, shown, most=3)
    assert [one.index for one in found] == [0, 2, 3]
    one = found[1]
    alone = TaskParameterizedGMM(**model.get_params(deep=False))
    alone.fit([shown[0], shown[1], shown[3]])
    [trajectory] = alone.predict([skills.Situation.of(shown[2], shown[2].time)])
    error = pose_errors(trajectory, shown[2], alone.kinematics_, "l_hand", "grasp")
    wanted = float(error.position), float(error.angle)
    assert one.errors["l_hand", "grasp"] == pytest.approx(wanted, rel=1e-6, abs=1e-9)
    assert one.novelty == pytest.approx(float(trajectory.novelty))


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_the_page_has_errors_candidates_limits_and_the_motion(example):
    folder, model, _ = example
    arguments = "--dataset", folder / "dataset", "--alignment", "none"
    text = output("report", folder / "model", *arguments)
    page = (folder / "model.html").read_text(encoding="utf-8")
    assert text.endswith(f"in {folder / 'model.html'}\n")
    assert re.findall("<h2>(.*?)</h2>", page) == [
        "At a glance", "What was understood", "The motion", "How exact it is",
        "Who decides, and when", "Joints and their limits", "Each demonstration",
        "Where it fails", "How it was learned",
    ]  # fmt: skip
    assert "Events: none." in page and "<td>l_hand<td>grasp<td>" in page
    robot = model.kinematics_
    for name, speed in zip(robot.joint_names, robot.velocity, strict=True):
        assert re.search(f"<td>{name}<td>rad<td>.*?<td>{float(speed):.2f}<td>", page)
    motion = html.unescape(re.search('srcdoc="(.*?)"', page, re.DOTALL)[1])
    assert "requestAnimationFrame(follow)" in motion and "<title>" in motion
    assert "://" not in re.sub('srcdoc=".*?"', "", page, flags=re.DOTALL)


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_obstacles_are_drawn_and_what_touches_them_is_listed(example, tmp_path):
    folder, _, shown = example
    x, y, z = shown[0].frames["bottle"].position.tolist()
    file = tmp_path / "scene.xml"
    file.write_text(
        '<mujoco><worldbody><geom name="far" size="0.1" pos="3 0 0"/><geom name="post" '
        f'type="cylinder" size="0.05 0.3" pos="{x} {y} {z}"/></worldbody></mujoco>'
    )
    common = "--dataset", folder / "dataset", "--alignment", "none", "--most", 3
    out = tmp_path / "page.html"
    around = "--obstacles", file, "--visuals"
    output("report", folder / "model", *common, *around, "--out", out)
    page = out.read_text(encoding="utf-8")
    touched = re.findall(r"<td>(\d)<td>(\w+)<td>(\w+)<td>([\d.]+) to ([\d.]+)<td>(\d+)", page)
    assert ("0", "r_hand", "post") in {row[:3] for row in touched}
    assert {row[2] for row in touched} == {"post"}
    assert f"Something touches in {len({row[0] for row in touched})} of 4 motions." in page


def test_joints_alone_have_no_limits_and_no_picture(tmp_path):
    shown = skills.waves()
    write_report(tmp_path / "page.html", skills.canonical().fit(shown), shown, most=3)
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "Limits of the joints are not known" in page and "nan" not in page
    assert "comes near" not in page and "<iframe" not in page and "<img" in page


def test_what_servos_need_is_told_beside_the_joints(tmp_path):
    shown = soft_drives.demonstrations(sag=0.06)
    model = skills.canonical(reg_covar=1e-5).fit(shown)
    write_report(tmp_path / "page.html", model, shown, most=3)
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert f"<p>Servos: {soft_drives.NAMES[1]} sags 0.06 rad.</p>" in page


def test_what_cannot_be_left_out_is_an_error(example, tmp_path):
    folder, _, shown = example
    save_lerobot(shown[:2], tmp_path / "two", fps=20, task="shake")
    for data, options, said in (
        (tmp_path / "two", ("--alignment", "none"), "takes 3 demonstrations, there are 2"),
        (folder / "dataset", ("--situation", 7), "there are 4 situations"),
    ):
        assert said in refusal("report", folder / "model", "--dataset", data, *options)

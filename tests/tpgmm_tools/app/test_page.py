"""The page: what its buttons answer, and the whole of it, served."""

import html
import re
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support import browser
from tests.support.command_line import UPPER_BODY, refusal, serve
from tests.support.worlds import upper_body
from tpgmm_control.loop.rollout import rollout
from tpgmm_datasets import save_lerobot
from tpgmm_datasets.tables import demonstrations_to_frame, read_table, write_table
from tpgmm_tools.app import page
from tpgmm_torch import Frame, Situation, quaternions
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.persistence import load_model

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def table(tmp_path_factory, bottles):
    path = tmp_path_factory.mktemp("tables") / "shake.csv"
    write_table(demonstrations_to_frame(bottles), path)
    return str(path)


def learn(shown, n_components=4):
    given = {"mine": lambda: (shown, upper_body())}
    return page.learn("mine", None, "none", None, "", "", n_components, given)


def test_a_table_becomes_a_moving_picture_and_files(table, tmp_path):
    given = page.UPLOADED, [table], "upper_body", None, "l_hand, r_hand", "", 6
    skill, report = page.learn(*given)
    assert report.startswith("Learned 2 demonstrations")
    assert "- `pose:l_hand@bottle + " in report and "- `canonical`" in report
    [place] = page.places_of(skill, 2)
    situation = skill.situation(2)
    expected = situation.frames["bottle"].position.tolist()
    assert place == ["bottle", *(round(value, 4) for value in expected), 0.0]
    picture, report, files = page.show(skill, 2, [place])
    model, motion, written = map(Path, files)
    inside = html.unescape(re.fullmatch(r'<iframe .* srcdoc="([^"]*)"></iframe>', picture)[1])
    assert inside == written.read_text("utf-8")
    assert "s of motion" in report and "times as far" in report
    with zipfile.ZipFile(model) as archive:
        archive.extractall(tmp_path)
    again = load_model(tmp_path / "model")
    there = page.move_objects(situation, [place])
    [same] = rollout(again.skill, [there], bounds="robot", blend=1.0)
    columns = read_table(motion)[list(same.joint_names)]
    np.testing.assert_allclose(columns, same.joints, atol=1e-9)


@pytest.mark.parametrize(
    ("files", "robot", "robot_file", "links", "complaint"),
    [
        (None, "none", None, "", "give one .zip"),
        (["t"], "none", None, "l_hand", "need --robot FILE"),
        (["t"], "upper_body", None, "l_foot", "l_foot"),
        (["t"], page.ROBOT_FILE, __file__, "l_hand", "does not work"),
        (["/nowhere/x.csv"], "none", None, "", "/nowhere/x.csv"),
    ],
)
def test_a_user_reads_what_to_mend(table, files, robot, robot_file, links, complaint):
    files = [table if file == "t" else file for file in files or ()]
    skill, report = page.learn(page.UPLOADED, files, robot, robot_file, links, "", 4)
    assert skill is None
    assert report.startswith("**It does not work like this:** ") and complaint in report


def test_without_links_or_a_skill_there_is_nothing_to_show(table):
    assert page.places_of(None, 1) == []
    assert page.show(None, 1, []) == ("", "Nothing is learned yet.", [])
    skill, _ = page.learn(page.UPLOADED, [table], "none", None, "", "", 4)
    _, report, files = page.show(skill, 1, page.places_of(skill, 1))
    assert report.startswith("**It does not work like this:** the model knows joints only")
    assert files == []


def test_what_cannot_be_is_an_error_and_what_is_unlikely_a_remark(bottles, recwarn):
    degrees = [replace(d, joints=d.joints.rad2deg()) for d in bottles]
    skill, report = learn(degrees)
    assert skill is None and "degrees" in report
    _, report = learn([*bottles, bottles[0]])
    assert "**To be looked at:**\n- " in report and "copy of" in report
    assert not len(recwarn)
    with pytest.raises(ZeroDivisionError):  # no error that a user can mend
        page.learn("mine", None, "none", None, "", "", 4, {"mine": lambda: 1 / 0})


def test_objects_are_turned_about_the_vertical_through_them():
    lying = Frame([0.1, 0.2, 0.3], quaternions.exp(torch.tensor([0.0, np.pi / 2, 0.0])))
    situation = Situation([0.0], {"cup": lying, "belt": Frame(np.zeros((5, 3)))})
    frame = page.move_objects(situation, [("cup", "0.4", 0, 1, 90)]).frames["cup"]
    np.testing.assert_allclose(frame.position, (0.4, 0, 1))
    point = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    expected = quarter @ (lying.transform(point) - lying.position).numpy()
    np.testing.assert_allclose(frame.transform(point) - frame.position, expected, atol=1e-12)
    for place in ((1, 2, 3), (1, 2, 3, None), (1, 2, 3, "a"), (1, 2, 3, np.nan)):
        with pytest.raises(DataError, match="cup: a place is x, y, z in metres and a turn"):
            page.move_objects(situation, [("cup", *place)])
    for name in ("belt", "mug"):
        with pytest.raises(UnknownNameError, match=rf"{name}.*cup"):
            page.move_objects(situation, [(name, 0, 0, 0, 0)])


@pytest.fixture(scope="module")
def url(tmp_path_factory, bottles):
    """Serve the page, in a process of its own, as gradio leaves its event loop open."""
    folder = tmp_path_factory.mktemp("served") / "mine"
    save_lerobot(bottles, folder, fps=20, task="shake")
    temporary = tmp_path_factory.mktemp("temporary")
    with serve("app", folder, *UPPER_BODY, "--port", 0, TMPDIR=str(temporary)) as url:
        yield url
    assert not [path for path in temporary.rglob("*") if path.is_file()], "the page cleans up"


def test_in_a_browser_the_robot_moves_and_nothing_is_fetched_from_elsewhere(url):
    assert "describes DATASET" in refusal("app", *UPPER_BODY)
    with browser.page(1200, 1000) as shown:
        shown.open(url)
        button = "[...document.querySelectorAll('button')].find(b => b.innerText == '{}')"
        learn, show = button.format("Learn"), button.format("Show")
        shown.wait_for(f"!!{learn}")
        shown.evaluate(f"{learn}.click()")
        shown.wait_for("document.body.innerText.includes('Learned 2 demonstrations')")
        shown.evaluate(f"{show}.click()")
        motion = "document.querySelector('iframe')?.contentDocument"
        shown.wait_for(f"!!{motion}?.querySelector('canvas')")
        shown.evaluate("document.querySelector('iframe').scrollIntoView({block: 'center'})")
        browser.draws(shown)
        assert shown.complaints == []
        local = (url, "data:", "blob:")
        assert [one for one in shown.requests if not one.startswith(local)] == []

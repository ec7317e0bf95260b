"""Looking at a motion: the page that is written, the live view, and the command."""

import json
import re
import signal
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from tests.support import skills
from tests.support.command_line import output, refusal
from tests.support.recordings import Recording
from tests.support.worlds import upper_body
from tpgmm_datasets import save_lerobot
from tpgmm_torch import Frame, Robot, Situation, quaternions
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.robots.urdf import read_urdf
from tpgmm_torch.viewing import LiveView, ellipsoids, write_motion

FPS = 2.0


@pytest.fixture(scope="module")
def bottle(tmp_path_factory):
    """The page of the paper's skill at two pictures per second, and the trajectory in it."""
    path = tmp_path_factory.mktemp("view") / "new" / "motion.html"
    demonstrations = skills.few_bottles()
    situation = Situation(demonstrations[1].joints[0], demonstrations[1].frames)
    trajectory = write_motion(
        path, skills.small_bottle(), situation, demonstrations, fps=FPS, title="<shake> & co"
    )
    return Recording(path), trajectory, path


def steps(trajectory):
    """Time steps that are shown at FPS, and their instants in the recording."""
    start, end = float(trajectory.time[0]), float(trajectory.time[-1])
    wanted = np.append(np.arange(start, end, 1 / FPS), end)
    chosen = np.unique(np.searchsorted(trajectory.time.numpy(), wanted))
    return chosen, (trajectory.time[chosen] - trajectory.time[0]).numpy()


def test_a_page_is_one_file_that_names_nothing_else(bottle):
    recording, _, path = bottle
    assert [one.name for one in path.parent.iterdir()] == ["motion.html"]
    assert "<title>&lt;shake&gt; &amp; co</title>" in recording.page
    assert recording.page.count("<b>&lt;shake&gt; &amp; co</b>") == 1
    for word in ("reproduction", "2 standard deviations", "demonstrations"):
        assert word in recording.page
    own = re.sub(r'__VISER_EMBED_DATA__="[^"]+"', "", recording.page)
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=[\"']?https?:", own)
    assert path.stat().st_size < 1.3e6


def test_every_link_of_the_robot_is_where_its_joints_put_it(bottle):
    recording, trajectory, _ = bottle
    links = read_urdf(upper_body().config()["urdf"]).links
    whole = Robot.from_urdf(upper_body().config()["urdf"], links)
    chosen, instants = steps(trajectory)
    assert recording.duration == pytest.approx(instants[-1] + 1.0)
    state = whole.state(trajectory.joints[chosen])
    for number in (0, 5, len(chosen) - 1):
        for link in links:
            pose = recording.pose(f"/robot/{link}", instants[number])
            expected = torch.cat((state.position(link), state.orientation(link)), -1)[number]
            # viser leaves out moves that are smaller than numpy's allclose sees
            np.testing.assert_allclose(pose, expected, atol=2e-5, err_msg=link)
    shapes = {node for node in recording.nodes if re.fullmatch(r"/robot/\w+/\d", node)}
    assert len(shapes) == 21


def test_paths_and_frames_are_those_of_the_data(bottle):
    recording, trajectory, _ = bottle
    chosen, _ = steps(trajectory)
    path = upper_body().state(trajectory.joints[chosen]).position("r_hand")
    drawn = recording.props("/reproduction/r_hand")["points"].reshape(-1, 2, 3)
    np.testing.assert_allclose(drawn[:, 0], path[:-1], atol=1e-6)
    np.testing.assert_allclose(drawn[:, 1], path[1:], atol=1e-6)
    demonstrations = skills.few_bottles()
    shown = recording.props("/demonstrations/l_hand")["points"].reshape(-1, 2, 3)
    expected = [upper_body().state(one.joints).position("l_hand") for one in demonstrations]
    np.testing.assert_allclose(shown[0, 0], expected[0][0], atol=1e-6)
    np.testing.assert_allclose(shown[-1, 1], expected[-1][-1], atol=1e-6)
    bottle_frame = demonstrations[1].frames["bottle"]
    expected = torch.cat((bottle_frame.position, bottle_frame.orientation))
    np.testing.assert_allclose(recording.pose("/frames/bottle", 3.0), expected)
    assert recording.props("/frames/bottle/label")["text"] == "bottle"
    before = recording.props("/demonstrations/bottle")["batched_positions"].reshape(-1, 3)
    np.testing.assert_allclose(before[1], bottle_frame.position, atol=1e-6)


def test_ellipsoids_are_drawn_along_the_path(bottle):
    recording, trajectory, _ = bottle
    chosen, _ = steps(trajectory)
    drawn = recording.props("/covariance/r_hand")
    few = chosen[np.linspace(0, len(chosen) - 1, min(40, len(chosen))).astype(int)]
    state = upper_body().state(trajectory.joints[few])
    half_axes, turns = ellipsoids(state, trajectory.covariance[few], "r_hand")
    centres = drawn["batched_positions"].reshape(-1, 3)
    np.testing.assert_allclose(centres, state.position("r_hand"), atol=1e-6)
    scales = drawn["batched_scales"].reshape(-1, 3)
    np.testing.assert_allclose(scales, half_axes.clip(min=5e-4), atol=1e-6)
    np.testing.assert_allclose(drawn["batched_wxyzs"].reshape(-1, 4), turns, atol=1e-6)


def test_an_ellipsoid_holds_the_share_of_a_gaussian_that_it_should():
    robot, generator = upper_body(), torch.Generator().manual_seed(0)
    joints = torch.linspace(-0.2, 0.2, 17, dtype=torch.float64)
    root = 1e-4 * torch.randn(17, 17, dtype=torch.float64, generator=generator)
    half_axes, turn = ellipsoids(robot.state(joints), root @ root.T, "l_hand")
    assert bool((half_axes.diff() >= 0).all())
    draws = torch.randn(20_000, 17, dtype=torch.float64, generator=generator) @ root.T
    centre, around = (robot.state(q).position("l_hand") for q in (joints, joints + draws))
    seen = quaternions.rotate(quaternions.conjugate(turn), around - centre) / half_axes
    inside = (torch.linalg.vector_norm(seen, dim=-1) < 1).double().mean()
    assert float(inside) == pytest.approx(chi2.cdf(2.0**2, df=3), abs=0.01)
    # and its axes are the principal ones: what is seen along them is uncorrelated
    torch.testing.assert_close(
        torch.cov(seen.T), torch.eye(3, dtype=torch.float64) / 4, atol=5e-3, rtol=0
    )


def test_tracked_poses_and_moving_frames_are_shown_too(tmp_path):
    model = skills.hands_model().fit(skills.handlings(moves=True))
    situation, _ = skills.new_handling(moves=True)
    trajectory = write_motion(tmp_path / "m.html", model, situation, fps=5)
    recording = Recording(tmp_path / "m.html")
    last = trajectory.joints[-1]
    np.testing.assert_allclose(recording.pose("/robot/right", 2.0)[:3], last[7:10], atol=2e-5)
    for at, step in ((0.0, 0), (2.0, -1)):
        position = situation.frames["cup"].position[step]
        np.testing.assert_allclose(recording.pose("/frames/cup", at)[:3], position, atol=2e-5)
    assert "demonstrations" not in recording.page.rpartition("<b>tpgmm</b>")[2]
    assert not any(node.startswith("/demonstrations") for node in recording.nodes)


def test_joints_alone_have_nothing_to_show(tmp_path):
    model = skills.canonical().fit(skills.waves())
    with pytest.raises(DataError, match=r"joints only.*--link NAME"):
        write_motion(tmp_path / "m.html", model, Situation([0.0, 0.0, 0.0]))
    assert list(tmp_path.iterdir()) == []


def test_live_a_frame_that_is_moved_is_reproduced_for_anew(capsys):
    model, [situation, other] = skills.hands(), [skills.new_handling(seed=s)[0] for s in (7, 8)]
    with LiveView(model, [situation, other], skills.handlings(), port=0) as view:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+", view.url)
        [expected] = model.predict([situation])
        torch.testing.assert_close(view.trajectory.joints, expected.joints)
        cup = Frame([0.2, 0.1, 0.3], situation.frames["cup"].orientation)
        view.move_frame("cup", cup)
        [expected] = model.predict([replace(situation, frames={"cup": cup})])
        torch.testing.assert_close(view.trajectory.joints, expected.joints)
        view.show(1)
        [expected] = model.predict([other])
        torch.testing.assert_close(view.trajectory.joints, expected.joints)
        start = time.monotonic()
        view.run(0.3)
        assert 0.3 <= time.monotonic() - start < 5
        assert 0.1 < view.clock <= 2.0
    assert capsys.readouterr().out == ""


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """A folder as ``tpgmm demo`` writes it."""
    folder = tmp_path_factory.mktemp("demo")
    skills.small_bottle().save(folder / "model")
    demonstrations = skills.generator().demonstrations(2)
    save_lerobot(demonstrations, folder / "dataset", fps=20, task="shake")
    return folder


def test_view_shows_what_the_demo_wrote(demo):
    text = output("view", demo, "--fps", 2, "--situation", 1)
    page = demo.parent / f"{demo.name}.html"
    assert re.fullmatch(r"[\d.]+ s of motion, [\d.]+ MB, in (.*)\n", text)[1] == str(page)
    recording = Recording(page)
    assert f"{demo.name}, situation 1" in recording.page
    bottle = skills.generator().demonstrations(2)[1].frames["bottle"]
    np.testing.assert_allclose(
        recording.pose("/frames/bottle", 0)[:3], bottle.position, atol=1e-6
    )


def test_view_takes_situations_from_a_file(demo, tmp_path):
    joints = skills.few_bottles()[0].joints[0].tolist()
    frames = {"bottle": {"position": [0.3, 0, 0.15]}}
    file, out = tmp_path / "s.json", tmp_path / "m.html"
    file.write_text(json.dumps([{"joints": joints, "frames": frames}]))
    output("view", demo / "model", "--situations", file, "--fps", 1, "--out", out)
    np.testing.assert_allclose(Recording(out).pose("/frames/bottle", 0)[:3], (0.3, 0, 0.15))


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("model",), "give --dataset DATASET or --situations FILE.json"),
        ((".", "--situation", 2), "there are 2 situations, counted from 0; got --situation 2"),
        ((".", "--out", "motion.mp4"), "--out ends in .html, got 'motion.mp4'"),
        ((".", "--meshes", "nowhere"), "--meshes"),
        (("nothing", "--dataset", "x"), "nothing"),
    ],
)
def test_view_refuses_what_it_cannot_show(demo, arguments, complaint):
    assert complaint in refusal("view", demo / arguments[0], *arguments[1:])


def test_without_viser_the_error_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(DependencyError, match=r"tpgmm-torch\[view\]"):
        write_motion(tmp_path / "m.html", skills.hands(), skills.new_handling()[0])


def test_live_the_command_serves_until_it_is_interrupted(demo):
    command = [sys.executable, "-c", "from tpgmm_torch.cli import main; main()"]
    command += ["view", str(demo), "--live", "--port", "0", "--fps", "2"]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        text=True,
        # what a shell starts in the background would else ignore Ctrl-C
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        try:
            line = process.stdout.readline()
            url = re.fullmatch(r"open (http://127\.0\.0\.1:\d+) in a browser.*\n", line)[1]
            with urllib.request.urlopen(url, timeout=60) as answer:
                assert b"<title>Viser</title>" in answer.read()
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
            assert process.stdout.read() == ""
        finally:
            process.kill()

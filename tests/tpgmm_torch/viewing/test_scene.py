"""What is drawn is where the data and the kinematics put it."""

import re

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from tests.support import skills
from tests.support.recordings import FPS, Recording
from tests.support.worlds import upper_body
from tpgmm_torch import Robot, Situation, quaternions
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.urdf import read_urdf
from tpgmm_torch.viewing import ellipsoids, write_motion


def steps(trajectory):
    """Time steps that are shown at FPS, and their instants in the recording."""
    start, end = float(trajectory.time[0]), float(trajectory.time[-1])
    wanted = np.append(np.arange(start, end, 1 / FPS), end)
    chosen = np.unique(np.searchsorted(trajectory.time.numpy(), wanted))
    return chosen, (trajectory.time[chosen] - trajectory.time[0]).numpy()


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

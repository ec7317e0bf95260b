"""What is drawn is where the data and the kinematics put it."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from tests.support import skills
from tests.support.worlds import upper_body
from tpgmm_control.obstacles import Scene
from tpgmm_control.obstacles import Shape as Solid
from tpgmm_tools.viewing import MotionScene, ellipsoids, parse_shape
from tpgmm_torch import Frame, Hold, Robot, Situation, quaternions
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.urdf import read_urdf


@pytest.fixture(scope="module")
def bottle():
    """Draw the paper's skill at two pictures per second, and the demonstrations in it."""
    shown = skills.few_bottles()
    scene = MotionScene(skills.small_bottle(), shown, fps=2.0)
    return scene.draw(Situation.of(shown[1])), shown


def steps_of(drawing):
    """Find the time steps of the pictures."""
    time = drawing.trajectory.time
    return torch.searchsorted(time, torch.from_numpy(drawing.time) + time[0] - 1e-9)


def test_every_link_of_the_robot_is_where_its_joints_put_it(bottle):
    drawing, _ = bottle
    links = read_urdf(upper_body().config()["urdf"]).links
    whole = Robot.from_urdf(upper_body().config()["urdf"], links)
    state = whole.state(drawing.trajectory.joints[steps_of(drawing)])
    for link in links:
        expected = torch.cat((state.position(link), state.orientation(link)), -1)
        poses = drawing.nodes[f"/robot/{link}"].poses
        np.testing.assert_allclose(poses, expected, atol=1e-9, err_msg=link)
    robot = [node for path, node in drawing.nodes.items() if path.startswith("/robot/")]
    assert sum(len(node.solids) for node in robot) == 21
    assert drawing.time[0] == 0 and np.diff(drawing.time).max() < 0.81


def test_paths_go_through_every_time_step_and_around_corners(bottle):
    drawing, shown = bottle
    path = upper_body().state(drawing.trajectory.joints).position("r_hand")
    drawn = drawing.lines["/reproduction/r_hand"]
    np.testing.assert_array_equal(drawn[1:, 0], drawn[:-1, 1])
    np.testing.assert_allclose(drawn[[0, -1], [0, 1]], path[[0, -1]], atol=1e-9)
    gaps = torch.cdist(path, torch.tensor(drawn[:, 0])).min(dim=1).values
    assert float(gaps.max()) < 0.1 * float(path.diff(dim=0).norm(dim=-1).max())
    turns, chords = np.diff(drawn[:, 1] - drawn[:, 0], axis=0), np.diff(path, n=2, axis=0)
    assert np.linalg.norm(turns, axis=1).max() < 0.1 * np.linalg.norm(chords, axis=1).max()
    recorded = drawing.lines["/demonstrations/l_hand"]
    expected = [upper_body().state(one.joints).position("l_hand") for one in shown]
    np.testing.assert_allclose(recorded[0, 0], expected[0][0], atol=1e-9)
    np.testing.assert_allclose(recorded[-1, 1], expected[-1][-1], atol=1e-9)


def test_objects_are_where_the_situation_has_them_with_their_shapes(bottle):
    drawing, shown = bottle
    frame, node = shown[1].frames["bottle"], drawing.nodes["/frames/bottle"]
    pose = torch.cat((frame.position, frame.orientation))
    np.testing.assert_allclose(node.poses, pose[None])
    assert node.label == "bottle" and node.solids["shape"].kind == "box"
    np.testing.assert_allclose(drawing.axes["/demonstrations/bottle"][1], pose)
    model = skills.hands_model().fit(skills.handlings(moves=True))
    situation, _ = skills.new_handling(moves=True)
    cup = {"cup": parse_shape("cylinder:0.03,0.2")}
    moving = MotionScene(model, objects=cup, fps=5).draw(situation)
    assert moving.nodes["/frames/cup"].solids["shape"].size == (0.03, 0.2)
    where = situation.frames["cup"].position[[0, -1]]
    np.testing.assert_allclose(moving.nodes["/frames/cup"].poses[[0, -1], :3], where)
    right = moving.trajectory.joints[-1, 7:10]
    np.testing.assert_allclose(moving.nodes["/robot/right"].poses[-1, :3], right)
    assert not moving.axes and list(moving.lines) == [
        "/reproduction/left", "/reproduction/right",
    ]  # fmt: skip
    with pytest.raises(DataError, match=r"shapes for \['mug'\].*\['cup'\]"):
        MotionScene(model, objects={"mug": cup["cup"]})


@pytest.mark.parametrize("recorded", [False, True])
def test_what_is_held_goes_with_the_hand_and_stays_where_it_is_put(recorded):
    model = copy.copy(skills.small_bottle())
    model.holds_ = (Hold("bottle", "l_hand", 5.0, 9.0),)
    one = skills.few_bottles()[1]
    situation = Situation.of(one)
    if recorded:  # as somebody else carried it
        bottle = one.frames["bottle"].expand(one.time.shape)
        away = torch.stack([0 * one.time, 0 * one.time, (one.time - 5.0).clamp(min=0)], -1)
        frames = {"bottle": Frame(bottle.position + away, bottle.orientation)}
        situation = replace(situation, frames=frames)
    drawing = MotionScene(model, fps=5).draw(situation)
    state = upper_body().state(drawing.trajectory.joints[steps_of(drawing)])
    hand = Frame(state.position("l_hand"), state.orientation("l_hand"))
    poses = torch.from_numpy(drawing.nodes["/frames/bottle"].poses)
    bottle, at = Frame(poses[:, :3], poses[:, 3:]), drawing.picture
    for now in (0.0, 4.8):
        torch.testing.assert_close(bottle.position[at(now)], one.frames["bottle"].position)
    carried, put = bottle.position[[at(6.0), at(8.0)]], bottle.position[at(10.0) :]
    assert float((carried[1] - one.frames["bottle"].position).norm()) > 0.02
    in_hand = [bottle[at(now)].seen_from(hand[at(now)]).position for now in (6.0, 8.0)]
    torch.testing.assert_close(*in_hand, atol=1e-9, rtol=0)
    torch.testing.assert_close(put, put[:1].expand_as(put))


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
    # and its axes are the principal ones: coordinates along them are uncorrelated
    identity = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(torch.cov(seen.T), identity / 4, atol=5e-3, rtol=0)


def test_joints_alone_have_nothing_to_show():
    model = skills.canonical().fit(skills.waves())
    with pytest.raises(DataError, match=r"joints only.*--link NAME"):
        MotionScene(model)


def test_names_with_a_slash_are_one_step_of_a_path():
    model = skills.hands_model().fit(skills.handlings())
    situation = skills.new_handling()[0]
    frames = {**situation.frames, "a/b": situation.frames["cup"]}
    drawing = MotionScene(model, fps=5).draw(replace(situation, frames=frames))
    assert "/frames/a_b" in drawing.nodes


def test_obstacles_that_stand_still_are_drawn_where_they_are():
    model, capsule = skills.small_bottle(), ("rod", 0.02, [0.0, 0.0, 0.1], [0.0, 0.0, 0.5])
    solids = [Solid.table(0.05), Solid.capsule(*capsule), Solid.sphere("ball", 0.1, [1, 2, 3])]
    world = Scene(model.kinematics_, solids, visuals=True)
    drawing = MotionScene(model, fps=2.0, obstacles=world).draw(
        Situation.of(skills.few_bottles()[0])
    )
    shown = {n.label: n for path, n in drawing.nodes.items() if path.startswith("/obstacles/")}
    assert {*shown} == {"table", "rod", "ball"}
    [top] = shown["table"].solids.values()
    assert top.kind == "box" and shown["table"].poses[0, 2] + top.size[2] / 2 == 0.05
    side, *ends = shown["rod"].solids.values()
    assert side.size == pytest.approx((0.02, 0.4)) and len(ends) == 2
    assert {round(end.pose[2, 3], 9) for end in ends} == {0.2, -0.2}
    np.testing.assert_allclose(shown["rod"].poses[0, :3], [0, 0, 0.3], atol=1e-12)
    assert [one.kind for one in shown["ball"].solids.values()] == ["sphere"]

"""Inverse kinematics by mink: poses are reached and followed within the limits."""

import re
import sys
from typing import Any

import numpy as np
import pytest
import torch

from tests.support.robot_zoo import HANDS, random_joints, upper_body, zoo
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_evaluation.policies.inverse_kinematics import follow_poses, reach
from tpgmm_torch import Frame, quaternions
from tpgmm_torch.exceptions import (
    DataError,
    DependencyError,
    PlausibilityWarning,
    ShapeError,
    UnknownNameError,
)
from tpgmm_torch.robots.robot import Robot


def poses_at(robot: Robot, joints: Any) -> dict[str, Frame]:
    state = robot.state(joints)
    return {link: state.pose(link) for link in robot.links}


@pytest.mark.parametrize(
    "robot",
    [
        upper_body(joints="l_*", locked={"waist_*": 0.1}),
        upper_body(base="torso", tools={"cup": ("l_hand", Frame([0.0, 0.02, -0.1]))}),
        zoo(("l_finger", "turret"), base="column", coordinates=["light"]),
    ],
    ids=["arm", "both hands", "slides"],
)
def test_poses_of_a_posture_nearby_are_reached(robot: Robot) -> None:
    start = 0.5 * random_joints(robot, seed=1).nan_to_num()
    wanted = start + 0.1 * torch.linspace(-1, 1, robot.n_joints, dtype=torch.float64)
    wanted = wanted.clamp(robot.lower, robot.upper)
    start = start.clamp(robot.lower, robot.upper)
    poses = poses_at(robot, wanted)
    joints = reach(robot, poses, start, tolerance=1e-5)
    for link, pose in poses.items():
        state = robot.state(joints)
        torch.testing.assert_close(state.position(link), pose.position, rtol=0, atol=1e-5)
        turn = quaternions.product(
            pose.orientation, quaternions.conjugate(state.orientation(link))
        )
        assert quaternions.log(turn).norm() < 1e-5
    assert ((joints >= robot.lower - 1e-9) & (joints <= robot.upper + 1e-9)).all()
    if "light" in robot.joint_names:
        assert joints[-1] == start[-1]  # it has no kinematics


def test_positions_alone_leave_the_turn_free() -> None:
    robot = upper_body(joints="l_*")
    start = torch.tensor([0.5, 0.5, -0.3, -1.5, 0, 0, 0], dtype=torch.float64)
    here = robot.state(start).pose("l_hand")
    upside_down = Frame(here.position + torch.tensor([0.02, 0.0, 0.02]), [0.0, 1.0, 0.0, 0.0])
    joints = reach(robot, {"l_hand": upside_down}, start, orientations=False)
    found = robot.state(joints).position("l_hand")
    torch.testing.assert_close(found, upside_down.position, rtol=0, atol=1e-4)


def test_a_way_is_followed_as_well_as_the_generator_of_the_skill_follows_it() -> None:
    skill = BottleShaking(rate=25)
    [demonstration] = skill.demonstrations(1, seed=0)
    steps = int(demonstration.events["grasp"] * 25)
    shown = demonstration.joints[:steps]
    poses = poses_at(skill.robot, shown)
    posture = skill.neutral_posture()
    joints = follow_poses(skill.robot, poses, shown[0], rate=25, posture=posture)
    assert joints.shape == shown.shape
    reached = skill.robot.state(joints)
    for link in HANDS:
        away = reached.position(link) - poses[link].position
        assert away.norm(dim=-1).max() < 1e-3
    speeds = (joints.diff(dim=0) * 25).abs()
    assert (speeds <= skill.robot.velocity + 1e-6).all()
    assert ((joints >= skill.robot.lower) & (joints <= skill.robot.upper)).all()
    jumps = [np.abs(np.diff(path.numpy(), 2, axis=0)).max() for path in (joints, shown)]
    assert jumps[0] < 2 * jumps[1]


def test_postures_go_with_the_poses() -> None:
    skill = BottleShaking(rate=25)
    [shown] = (one.joints[:60] for one in skill.demonstrations(1, seed=0))
    poses = poses_at(skill.robot, shown)
    bent = shown[0] + 0.2 * torch.linspace(-1, 1, 17)
    away = []
    for posture in (shown, shown[0]):
        joints = follow_poses(skill.robot, poses, shown[0], rate=25, posture=posture)
        away.append(float((joints - shown).abs().max()))
    assert away[0] < 0.02 < away[1]
    with pytest.raises(ShapeError, match="60 poses need as many postures, or one; got 3"):
        follow_poses(skill.robot, poses, shown[0], rate=25, posture=bent.expand(3, -1))


class TestMissing:
    robot = upper_body(joints="l_*")
    start = torch.tensor([0.5, 0.5, -0.3, -1.5, 0, 0, 0], dtype=torch.float64)

    def poses(self, way: Any) -> dict[str, Frame]:
        here = self.robot.state(self.start).pose("l_hand")
        return {"l_hand": Frame(here.position + way, here.orientation.expand(len(way), 4))}

    def test_poses_out_of_reach_are_named(self) -> None:
        way = torch.zeros(30, 3, dtype=torch.float64)
        way[:, 0] = torch.linspace(0, 1.5, 30)
        message = r"'l_hand' is .* mm, .* from pose 29 of 30"
        with pytest.warns(PlausibilityWarning, match=message):
            joints = follow_poses(self.robot, self.poses(way), self.start, rate=10)
        assert joints.isfinite().all()

    def test_a_start_elsewhere_is_a_miss(self) -> None:
        way = torch.full((30, 3), 0.03, dtype=torch.float64)
        with pytest.warns(PlausibilityWarning, match=r"'l_hand' is 52\.0 mm, .* pose 0 of 30"):
            follow_poses(self.robot, self.poses(way), self.start, rate=10)

    @pytest.mark.parametrize("seed", range(8))
    def test_outside_the_limits_it_begins_at_the_nearest_posture_within(
        self, seed: int
    ) -> None:
        robot, rng = self.robot, np.random.default_rng(seed)
        wanted = robot.lower + 0.1 * (robot.upper - robot.lower)
        joint, beyond = int(rng.integers(7)), 10.0 ** rng.uniform(-3, 2)
        start = wanted.clone()
        start[joint] = robot.lower[joint] - beyond
        nearest = start.clamp(robot.lower, robot.upper)
        poses = poses_at(robot, wanted)
        message = f"'{robot.joint_names[joint]}' at .* its limit {nearest[joint]:.4g}"
        with pytest.warns(PlausibilityWarning, match=message) as warned:
            found = reach(robot, poses, start, tolerance=1e-5)
        assert len(warned) == 1
        torch.testing.assert_close(found, reach(robot, poses, nearest, tolerance=1e-5))
        held = {link: pose.expand((9,)) for link, pose in poses.items()}
        with pytest.warns(PlausibilityWarning):
            way = follow_poses(robot, held, start, rate=50)
        assert way[0].equal(nearest)
        assert ((way.diff(dim=0) * 50).abs() <= robot.velocity + 1e-6).all()
        assert ((way >= robot.lower - 1e-9) & (way <= robot.upper + 1e-9)).all()

    def test_as_much_as_is_allowed_is_no_miss(self) -> None:
        way = torch.full((30, 3), 0.03, dtype=torch.float64)
        follow_poses(self.robot, self.poses(way), self.start, rate=10, tolerance=0.06)


class TestRefusing:
    robot = upper_body(joints="l_*")
    start = (0.5, 0.5, -0.3, -1.5, 0, 0, 0)

    def test_poses_out_of_reach(self) -> None:
        far = {"l_hand": Frame([2.0, 0.0, 0.0])}
        with pytest.raises(DataError, match=r"'l_hand' is .* mm, .* deg away"):
            reach(self.robot, far, self.start)
        for metres in (1e9, 1e300):  # with which no solver can compute
            with pytest.raises(DataError, match="no step leads towards"):
                reach(self.robot, {"l_hand": Frame([metres, 0.0, 0.0])}, self.start)

    @pytest.mark.parametrize("rate", [0, -5, np.nan, np.inf])
    def test_rates_that_cannot_be(self, rate: float) -> None:
        poses = {"l_hand": Frame(np.zeros((4, 3)))}
        with pytest.raises(DataError, match="rate is a positive number"):
            follow_poses(self.robot, poses, self.start, rate=rate)

    def test_ranges_of_one_point_and_names_of_mujoco_are_no_obstacle(self) -> None:
        text = upper_body_urdf().replace('"l_hand"', '"world"')
        robot = Robot.from_urdf(text, ["world"], joints="l_*", dtype=torch.float32)
        start = robot.joint_tensor(self.start)
        assert reach(robot, poses_at(robot, start), start).equal(start)
        text = re.sub(r'lower="[^"]*" upper="[^"]*"', 'lower="0" upper="0"', text)
        still = Robot.from_urdf(text, ["world"], joints="l_*")
        with pytest.raises(DataError, match="not reached"):
            reach(still, poses_at(robot, start), np.zeros(7))

    def test_links_and_shapes_that_do_not_fit(self) -> None:
        one, many, starts = Frame([0.2, 0.1, 0.1]), Frame(np.zeros((4, 3))), np.zeros((2, 7))
        for poses, error, message in (
            ({"nose": one}, UnknownNameError, "link 'nose'"),
            ({"l_hand": many}, ShapeError, "one pose"),
        ):
            with pytest.raises(error, match=message):
                reach(self.robot, poses, self.start)
        for poses, start, message in (
            ({"l_hand": many, "r_hand": one}, self.start, "same number of poses"),
            ({"l_hand": many[:0]}, self.start, "same number of poses"),
            ({"l_hand": many}, starts, "one start"),
        ):
            with pytest.raises(ShapeError, match=message):
                follow_poses(self.robot, poses, start, rate=10)

    def test_joints_that_others_mimic(self) -> None:
        with pytest.raises(DataError, match="'elbow' moves several links by mimicry"):
            reach(zoo(("tip",)), {"tip": Frame([0.0, 0.0, 0.0])}, np.zeros(5))

    def test_a_missing_library(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "mink", None)
        with pytest.raises(DependencyError, match=r"tpgmm-torch\[ik\]"):
            reach(self.robot, {"l_hand": Frame([0.2, 0.1, 0.1])}, self.start)

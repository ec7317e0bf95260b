"""Robots of a URDF against pinocchio, MuJoCo, finite differences and closed forms."""

import math
import random
import re
import time
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import torch

from tests.support.refusals import refused
from tests.support.robot_zoo import (
    G1_PATH,
    ZOO,
    ZOO_FOLLOWERS,
    ZOO_JOINTS,
    Pinocchio,
    assert_agrees,
    assert_differences_agree,
    g1,
    random_joints,
    upper_body,
    zoo,
)
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, ShapeError, UnknownNameError
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.robots import robot as robot_module
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.tracked_poses import Poses
from tpgmm_torch.robots.urdf import read_urdf


def published_files() -> list[Any]:
    """The URDFs of a public collection of which something moves; one file of it is empty."""
    files = sorted(G1_PATH.parents[2].rglob("*.urdf"))
    moves = re.compile(rb'type="(revolute|continuous|prismatic)"')
    return [pytest.param(f, id=f.stem) for f in files if moves.search(f.read_bytes())]


@pytest.mark.parametrize("file", published_files())
def test_published_robots_are_where_pinocchio_has_them(file: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PlausibilityWarning)
        model = read_urdf(file)
        links = random.Random(0).sample(model.links, min(3, len(model.links)))
        robot = Robot.from_urdf(file, links)
    leaders = {
        name: model.leader(name) for name in model.movable if name not in model.actuated_joints
    }
    followers = {n: (on.joint, on.multiplier, on.offset) for n, on in leaders.items()}
    oracle = Pinocchio(pin.buildModelFromUrdf(str(file)), followers)
    joints = random_joints(robot)
    state = robot.state(joints)
    oracle.run(dict(zip(robot.joint_names, joints.tolist(), strict=True)))
    for index, link in enumerate(links):
        position, _, jacobian = oracle.link(link, model.root, robot.joint_names)
        np.testing.assert_allclose(state.position(link), position, rtol=0, atol=1e-9)
        np.testing.assert_allclose(state.jacobians[index], jacobian.reshape(6, -1), atol=1e-9)


class TestOracles:
    def test_upper_body_agrees_with_pinocchio(self) -> None:
        oracle = Pinocchio(pin.buildModelFromXML(upper_body_urdf()), {})
        assert_agrees(upper_body(), oracle, "base")

    def test_g1_agrees_with_pinocchio(self) -> None:
        oracle = Pinocchio(pin.buildModelFromUrdf(str(G1_PATH)), {})
        robot = g1()
        assert robot.n_joints == 17
        assert_agrees(robot, oracle, "pelvis")

    @pytest.mark.parametrize("base", [None, "tip", "r_finger", "flange", "column", "turret"])
    def test_every_kind_of_joint_and_base_agrees_with_pinocchio(self, base: str | None) -> None:
        oracle = Pinocchio(pin.buildModelFromXML(ZOO), ZOO_FOLLOWERS)
        robot = zoo(base=base)
        assert robot.joint_names == ZOO_JOINTS
        assert_agrees(robot, oracle, base or "ground")

    def test_locked_joints_agree_with_pinocchio(self) -> None:
        locked = {"elbow": 0.7, "lift": 0.3}
        oracle = Pinocchio(pin.buildModelFromXML(ZOO), ZOO_FOLLOWERS)
        robot = zoo(base="l_finger", locked=locked)
        assert robot.joint_names == ("swivel", "grip", "wag")
        assert_agrees(robot, oracle, "l_finger", locked)


class TestUpperBody:
    def test_shoulder_centres_are_the_published_ones(self) -> None:
        shoulders = ("l_shoulder_2", "r_shoulder_2")
        state = Robot.from_urdf(upper_body_urdf(), shoulders).state(torch.zeros(17))
        expected = torch.tensor(
            [[0.0053, 0.1558, 0.3243], [0.0053, -0.1558, 0.3243]], dtype=torch.float64
        )
        torch.testing.assert_close(state.positions, expected, rtol=0, atol=5e-5)

    def test_arm_lengths_masses_and_limits_are_the_published_ones(self) -> None:
        model = mujoco.MjModel.from_xml_string(upper_body_urdf())
        arm = 0.568 + 0.777 + 1.046 + 0.633 + 0.934 + 0.261 + 0.054 + 0.3
        robot = upper_body()
        assert model.body_mass.sum() == pytest.approx(1.801 + 0.546 + 0.754 + 6.362 + 2 * arm)
        assert (robot.velocity == 4).all()
        limits = dict(
            zip(robot.joint_names, zip(robot.lower, robot.upper, strict=True), strict=True)
        )
        assert tuple(map(float, limits["waist_roll"])) == (-0.5236, 0.5235)
        assert tuple(map(float, limits["l_wrist_roll"])) == (-0.785375, 1.395)
        assert tuple(map(float, limits["r_wrist_roll"])) == (-1.395, 0.785375)
        reach = robot.state(torch.zeros(17)).position("l_hand")[2]
        assert float(reach) == pytest.approx(0.32432899 - 0.18 - 0.19468 - 0.07, abs=1e-12)


class TestSettings:
    def test_joints_are_matched_by_name_in_any_order(self) -> None:
        robot, joints = zoo(), random_joints(zoo())
        order = (3, 0, 4, 2, 1)
        other = zoo(joints=[ZOO_JOINTS[i] for i in order])
        state, shuffled = robot.state(joints), other.state(joints[list(order)])
        torch.testing.assert_close(shuffled.positions, state.positions)
        torch.testing.assert_close(shuffled.jacobians, state.jacobians[..., list(order)])
        torch.testing.assert_close(other.upper, robot.upper[list(order)])

    def test_patterns_stand_for_the_joints_that_fit_them(self) -> None:
        left = [name for name in upper_body().joint_names if name.startswith("l_")]
        patterns = ["l_*", "r_elbow*", "gripper"]
        robot = upper_body(joints=patterns, coordinates=["gripper"])
        right = [name for name in upper_body().joint_names if name.startswith("r_elbow")]
        assert robot.joint_names == (*left, *right, "gripper")
        first = upper_body(joints=["l_*", left[-1]]).joint_names
        assert first == (*left[:-1], left[-1])  # one that is named keeps its place
        with pytest.raises(UnknownNameError, match=r"joint 'm_\*' is not in the movable"):
            upper_body(joints=["m_*"])

    def test_patterns_lock_what_does_not_move(self) -> None:
        robot = upper_body(
            joints="l_*", locked={"*_elbow*": 0.2, "waist_*": 0.1, "waist_yaw": 0.3}
        )
        locked = robot.config()["locked"]
        assert {value for name, value in locked.items() if "elbow" in name} == {0.2}
        assert (locked["waist_yaw"], locked["waist_roll"]) == (0.3, 0.1)
        waist = upper_body(locked={"?_*": 0.0}).joint_names
        assert waist == ("waist_roll", "waist_pitch", "waist_yaw")
        with pytest.raises(UnknownNameError, match=r"joint 'm_\*' is not in the movable"):
            upper_body(locked={"m_*": 0.0})

    @pytest.mark.parametrize("kind", ["fixed", "revolute"])
    def test_a_description_of_thousands_of_links_is_read_at_once(self, kind: str) -> None:
        seconds = []
        for size in (1000, 8000):
            text = "".join(
                f'<link name="l{i}"/><joint name="j{i}" type="{kind}"><parent link="l{i}"/>'
                f'<child link="l{i + 1}"/><limit lower="-1" upper="1" velocity="1"/></joint>'
                for i in range(size)
            )
            urdf = f'<robot name="chain">{text}<link name="l{size}"/></robot>'
            start = time.process_time()
            Robot.from_urdf(urdf, [f"l{size}"], joints=["j7"] if kind == "revolute" else ())
            seconds.append(time.process_time() - start)
        # 8 times the time; 64 where it grows with the square
        assert seconds[1] < 25 * seconds[0]

    def test_more_joints_than_a_robot_has_are_refused(self, monkeypatch) -> None:
        monkeypatch.setattr(robot_module, "MOST_JOINTS", 10)
        refused(lambda: upper_body(), DataError, r"has 17 joints, 17 of them .*choose")
        assert upper_body(joints=["l_*"]).n_joints < 10

    def test_joints_that_are_not_named_stand_at_zero(self) -> None:
        robot = zoo(joints=["elbow", "lift"])
        full = zoo().state([0.2, 0.0, 0.4, 0.0, 0.0])
        part = robot.state([0.4, 0.2])
        torch.testing.assert_close(part.positions, full.positions)
        torch.testing.assert_close(part.jacobians, full.jacobians[..., [2, 0]])

    def test_coordinates_without_kinematics_have_zero_columns(self) -> None:
        robot, plain = upper_body(coordinates=["l_grip", "r_grip"]), upper_body()
        assert robot.joint_names == (*plain.joint_names, "l_grip", "r_grip")
        joints = random_joints(robot)
        state, bare = robot.state(joints), plain.state(joints[:17])
        torch.testing.assert_close(state.positions, bare.positions)
        torch.testing.assert_close(state.jacobians[..., :17], bare.jacobians)
        assert (state.jacobians[..., 17:] == 0).all()
        assert robot.lower[17:].tolist() == [-math.inf] * 2
        assert robot.velocity[17:].tolist() == [math.inf] * 2

    def test_coordinates_stand_where_joints_puts_them(self) -> None:
        robot = zoo(joints=["wag", "hand", "lift"], coordinates=["hand", "camera"])
        assert robot.joint_names == ("wag", "hand", "lift", "camera")
        state = robot.state([0.1, 9.0, 0.2, 9.0])
        torch.testing.assert_close(
            state.positions, zoo(joints=["wag", "lift"]).state([0.1, 0.2]).positions
        )
        assert (state.jacobians[..., [1, 3]] == 0).all()

    @pytest.mark.parametrize("base", [None, "flange"])
    def test_tools_move_with_their_parent(self, base: str | None) -> None:
        grip = Frame([0.1, -0.2, 0.3], quaternions.exp(torch.tensor([0.3, -1.0, 0.5]).double()))
        tools = {"cup": ("r_finger", grip), "pen": ("ground", [0, 0, 0.1])}
        robot = zoo(("cup", "r_finger", "pen", "ground"), tools=tools, base=base)
        joints = random_joints(robot)
        state = robot.state(joints)
        parent = Frame(state.position("r_finger"), state.orientation("r_finger"))
        turned = quaternions.product(parent.orientation, grip.orientation)
        torch.testing.assert_close(state.position("cup"), parent.transform(grip.position))
        torch.testing.assert_close(
            quaternions.to_matrix(state.orientation("cup")), quaternions.to_matrix(turned)
        )
        ground = Frame(state.position("ground"), state.orientation("ground"))
        torch.testing.assert_close(
            ground.inverse_transform(state.position("pen")), joints.new_tensor([0, 0, 0.1])
        )
        assert_differences_agree(robot, joints)

    def test_limits_are_those_of_the_description(self) -> None:
        robot = zoo()
        assert robot.lower.tolist() == [-0.1, -math.inf, -1, 0, -1]
        # the elbow leads wag_too, 0.5 * elbow + 0.2, which goes to 1 at 1 rad/s
        assert robot.upper.tolist() == [0.5, math.inf, 1.6, 0.1, 1]
        assert robot.velocity.tolist() == [0.2, math.inf, 2, 1, 1]
        assert robot.acceleration.tolist() == robot.jerk.tolist() == [math.inf] * 5
        assert robot.without_limits == ("swivel",)  # endless, but not endlessly fast
        fast = ZOO.replace('"continuous">', '"continuous"><limit velocity="3"/>')
        assert Robot.from_urdf(fast, ("flange",)).without_limits == ()

    def test_what_mimics_a_joint_limits_it(self) -> None:
        limit = '<limit lower="0" upper="0.1" effort="1" velocity="1"/>'
        richer = limit.replace('velocity="1"', 'velocity="1" acceleration="8" jerk="90"')
        # grip_too = 0.01 - grip, within 0 and 0.1
        text = ZOO.replace('<limit lower="-1" upper="1" effort="1" velocity="1"/>', richer, 1)
        robot = Robot.from_urdf(text, ("flange",))
        assert (robot.lower[3], robot.upper[3]) == (0, pytest.approx(0.01))
        assert robot.acceleration.tolist()[3:] == [8, math.inf]
        assert robot.jerk.tolist()[3:] == [90, math.inf]
        assert robot.to(torch.float32).acceleration.dtype == torch.float32

    def test_what_mimics_a_joint_and_leaves_it_no_room_does_not_limit_it(self) -> None:
        robot = Robot.from_urdf(ZOO.replace('offset="0.01"', 'offset="3"'), ("flange",))
        assert (robot.lower[3], robot.upper[3]) == (0, 0.1)
        assert robot.without_limits == ("swivel", "grip")

    def test_limits_that_cannot_be_are_told_once_by_name_where_they_matter(self) -> None:
        text = ZOO.replace('velocity="0.2"', 'velocity="0"').replace('upper="2"', 'upper="-2"')
        told = r"'lift': velocity=\"0\"; 'elbow': lower=\"-1\" upper=\"-2\"\. .*bounds="
        with pytest.warns(PlausibilityWarning, match=told) as warned:
            robot = Robot.from_urdf(text, ("flange",), joints=["lift", "elbow"])
            assert robot.to(torch.float32).without_limits == ("lift", "elbow")
            assert Robot.combine(left=robot).n_joints == 2
            assert MotionBounds.of(robot).velocity.tolist() == [math.inf, 2]
        assert len(warned) == 1
        Robot.from_urdf(text, ("flange",), joints=["swivel"])  # asks for neither
        with pytest.warns(PlausibilityWarning, match="xacro:x left over"):
            Robot.from_urdf(ZOO.replace("</robot>", "<xacro:x/></robot>"), ("flange",))

    def test_a_forgotten_sign_is_told_and_does_not_hold_the_joint(self) -> None:
        limit = '<limit lower="0" upper="0.1" effort="1" velocity="1"/>'
        text = ZOO.replace('<limit lower="-1" upper="1" effort="1" velocity="1"/>', limit, 1)
        robot = Robot.from_urdf(text.replace('offset="0.01"', ""), ("flange",))
        assert (robot.lower[3], robot.upper[3]) == (0, 0.1)
        assert robot.without_limits == ("swivel", "grip")

    def test_a_floating_base_is_no_obstacle_beyond_the_base(self) -> None:
        text = ZOO.replace("</robot>", "") + (
            '<link name="world"/><joint name="free" type="floating">'
            '<parent link="world"/><child link="ground"/></joint></robot>'
        )
        robot = Robot.from_urdf(text, ("flange",), base="ground")
        torch.testing.assert_close(
            robot.state(torch.ones(5)).positions,
            zoo(("flange",)).state(torch.ones(5)).positions,
        )
        with pytest.raises(DataError, match="'free' of type 'floating' lies between"):
            Robot.from_urdf(text, ("flange",))


def assert_moves_like(both: RobotState, arm: RobotState, pose: Frame, first: int) -> None:
    """The links of one robot of two, from ``first`` on, are those of the robot alone."""
    links = slice(first, first + len(arm.links))
    turn = quaternions.to_matrix(pose.orientation)
    exact: dict[str, Any] = {"rtol": 0, "atol": 1e-14}
    positions = arm.positions @ turn.T + pose.position
    torch.testing.assert_close(both.positions[:, links], positions, **exact)
    rotations = turn @ quaternions.to_matrix(arm.orientations)
    found = quaternions.to_matrix(both.orientations[:, links])
    torch.testing.assert_close(found, rotations, **exact)
    n, start = arm.joints.shape[-1], 0 if first == 0 else both.joints.shape[-1]
    own = slice(0, n) if start == 0 else slice(start - n, start)
    jacobians = both.jacobians[:, links].clone()
    expected = torch.cat(
        (turn @ arm.jacobians[..., :3, :], turn @ arm.jacobians[..., 3:, :]), -2
    )
    torch.testing.assert_close(jacobians[..., own], expected, **exact)
    jacobians[..., own] = 0
    assert (jacobians == 0).all()


class TestCombining:
    left = Frame(
        [0.1, 0.3, 0.8], quaternions.normalize(torch.tensor([0.9, 0.1, -0.3, 0.2]).double())
    )
    right = Frame([0.1, -0.3, 0.8], [0.5, 0.5, -0.5, 0.5])

    @pytest.mark.parametrize("base", ["ground", "column"])
    def test_each_moves_as_it_does_alone(self, base: str) -> None:
        cup = {"cup": ("flange", Frame([0.1, 0.0, 0.2]))}
        column = {"joints": ["swivel", "elbow", "wag"], "locked": {"lift": 0.2}}
        arm = zoo(
            ("cup", "l_finger"), base=base, tools=cup, **(column if base == "column" else {})
        )
        other = upper_body()
        poses = {"left": self.left, "body": self.right}
        both = Robot.combine(poses, left=arm, body=other)
        assert both.links == ("left_cup", "left_l_finger", "body_l_hand", "body_r_hand")
        joints = random_joints(both, 50)
        state, n = both.state(joints), arm.n_joints
        assert_moves_like(state, arm.state(joints[:, :n]), self.left, 0)
        assert_moves_like(state, other.state(joints[:, n:]), self.right, 2)

    def test_limits_names_and_settings_come_along(self) -> None:
        arm = zoo(("tip",), coordinates=["hand"], locked={"elbow": 0.4}, dtype=torch.float32)
        both = Robot.combine(left=arm, right=arm)
        names = [f"{side}_{name}" for side in ("left", "right") for name in arm.joint_names]
        assert both.joint_names == tuple(names)
        for limit in ("lower", "upper", "velocity"):
            torch.testing.assert_close(getattr(both, limit), getattr(arm, limit).repeat(2))
        assert both.lower.dtype == torch.float32
        config = both.config()
        assert config["coordinates"] == ["left_hand", "right_hand"]
        assert config["locked"] == {"left_elbow": 0.4, "right_elbow": 0.4}

    def test_everything_may_be_seen_from_a_table(self) -> None:
        arm, table = zoo(("tip",)), self.left
        poses = {"left": table.compose(self.right)}
        both = Robot.combine(poses, left=arm, fixed={"table": table}, base="table")
        joints = random_joints(arm, 5)
        assert_moves_like(both.state(joints), arm.state(joints), self.right, 0)

    def test_they_are_combined_like_any_robot(self) -> None:
        both = Robot.combine({"left": self.left}, left=zoo(("tip",)), right=upper_body())
        joints = random_joints(both, 3)
        four = Robot.combine(near=both, far=both, poses={"far": self.right})
        assert four.joint_names[0] == "near_left_lift"
        assert_moves_like(four.state(joints.repeat(1, 2)), both.state(joints), self.right, 3)

    def test_what_does_not_go_together(self) -> None:
        arm = zoo(("tip",))
        refused(lambda: Robot.combine(), DataError, "robots by name")
        with pytest.raises(DataError, match="robots by name"):
            Robot.combine(left=Poses(["hand"]))  # type: ignore[arg-type]
        with pytest.raises(UnknownNameError, match=r"robot 'rihgt' .*\['left', 'right'\]"):
            Robot.combine({"rihgt": self.right}, left=arm, right=arm)
        with pytest.raises(DataError, match=r"'column' of a robot is moved .*'ground'"):
            Robot.combine(left=zoo(("tip",), base="column"))
        with pytest.raises(DataError, match="two links named 'left_tip'"):
            Robot.combine(left=arm, fixed={"left_tip": self.left})
        with pytest.raises(ShapeError, match="one constant pose"):
            Robot.combine({"left": Frame(np.zeros((2, 3)))}, left=arm)
        for pose in ([0, 0.2], [[0, 0, 0]], "here", [0, 0, 0, 1]):
            with pytest.raises(DataError, match="the pose of 'left'"):
                Robot.combine({"left": pose}, left=arm)
        with pytest.warns(PlausibilityWarning, match=r"\['left', 'right'\] are 20 m"):
            Robot.combine({"left": [0, 20, 0]}, left=arm, right=arm)

    def test_a_saved_description_has_all_of_it(self, tmp_path: Path) -> None:
        cup = {"cup": ("l_finger", Frame([0.1, 0.0, 0.2]))}
        poses = {"left": [0.1, 0.3, 0.8, 0.5, 0.5, -0.5, 0.5], "right": self.right}
        both = Robot.combine(poses, left=zoo(("tip", "cup"), tools=cup), right=upper_body())
        both.save(tmp_path / "both.urdf")
        again = Robot.from_urdf(tmp_path / "both.urdf", both.links)
        assert again.joint_names == both.joint_names
        joints = random_joints(both, 3)
        assert torch.equal(again.state(joints).positions, both.state(joints).positions)

    def test_joints_of_any_unit_have_no_limits_where_they_move_no_link(self) -> None:
        robot = zoo(("tip", "flange"))
        free = robot.drop_limits(robot.joint_names)
        assert [bool(x) for x in free.upper.isinf()] == [
            name == "grip" or bool(robot.upper[i].isinf())
            for i, name in enumerate(robot.joint_names)
        ]
        joints = random_joints(robot, 3)
        assert torch.equal(free.state(joints).jacobians, robot.state(joints).jacobians)
        assert free == robot.drop_limits(["grip"]) == Robot.from_config(free.config())


class TestErrors:
    @pytest.mark.parametrize(("settings", "error", "message"), [
        ({"links": "tip"}, DataError, "links is a sequence of names, got 'tip'"),
        ({"links": ("tip", "tip")}, DataError, "links names something twice"),
        ({"links": ("nose",)}, UnknownNameError, "link 'nose' is not in .* 'flange'"),
        ({"base": "nose"}, UnknownNameError, "base link 'nose' is not in the URDF"),
        ({"joints": ["lift", "knee"]}, UnknownNameError, "'knee' is not in .*'elbow'"),
        ({"joints": ["weld"]}, UnknownNameError, "'weld' is not in the movable joints"),
        ({"joints": ["lift", "lift"]}, DataError, "joints names something twice"),
        ({"joints": ["wag_too"]}, DataError, "mimics 'elbow'.* choose or lock 'elbow'"),
        ({"locked": {"knee": 0.0}}, UnknownNameError, "joint 'knee'"),
        ({"locked": {"wag_too": 0.0}}, DataError, "mimics 'elbow'"),
        ({"locked": {"lift": math.nan}}, DataError, "finite numbers, got .*'lift': nan"),
        ({"locked": {"lift": 0.1}, "joints": ["lift"]}, DataError, "both in the joint"),
        ({"coordinates": ["elbow"]}, DataError, "'elbow' moves link 'tip'.* of its own"),
        ({"coordinates": "hand"}, DataError, "coordinates is a sequence of names"),
        ({"tools": {"cup": ("nose", [0, 0, 0])}}, UnknownNameError, "tool 'cup'"),
        ({"tools": {"tip": ("arm", [0, 0, 0])}}, DataError, "'tip' has the name of a link"),
        ({"tools": {"cup": ("arm", np.zeros((2, 3)))}}, ShapeError, "one constant pose"),
        ({"tools": {"cup": ("arm", [0, 0])}}, ShapeError, "position"),
        ({"tools": {"cup": "arm"}}, DataError, "tool 'cup' is"),
        ({"dtype": torch.float16}, DataError, "float16"),
    ])  # fmt: skip
    def test_wrong_settings(
        self, settings: dict[str, Any], error: type[Exception], message: str
    ) -> None:
        with pytest.raises(error, match=message):
            Robot.from_urdf(ZOO, **({"links": ("tip",)} | settings))

    def test_a_wrong_number_of_joints_names_those_expected(self) -> None:
        with pytest.raises(ShapeError, match=r"\(\.\.\., 5\).*'lift', 'swivel'.*got \(2, 4\)"):
            zoo().state(torch.zeros(2, 4))
        refused(lambda: zoo().state(torch.zeros(())), ShapeError, r"got \(\)")

    @pytest.mark.parametrize("value", [math.nan, math.inf])
    def test_joints_that_are_not_finite(self, value: float) -> None:
        refused(lambda: zoo().state([0.0, value, 0.0, 0.0, 0.0]), DataError, "NaN or infinite")

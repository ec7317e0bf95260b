"""States of robots as tensors, and robots of a user's own."""

import copy
import json
import math
import pickle
import re
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.base import clone
from torch.autograd import gradcheck

from tests.support.own_operators import PlanarArm
from tests.support.robot_zoo import assert_differences_agree, random_joints, upper_body, zoo
from tpgmm_torch import Frame, quaternions
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.robots import Poses, RobotState
from tpgmm_torch.robots.kinematics import JointSpace, parse_dtype
from tpgmm_torch.robots.robot import Robot

#: A grasp.
CUP = Frame([0.05, -0.12, 0.08], [0.5, -0.5, 0.1, 0.7])


class TestTensors:
    @pytest.mark.parametrize("batch", [(), (0,), (1,), (2, 3)])
    @pytest.mark.parametrize("make", [upper_body, lambda: zoo(base="tip")])
    def test_any_leading_dimensions(self, make: Any, batch: tuple[int, ...]) -> None:
        robot = make()
        joints, n, links = random_joints(robot, *batch), robot.n_joints, len(robot.links)
        state = robot.state(joints)
        assert state.joints.shape == (*batch, n)
        assert state.positions.shape == (*batch, links, 3)
        assert state.orientations.shape == (*batch, links, 4)
        assert state.jacobians.shape == (*batch, links, 6, n)
        for index in np.ndindex(*batch):
            single, selected = robot.state(joints[index]), state[index]
            torch.testing.assert_close(selected.positions, single.positions)
            torch.testing.assert_close(selected.orientations, single.orientations)
            torch.testing.assert_close(selected.jacobians, single.jacobians)
            torch.testing.assert_close(selected.joints, single.joints)

    def test_numpy_and_lists_are_taken_and_left_alone(self) -> None:
        robot, values = zoo(), np.full((2, 5), 0.1)
        state = robot.state(values)
        torch.testing.assert_close(state.positions, robot.state(values.tolist()).positions)
        assert (values == 0.1).all()
        state.joints.zero_()
        assert (values == 0.1).all()

    @pytest.mark.parametrize("part", ["positions", "orientations", "jacobians"])
    @pytest.mark.parametrize("make", [upper_body, lambda: zoo(base="tip")])
    def test_gradients(self, make: Any, part: str) -> None:
        robot = make()
        joints = random_joints(robot, 2, seed=3).requires_grad_()
        fast = part == "jacobians"  # many outputs: random projections of them
        assert gradcheck(lambda q: getattr(robot.state(q), part), (joints,), fast_mode=fast)

    def test_float32_is_float64_rounded(self) -> None:
        robot = upper_body()
        single = robot.to(torch.float32)
        joints = random_joints(robot, 4)
        state, rounded = robot.state(joints), single.state(joints)
        assert rounded.positions.dtype == rounded.jacobians.dtype == torch.float32
        torch.testing.assert_close(
            rounded.positions.double(), state.positions, rtol=0, atol=1e-6
        )
        torch.testing.assert_close(
            rounded.jacobians.double(), state.jacobians, rtol=0, atol=1e-6
        )
        assert single == upper_body(dtype=torch.float32) != robot
        assert single.to(torch.float64) == robot
        assert (single.to(torch.float64).state(joints).positions == state.positions).all()
        assert robot.to(torch.float64, "cpu") is robot

    def test_runs_in_inference_mode_and_serves_gradients_if_made_there(self) -> None:
        with torch.inference_mode():
            robot = zoo()
            assert robot.state(torch.ones(5)).positions.is_inference()
        joints = torch.ones(5, dtype=torch.float64, requires_grad=True)
        robot.state(joints).positions.sum().backward()
        assert joints.grad is not None and bool(joints.grad.abs().sum() > 0)

    def test_the_default_device_does_not_matter(self) -> None:
        expected = zoo().state(torch.ones(5)).positions
        torch.set_default_device("meta")
        try:
            robot = zoo()
        finally:
            torch.set_default_device(None)
        assert (robot.state(torch.ones(5)).positions == expected).all()


class TestState:
    def test_unknown_link(self) -> None:
        state = zoo(("tip",)).state(torch.zeros(5))
        with pytest.raises(UnknownNameError, match=r"link 'cup' is not in .*\['tip'\]"):
            state.position("cup")


def carry(joints: torch.Tensor, **options: Any) -> RobotState:
    return upper_body().state(joints).with_link("cup", "r_hand", CUP, **options)


class TestObjects:
    def test_an_object_is_where_the_link_has_it(self) -> None:
        joints = random_joints(upper_body(), 5)
        state, hand = carry(joints), upper_body().state(joints)
        where = Frame(hand.position("r_hand"), hand.orientation("r_hand"))
        torch.testing.assert_close(state.position("cup"), where.transform(CUP.position))
        matrix = quaternions.to_matrix(where.orientation) @ quaternions.to_matrix(
            CUP.orientation
        )
        torch.testing.assert_close(quaternions.to_matrix(state.orientation("cup")), matrix)
        assert state.links == ("l_hand", "r_hand", "cup")
        assert state.robot_links == hand.robot_links == hand.links
        assert (state.position("l_hand") == hand.position("l_hand")).all()

    def test_its_jacobian_is_the_derivative_of_its_pose(self) -> None:
        joints, size = random_joints(upper_body(), 4), 1e-6
        state = carry(joints)
        for column, unit in enumerate(torch.eye(17, dtype=torch.float64)):
            ahead, behind = carry(joints + size * unit), carry(joints - size * unit)
            velocity = (ahead.position("cup") - behind.position("cup")) / (2 * size)
            back = quaternions.conjugate(behind.orientation("cup"))
            turn = quaternions.product(ahead.orientation("cup"), back)
            # rounding of poses of size one, divided by the step
            close = {"rtol": 0, "atol": 1e-8}
            linear, angular = state.linear_jacobian("cup"), state.angular_jacobian("cup")
            torch.testing.assert_close(linear[..., column], velocity, **close)
            rate = quaternions.log(turn) / (2 * size)
            torch.testing.assert_close(angular[..., column], rate, **close)

    def test_robots_of_a_batch_may_hold_it_or_not(self) -> None:
        joints = random_joints(upper_body(), 3)
        free = Frame([0.3, 0.1, 0.2], [0.0, 1.0, 0.0, 0.0])
        left = torch.tensor([True, False, False])
        right = torch.tensor([False, False, True])
        state = upper_body().state(joints).with_link("cup", None, free)
        state = state.with_link("cup", "l_hand", CUP, where=left)
        state = state.with_link("cup", "r_hand", CUP, where=right)
        assert state.carrier("cup").tolist() == [0, -1, 1]
        assert state.links == ("l_hand", "r_hand", "cup")
        single = upper_body().state(joints[0]).with_link("cup", "l_hand", CUP)
        for part in ("positions", "orientations", "jacobians"):
            found, expected = getattr(state[0], part), getattr(single, part)
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-14)
        assert (state.position("cup")[1] == free.position).all()
        assert (state.orientation("cup")[1] == free.orientation).all()
        assert (state.jacobians[1, 2] == 0).all()
        torch.testing.assert_close(state[2].position("cup"), carry(joints[2]).position("cup"))

    def test_what_stands_on_a_carried_object_is_carried_by_the_same_link(self) -> None:
        state = carry(random_joints(upper_body())).with_link("spoon", "cup", CUP)
        assert state.carrier("spoon") == state.carrier("r_hand") == 1
        assert state.carrier("l_hand") == 0
        direct = Frame(
            CUP.transform(CUP.position), quaternions.product(CUP.orientation, CUP.orientation)
        )
        other = carry(state.joints).with_link("spoon", "r_hand", direct)
        torch.testing.assert_close(state.jacobians, other.jacobians)
        with_other_cup = other.with_link("cup", "l_hand", CUP)
        assert with_other_cup.links == ("l_hand", "r_hand", "spoon", "cup")
        assert (with_other_cup.position("spoon") == other.position("spoon")).all()
        assert with_other_cup.carrier("spoon") == 1

    def test_what_cannot_be_is_refused(self) -> None:
        state = upper_body().state(torch.zeros(17))
        with pytest.raises(UnknownNameError, match=r"link 'tail' is not in .*\['l_hand', 'r_h"):
            state.with_link("cup", "tail", CUP)
        with pytest.raises(DataError, match="'l_hand' is a link of the robot: give the object"):
            state.with_link("l_hand", "r_hand", CUP)
        with pytest.raises(
            DataError, match=r"some robots do not hold 'cup', .*free object first"
        ):
            state.with_link("cup", "r_hand", CUP, where=torch.tensor(False))

    def test_gradients_reach_joints_and_grasp(self) -> None:
        joints = random_joints(upper_body()).requires_grad_()
        point = CUP.position.clone().requires_grad_()

        def jacobian(joints: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
            state = upper_body().state(joints)
            return state.with_link("cup", "r_hand", Frame(point)).jacobians[..., 2, :, :]

        assert gradcheck(jacobian, (joints, point), fast_mode=True)


class TestOwnKinematics:
    def test_a_user_defined_robot_needs_only_its_state(self) -> None:
        arm = PlanarArm()
        assert arm.n_joints == 3
        assert_differences_agree(arm, random_joints(arm))
        assert clone(arm) is arm
        joints = torch.ones(2, 3)
        assert arm.retract(joints) is joints

    def test_only_floating_tensors_change_their_dtype(self) -> None:
        arm = PlanarArm()
        arm.order, arm.scale = torch.tensor([2, 0, 1]), torch.ones(3)
        double = arm.to(torch.float64, "cpu")
        assert double.order.dtype == torch.int64
        assert double.scale.dtype == double.upper.dtype == torch.float64
        assert arm.scale.dtype == torch.float32
        assert arm.to(device="meta").upper.device.type == "meta"
        assert arm.to(device="meta").upper.dtype == torch.float64

    def test_joint_vectors_become_tensors_of_the_robot(self) -> None:
        single = PlanarArm().to(torch.float32)
        tensor = single.joint_tensor(np.ones((2, 3)))
        assert tensor.dtype == torch.float32
        assert tensor.tolist() == [[1.0] * 3] * 2
        for wrong in (np.ones((2, 2)), 1.0):
            shape = re.escape(str(np.shape(wrong)))
            with pytest.raises(ShapeError, match=rf"\(\.\.\., 3\) .*'elbow'.* got {shape}"):
                single.joint_tensor(wrong)
        with pytest.raises(DataError, match="joints holds 1 value"):
            single.joint_tensor([0.0, math.nan, 0.0])


@pytest.mark.parametrize("batch", [(), (3,)])
def test_joints_may_be_given_by_name(batch: tuple[int, ...]) -> None:
    robot = upper_body()
    joints = random_joints(robot, *batch)
    named: dict[str, Any] = dict(zip(robot.joint_names, joints.unbind(-1), strict=True))
    shuffled = {"wheel": "off"} | dict(reversed(named.items()))
    assert torch.equal(robot.joint_tensor(shuffled), joints)
    assert torch.equal(robot.state(shuffled).positions, robot.state(joints).positions)
    first = robot.joint_names[0]
    with pytest.raises(ShapeError, match="have one shape, got"):
        robot.joint_tensor(shuffled | {first: np.zeros((2, 2))})
    with pytest.raises(DataError, match=rf"joint '{first}' holds 1 value"):
        robot.joint_tensor(shuffled | {first: math.nan})
    del shuffled[first]
    with pytest.raises(UnknownNameError, match=f"joint '{first}' is not in the joints given"):
        robot.joint_tensor(shuffled)


def test_dtypes_go_by_name() -> None:
    assert parse_dtype("float32") == parse_dtype(torch.float32) == torch.float32
    for dtype in ("float16", torch.float16):
        with pytest.raises(DataError, match=r"one of \['float32', 'float64'\], got .*float16"):
            parse_dtype(dtype)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_a_state_has_joints_and_no_link(batch):
    state = JointSpace(["a", "b"]).state(torch.ones(*batch, 2))
    assert torch.equal(state.joints, torch.ones(*batch, 2, dtype=torch.float64))
    assert state.links == ()
    assert state.positions.shape == (*batch, 0, 3)
    assert state.orientations.shape == (*batch, 0, 4)
    assert state.jacobians.shape == (*batch, 0, 6, 2)


def test_nothing_is_limited():
    space = JointSpace(["a", "b"], torch.float32)
    assert space.lower.tolist() == [-torch.inf] * 2
    assert space.upper.tolist() == space.velocity.tolist() == [torch.inf] * 2
    assert space.lower.dtype == space.upper.dtype == space.velocity.dtype == torch.float32
    assert space.state([1.0, 2.0]).joints.dtype == torch.float32


def test_other_numbers_of_joints_are_refused():
    with pytest.raises(ShapeError, match=r"\['a', 'b'\], got \(3,\)"):
        JointSpace(("a", "b")).state(torch.zeros(3))


def tooled() -> Robot:
    """A robot of which everything was set."""
    tools = {"cup": ("flange", [0.1, 0.2, 0.3], [0.6, 0.0, 0.8001, 0.0])}
    joints = {
        "joints": ["elbow", "hand", "wag"],
        "locked": {"lift": 0.2},
        "coordinates": ["hand"],
    }
    return zoo(("cup", "tip"), base="column", tools=tools, dtype=torch.float32, **joints)


VALUES = {
    "robot": tooled(),
    "two robots": Robot.combine({"left": CUP}, left=zoo(("tip",)), right=upper_body()),
    "poses": Poses(),
    "positions": Poses(("a", "b"), orientation=False, dtype=torch.float32),
    "joints": JointSpace(("a", "b")),
}


@pytest.mark.parametrize("robot", VALUES.values(), ids=list(VALUES))
def test_a_robot_is_a_value(robot: Any) -> None:
    saved = type(robot).from_config(json.loads(json.dumps(robot.config())))
    assert saved.config() == robot.config() and saved.lower.dtype == robot.lower.dtype
    joints = torch.rand(2, robot.n_joints)
    for other in (
        saved,
        copy.copy(robot),
        copy.deepcopy(robot),
        pickle.loads(pickle.dumps(robot)),
    ):
        assert other == robot and hash(other) == hash(robot)
        assert torch.equal(other.state(joints).jacobians, robot.state(joints).jacobians)
        assert torch.equal(other.state(joints).positions, robot.state(joints).positions)
    assert robot != JointSpace(("b", "a")) and robot != ("a", "b")


def test_joints_without_a_robot_have_names() -> None:
    space = JointSpace(("a", "b"))
    assert space.joint_names == ("a", "b") and repr(space) == "JointSpace(2 joints)"


@pytest.mark.parametrize(("robot", "change", "message"), [
    ("robot", {"color": "red"}, "color"),
    ("robot", {"dtype": "int8"}, "int8"),
    ("robot", {"urdf": "robot.urdf"}, "not a path"),
    ("robot", {"links": ["cup", "nose"]}, "nose"),
    ("poses", {"color": "red"}, "color"),
    ("poses", {"dtype": "int8"}, "int8"),
])  # fmt: skip
def test_a_tampered_config_is_refused(robot: str, change: dict[str, Any], message: str) -> None:
    made = VALUES[robot]
    with pytest.raises((DataError, UnknownNameError), match=message):
        type(made).from_config(made.config() | change)

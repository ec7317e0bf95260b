"""General task parameters against Definition 1, and against Table I, which they contain."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support import oracles
from tests.support.operator_battery import OperatorLaws
from tests.support.worlds import LEFT, OBJECT, OnPoses, OnRobot, upper_body
from tpgmm_torch import (
    Affine,
    Canonical,
    Demonstration,
    Frame,
    RelativePosition,
    Situation,
    Stack,
    TaskParameterizedGMM,
    TaskParameters,
    quaternions,
)
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError


class TaskParameterLaws(OperatorLaws):
    """A and b in place of a pose; ``shape`` is that of A."""

    shape: tuple[int, int]

    def affine(self, *batch, seed=0):
        rng = np.random.default_rng([seed, *self.shape])
        near = np.eye(*self.shape) + 0.3 * rng.uniform(-1, 1, (*batch, *self.shape)) / 3
        return Affine(near, rng.standard_normal((*batch, self.shape[0])))

    def scene(self, *batch, seed=0):
        state, _ = super().scene(*batch, seed=seed)
        return state, {OBJECT: self.affine(*batch)}  # the same, wherever the robot is

    def at(self, state, frames):
        at = super().at(state, {})
        read = {n: (f.offset.numpy(), f.linear.numpy()) for n, f in frames.items()}
        return replace(at, frames=read)

    def row(self, at):
        offset, linear = at.frames[OBJECT]
        inverse = np.linalg.pinv(linear)
        if self.operator.link is None:
            return oracles.Row(inverse, np.eye(len(inverse)), inverse @ (offset - at.joints))
        position, jacobian = at.links[LEFT][0], at.jacobians[LEFT][:3]
        return oracles.Row(
            inverse @ jacobian, np.eye(len(inverse)), inverse @ (offset - position)
        )

    def demonstration(self, length=40):
        shown = super().demonstration(length)
        return replace(shown, frames={OBJECT: self.affine(length)})

    def test_gradients_are_those_of_finite_differences(self):
        state, frames = self.scene()
        leaves = [state.joints.clone(), frames[OBJECT].linear, frames[OBJECT].offset]

        def matrices(joints, linear, offset):
            now = self.kinematics.state(joints), {OBJECT: Affine(linear, offset)}
            results = self.operator.linear(*now), self.operator.offset(*now)
            return [result for result in results if result.requires_grad]

        leaves = [leaf.clone().requires_grad_() for leaf in leaves]
        assert torch.autograd.gradcheck(matrices, leaves, fast_mode=True, atol=1e-6)


class TestOnTheJoints(OnRobot, TaskParameterLaws):
    operator, shape = TaskParameters(OBJECT), (17, 17)

    def test_a_and_b_are_those_given(self):
        """Definition 1 as it stands."""
        state, frames = self.scene(3)
        affine = frames[OBJECT]
        torch.testing.assert_close(self.operator.linear(state, frames), affine.linear)
        torch.testing.assert_close(self.operator.offset(state, frames), affine.offset)


class TestOnSomeDirectionsOfTheJoints(OnRobot, TaskParameterLaws):
    operator, shape = TaskParameters(OBJECT, size=5), (17, 5)

    def test_directions_out_of_reach_stay(self):
        state, frames = self.scene()
        affine = frames[OBJECT]
        reach = affine.linear @ affine.inverse()
        expected = reach @ affine.offset + state.joints - reach @ state.joints
        torch.testing.assert_close(self.operator.offset(state, frames), expected)


class LinkLaws(TaskParameterLaws):
    operator, shape = TaskParameters(OBJECT, LEFT), (3, 3)


class TestOnALinkOfARobot(OnRobot, LinkLaws):
    pass


class TestOnALinkAmongPoses(OnPoses, LinkLaws):
    pass


class TestOnAPlane(OnRobot, TaskParameterLaws):
    operator, shape = TaskParameters(OBJECT, LEFT, 2), (3, 2)


def posed(frame: Frame) -> Affine:
    return Affine(quaternions.to_matrix(frame.orientation), frame.position)


def demonstrations(n=4, general=False):
    """A hand goes to an object's side; the object's pose as such, or as A and b."""
    robot, rng = upper_body(), np.random.default_rng(0)
    time = torch.linspace(0, 1, 20, dtype=torch.float64)
    middle = (robot.lower + robot.upper) / 2
    result = []
    for _ in range(n):
        ends = middle + 0.2 * torch.from_numpy(rng.uniform(-1, 1, (2, 17)))
        joints = torch.lerp(ends[0], ends[1], time[:, None])
        there = robot.state(joints[-1])
        frame = Frame(there.position(LEFT), there.orientation(LEFT))
        frames = {OBJECT: posed(frame) if general else frame}
        result.append(Demonstration(time, joints, frames, robot.joint_names))
    return result


def model(*operators):
    return TaskParameterizedGMM(3, list(operators), upper_body(), blend=0)


def test_a_pose_as_a_and_b_is_relative_position():
    """Table I: A = R, b = p is eq. (6), from local data to the reproduction."""
    plain = model(RelativePosition(LEFT, OBJECT), Canonical()).fit(demonstrations())
    general = model(TaskParameters(OBJECT, LEFT), Canonical()).fit(demonstrations(general=True))
    torch.testing.assert_close(general.means_[0], plain.means_[0])
    [expected] = plain.predict(demonstrations()[2])
    [found] = general.predict(demonstrations(general=True)[2])
    torch.testing.assert_close(found.joints, expected.joints, rtol=0, atol=1e-7)
    stacked = model(Stack(TaskParameters(OBJECT, LEFT), Canonical()))
    assert len(stacked.fit(demonstrations(general=True)).means_[0][0]) == 1 + 3 + 17


def test_no_change_of_coordinates_is_canonical():
    shown = demonstrations()
    same = Affine(np.eye(17), np.zeros(17))
    general = [replace(one, frames={"same": same}) for one in shown]
    plain = model(Canonical(tolerance=0)).fit(shown)
    found = model(TaskParameters("same")).fit(general)
    [expected], [trajectory] = plain.predict(shown[0]), found.predict(general[0])
    torch.testing.assert_close(trajectory.joints, expected.joints, rtol=0, atol=1e-7)
    torch.testing.assert_close(
        trajectory.covariance, expected.covariance, rtol=1e-6, atol=1e-12
    )


def test_a_size_that_changes_is_followed():
    """What no pose can say: a rail of another length, along which one goes its share."""
    time = torch.linspace(0, 1, 20, dtype=torch.float64)
    rails = [Affine([[length]], [start]) for length, start in ((1, 0), (2, 1), (0.5, -1))]
    shown = [
        Demonstration(time, rail.offset + time[:, None] * rail.linear[0], {"rail": rail})
        for rail in rails
    ]
    fitted = TaskParameterizedGMM(2, [TaskParameters("rail")], blend=0).fit(shown)
    new = Situation([4.0], {"rail": Affine([[3.0]], [4.0])})
    [trajectory] = fitted.predict(new)
    torch.testing.assert_close(trajectory.joints[:, 0], 4 + 3 * time, rtol=0, atol=1e-4)


def test_they_are_saved_with_a_model(tmp_path):
    fitted = model(TaskParameters(OBJECT, LEFT, None), Canonical()).fit(
        demonstrations(general=True)
    )
    fitted.save(tmp_path / "model")
    loaded = TaskParameterizedGMM.load(tmp_path / "model")
    assert loaded.operators_ == fitted.operators_


@pytest.mark.parametrize(
    ("operator", "frames", "error", "message"),
    [
        (TaskParameters("rail"), {}, UnknownNameError, "'rail'"),
        (
            TaskParameters(OBJECT, LEFT),
            {OBJECT: Frame([0.0, 0.0, 0.0])},
            DataError,
            r"Affine\(A, b\); 'object' is a Frame",
        ),
        (
            TaskParameters(OBJECT, LEFT),
            {OBJECT: Affine(np.eye(3, 2), np.zeros(3))},
            ShapeError,
            r"needs A of shape \(3, 3\); that of 'object' has \(3, 2\)",
        ),
        (
            TaskParameters(OBJECT, size=2),
            {OBJECT: Affine(np.eye(3, 2), np.zeros(3))},
            ShapeError,
            r"\(17, 2\)",
        ),
    ],
)
def test_what_does_not_fit_is_refused(operator, frames, error, message):
    state = upper_body().state(torch.zeros(17, dtype=torch.float64))
    with pytest.raises(error, match=message):
        operator.linearize(state, frames)

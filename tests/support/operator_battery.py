"""The laws of every operator.

A test class names an operator, and its row in terms of the oracles if Table I has another. It
inherits the laws: from a world where it acts, from ``OperatorLaws`` what every operator obeys,
from ``RelativeLaws`` and ``OrientationLaws`` what those do.
"""

import copy
import pickle
from collections.abc import Mapping
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch
from sklearn.base import clone
from torch import Tensor

import tpgmm_torch
from tests.support import oracles
from tests.support.local_coordinates import local_coordinates
from tests.support.mixtures import row_of
from tests.support.worlds import (
    CARRIED,
    LEFT,
    OBJECT,
    RIGHT,
    CarryingOnPoses,
    CarryingOnRobot,
    OnPoses,
    OnRobot,
    World,
    moved,
)
from tpgmm_torch import Demonstration, Frame, quaternions
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots import RobotState

DTYPES = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["f64", "f32"])
BATCHES = pytest.mark.parametrize("batch", [(), (3,), (2, 3)], ids=["one", "batch", "batches"])


class OperatorLaws(World):
    """What holds for every operator.

    ``operator`` is the one under test and ``row`` its row of Table I, unless it is another.
    """

    operator: Operator

    def row(self, at: oracles.At) -> oracles.Row:
        return row_of(at, self.operator)

    def candidate(
        self, local: Tensor, state: RobotState, frames: Mapping[str, Frame]
    ) -> Tensor:
        """``A mu + b``, the mean quaternions brought to the side of the present ones."""
        local = self.matched(local, self.operator.coordinates(state, frames))
        linear = self.operator.linear(state, frames)
        return (linear @ local[..., None])[..., 0] + self.operator.offset(state, frames)

    def matched(self, local: Tensor, reference: Tensor) -> Tensor:
        """``local`` with its quaternions in the hemispheres of those of ``reference``."""
        local = local.clone()
        for start in self.operator.quaternion_starts(self.kinematics):
            q = slice(start, start + 4)
            local[..., q] = quaternions.match_hemisphere(local[..., q], reference[..., q])
        return local

    def demonstration(self, length: int = 40) -> Demonstration:
        """A smooth movement, among an object that turns and a table that stands."""
        rng = np.random.default_rng(1)
        ends = self.joints(rng, 2)
        time = torch.linspace(0, 1, length, dtype=torch.float64)
        joints = self.kinematics.retract(torch.lerp(ends[0], ends[1], time[:, None]))
        spin = quaternions.exp(time[:, None] * torch.tensor([0.0, 12.0, 3.0]).double())
        # as trackers do, which know rotations and not the signs of quaternions
        joints[::3], spin[::4] = self.flipped_answer(joints[::3]), -spin[::4]
        turning = Frame(time[:, None] * torch.ones(3), spin)
        names = self.kinematics.joint_names
        return Demonstration(time, joints, {OBJECT: turning, "table": Frame(np.ones(3))}, names)

    @DTYPES
    @BATCHES
    def test_equals_its_row_of_table_one(self, dtype, batch):
        state, frames = self.scene(*batch)
        states = self.kinematics.to(dtype).state(state.joints)
        rounded = {name: frame.to(dtype) for name, frame in frames.items()}
        linear = self.operator.linear(states, rounded)
        offset = self.operator.offset(states, rounded)
        n, size = self.kinematics.n_joints, self.operator.dimension(self.kinematics)
        assert linear.shape == (*batch, n, size)
        assert offset.shape == (*batch, n)
        assert linear.dtype == offset.dtype == dtype
        tolerance = {torch.float64: 1e-11, torch.float32: 2e-4}[dtype]
        for index in np.ndindex(*batch):
            here = {name: frame[index] for name, frame in frames.items()}
            at = self.at(state[index], here)
            for actual, expected in zip(
                (linear[index], offset[index]),
                self.row(at).linear_and_offset(at.joints),
                strict=True,
            ):
                error = np.abs(actual.double().numpy() - expected).max()
                assert error <= tolerance * (1 + np.abs(expected).max())

    @DTYPES
    @BATCHES
    def test_shapes(self, dtype, batch):
        joints, frames = self.scene(*batch)
        state = self.kinematics.to(dtype).state(joints.joints)
        frames = {name: frame.to(dtype) for name, frame in frames.items()}
        size = self.operator.dimension(self.kinematics)
        coordinates = self.operator.coordinates(state, frames)
        assert coordinates.shape == (*batch, size)
        assert coordinates.dtype == dtype
        at = self.operator.linearize(state, frames)
        rows = at.displacement.shape[-1]
        n = self.kinematics.n_joints
        assert at.displacement.shape[:-1] == torch.Size(batch)
        assert rows == n if at.jacobian is None else at.jacobian.shape == (*batch, rows, n)
        if at.matrix is None:
            assert rows == size
        else:
            assert at.matrix.shape == (*batch, rows, size)

    @pytest.mark.parametrize("many", ["robots", "frames"])
    def test_robots_and_frames_broadcast(self, many):
        state, frames = self.scene(3)
        robots = many == "robots"
        now = (state, {OBJECT: frames[OBJECT][0]}) if robots else (state[0], frames)
        linear, offset = self.operator.linear(*now), self.operator.offset(*now)
        for i in range(3):
            single = (state[i], now[1]) if robots else (now[0], {OBJECT: frames[OBJECT][i]})
            expected = self.operator.linear(*single), self.operator.offset(*single)
            torch.testing.assert_close(linear.expand(3, *expected[0].shape)[i], expected[0])
            torch.testing.assert_close(offset.expand(3, *expected[1].shape)[i], expected[1])

    def derivative_error(self, size: float) -> tuple[float, float]:
        """Length of ``J dq``, and how far the coordinates' change is from it."""
        state, frames = self.scene()
        direction = torch.from_numpy(
            np.random.default_rng(2).standard_normal(state.joints.shape)
        )
        after = self.kinematics.retract(state.joints + size * direction / direction.norm())
        step = after - state.joints
        at = self.operator.linearize(state, frames)
        change = self.operator.coordinates(self.kinematics.state(after), frames)
        change = change - self.operator.coordinates(state, frames)
        asked = step if at.jacobian is None else at.jacobian @ step
        found = change if at.matrix is None else at.matrix @ change
        return float(asked.norm()), float((found - asked).norm())

    def test_the_jacobian_is_the_derivative_of_the_coordinates(self):
        (length, error), (_, finer) = self.derivative_error(2e-3), self.derivative_error(1e-3)
        assert error <= 0.02 * length
        assert finer <= 0.3 * error + 1e-12  # of second order

    def full_step(self, size: float) -> tuple[float, float]:
        """Errors before and after one step towards the coordinates of a posture nearby."""
        state, frames = self.scene()
        rng = np.random.default_rng(3)
        direction = torch.from_numpy(rng.standard_normal(state.joints.shape))
        near = self.kinematics.retract(state.joints + size * direction)
        wanted = self.operator.coordinates(self.kinematics.state(near), frames)
        reached = self.kinematics.state(self.candidate(wanted, state, frames))
        before = wanted - self.operator.coordinates(state, frames)
        after = wanted - self.operator.coordinates(reached, frames)
        return float(before.norm()), float(after.norm())

    def test_one_full_step_removes_the_error_to_second_order(self):
        (before, after), (_, finer) = self.full_step(2e-3), self.full_step(1e-3)
        assert after <= 0.05 * before
        assert finer <= 0.3 * after + 1e-12

    def test_the_present_pose_asks_for_no_step(self):
        state, frames = self.scene(3)
        stay = self.candidate(self.operator.coordinates(state, frames), state, frames)
        torch.testing.assert_close(stay, state.joints, rtol=0, atol=1e-12)

    def test_gradients_are_those_of_finite_differences(self):
        state, frames = self.scene()
        pose = frames[OBJECT]
        leaves = [state.joints.clone(), pose.position.clone(), pose.orientation.clone()]

        def matrices(joints: Tensor, position: Tensor, orientation: Tensor) -> list[Tensor]:
            now = self.kinematics.state(joints), {OBJECT: Frame(position, orientation)}
            results = self.operator.linear(*now), self.operator.offset(*now)
            return [result for result in results if result.requires_grad]

        leaves = [leaf.requires_grad_() for leaf in leaves]
        assert torch.autograd.gradcheck(matrices, leaves, fast_mode=True, atol=1e-6)

    def test_is_a_value(self):
        operator = self.operator
        copies = [
            pickle.loads(pickle.dumps(operator)),
            copy.deepcopy(operator),
            clone(operator, safe=False),
            eval(repr(operator), vars(tpgmm_torch)),
        ]
        for other in copies:
            assert other == operator
            assert type(other) is type(operator)
            assert hash(other) == hash(operator)
            assert repr(other) == repr(operator)
        assert operator != "something else"
        with pytest.raises(FrozenInstanceError):
            operator.link = "elbow"

    def test_a_tolerance_is_as_far_as_it_moves_each_coordinate(self):
        if not hasattr(self.operator, "tolerance"):  # a stack has those of its members
            return
        tolerant = replace(self.operator, tolerance=0.02)
        found = torch.tensor(tolerant.tolerances(self.kinematics))
        expected = torch.full((self.operator.dimension(self.kinematics),), 0.02)
        for start in self.operator.quaternion_starts(self.kinematics):
            turned = quaternions.exp(torch.tensor([0.02, 0.0, 0.0])) - quaternions.identity()
            expected[start : start + 4] = torch.linalg.vector_norm(turned).float()
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)

    def test_local_data_are_the_coordinates_at_each_time(self):
        demonstration = self.demonstration()
        local = local_coordinates(self.operator, demonstration, self.kinematics)
        assert local.shape == (40, self.operator.dimension(self.kinematics))
        for t, row in enumerate(local):
            frames = {n: f[t] if f.batch_shape else f for n, f in demonstration.frames.items()}
            state = self.kinematics.state(demonstration.joints[t])
            now = self.matched(self.operator.coordinates(state, frames), row)
            torch.testing.assert_close(row, now, rtol=0, atol=1e-12)
        for start in self.operator.quaternion_starts(self.kinematics):
            block = local[:, start : start + 4]
            assert bool(((block[1:] * block[:-1]).sum(-1) > 0).all())

    def test_local_data_follow_the_names_of_the_joints(self):
        demonstration = self.demonstration()
        order = np.random.default_rng(4).permutation(self.kinematics.n_joints).tolist()
        shuffled = replace(
            demonstration,
            joints=demonstration.joints[:, order],
            joint_names=tuple(demonstration.joint_names[i] for i in order),
        )
        local = local_coordinates(self.operator, demonstration, self.kinematics)
        assert torch.equal(local_coordinates(self.operator, shuffled, self.kinematics), local)


class RelativeLaws(OperatorLaws):
    """What holds for operators that see everything from a frame or from another link."""

    def test_moving_the_world_changes_nothing(self):
        state, frames = self.scene(3)
        wanted = self.operator.coordinates(*self.scene(3, seed=5))
        answer = self.candidate(wanted, state, frames)
        there = self.moved(state.joints), {name: moved(f) for name, f in frames.items()}
        seen, before = (self.operator.coordinates(*now) for now in (there, (state, frames)))
        torch.testing.assert_close(self.matched(seen, before), before, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(
            self.candidate(wanted, *there), self.moved_answer(answer), rtol=1e-9, atol=1e-9
        )


class OrientationLaws(OperatorLaws):
    """What holds for operators with quaternions: a quaternion's sign means nothing."""

    def test_signs_of_the_state_mean_nothing(self):
        state, frames = self.scene(3)
        wanted = self.operator.coordinates(*self.scene(3, seed=5))
        answer = self.candidate(wanted, state, frames)
        other = self.candidate(wanted, self.flipped(state), frames)
        torch.testing.assert_close(other, self.flipped_answer(answer))

    def test_the_sign_of_the_frame_means_nothing(self):
        state, frames = self.scene(3)
        wanted = self.operator.coordinates(*self.scene(3, seed=5))
        flipped = {n: Frame(f.position, -f.orientation) for n, f in frames.items()}
        answer = self.candidate(wanted, state, frames)
        torch.testing.assert_close(self.candidate(wanted, state, flipped), answer)

    def test_signs_of_the_mean_mean_nothing(self):
        state, frames = self.scene(3)
        wanted = self.operator.coordinates(*self.scene(3, seed=5))
        other = wanted.clone()
        for start in self.operator.quaternion_starts(self.kinematics):
            other[..., start : start + 4] *= -1
        answer = self.candidate(wanted, state, frames)
        torch.testing.assert_close(self.candidate(other, state, frames), answer)


FREE, CARRYING = (OnRobot, OnPoses), (CarryingOnRobot, CarryingOnPoses)
#: Where operators of one link, or of a link seen from something, are tested.
PLACES = {
    "Absolute": (FREE, LEFT),
    "Relative": (FREE, RIGHT, OBJECT),
    "HandToHand": (FREE, RIGHT, LEFT),
    "Carried": (CARRYING, CARRIED),
    "CarriedToPlace": (CARRYING, CARRIED, OBJECT),
    "OtherHandToCarried": (CARRYING, LEFT, CARRIED),
}


def laws_in_places(kinds, laws, places=PLACES, rows=None, **options) -> dict[str, type]:
    """Test classes of an absolute and a relative operator, by name, for each place and world.

    ``kinds`` is a pair of operators, ``rows`` of their rows where Table I has others.
    """
    made = {}
    for place, (worlds, *names) in places.items():
        relative = len(names) == 2
        held = {"held": True} if relative and names[1] == CARRIED else {}
        for world in worlds:
            bases = (world, RelativeLaws, laws) if relative else (world, laws)
            body = {"operator": kinds[relative](*names, **options, **held)}
            if rows:
                body["row"] = lambda _, at, row=rows[relative], names=names: row(at, *names)
            name = f"Test{place}{world.__name__}"
            made[name] = type(world)(name, bases, body)
    return made

"""The extension point: operators and kinematics of a user's own, through the regression."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support import oracles
from tests.support.mixtures import (
    assert_close,
    assert_equal_estimates,
    local_mixture,
    random_local,
)
from tpgmm_torch import Canonical, Kinematics, Linearization, Operator, RobotState, Stack
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.regression import Regression

Q = torch.tensor([0.3, 0.8, -0.6], dtype=torch.float64)
NOW = torch.tensor(0.9, dtype=torch.float64)


class PlanarArm(Kinematics):
    """Three hinges about z, links of half a metre."""

    joint_names, links = ("shoulder", "elbow", "wrist"), ("tip",)
    upper = torch.full((3,), torch.pi, dtype=torch.float64)
    lower, velocity = -upper, upper

    def state(self, joints):
        q = self.joint_tensor(joints)
        angles = q.cumsum(-1)
        segments = 0.5 * torch.stack((angles.cos(), angles.sin(), 0 * angles), dim=-1)
        outward = segments.flip(-2).cumsum(-2).flip(-2)  # from each hinge to the tip
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=q.dtype).expand_as(outward)
        twists = torch.cat((torch.linalg.cross(axis, outward), axis), dim=-1)
        half = 0.5 * angles[..., -1:]
        turn = torch.cat((half.cos(), 0 * half, 0 * half, half.sin()), dim=-1)
        positions = segments.sum(-2, keepdim=True)
        orientations, jacobians = turn[..., None, :], twists.mT[..., None, :, :]
        return RobotState(q, self.links, positions, orientations, jacobians)


def planar_jacobian(state: RobotState) -> Tensor:
    return state.linear_jacobian("tip")[..., :2, :]


@dataclass(frozen=True)
class PlanarPosition(Operator):
    """Where the tip is in the plane."""

    def dimension(self, kinematics):
        return 2

    def linearize(self, state, frames):
        return Linearization(planar_jacobian(state), None, -self.coordinates(state, frames))

    def coordinates(self, state, frames):
        return state.position("tip")[..., :2]


@dataclass(frozen=True)
class NullSpace(Operator):
    """``A = I - J^+ J``, ``b = J^+ J q``: the posture, where the tip does not feel it."""

    def dimension(self, kinematics):
        return kinematics.n_joints

    def linearize(self, state, frames):
        jacobian = planar_jacobian(state)
        seen = torch.linalg.pinv(jacobian) @ jacobian
        free = torch.eye(3, dtype=seen.dtype) - seen
        offset = (seen @ state.joints[..., None])[..., 0]
        return Linearization(None, free, offset - state.joints)

    def coordinates(self, state, frames):
        return state.joints


@dataclass(frozen=True)
class NullSpaceRows(NullSpace):
    """The same with an orthonormal basis N of the null space: ``N dq = N mu - N q_prev``.

    It has full row rank, as the information form needs.
    """

    def linearize(self, state, frames):
        across = torch.linalg.cross(*planar_jacobian(state).unbind(-2))
        basis = (across / across.norm(dim=-1, keepdim=True))[..., None, :]
        return Linearization(basis, basis, -(basis @ state.joints[..., None])[..., 0])


@dataclass(frozen=True)
class Constant(Operator):
    """An operator known by its ``A`` and ``b``, Definition 1 of the paper."""

    rows: tuple[tuple[float, ...], ...]
    shift: tuple[float, ...]

    def dimension(self, kinematics):
        return len(self.rows[0])

    def linearize(self, state, frames):
        shift = torch.tensor(self.shift, dtype=state.joints.dtype)
        matrix = torch.tensor(self.rows, dtype=state.joints.dtype)
        return Linearization(None, matrix, shift - state.joints)

    def coordinates(self, state, frames):
        raise NotImplementedError("its local data come from elsewhere")


CONSTANT = Constant(((1.0, 0.5), (0.0, 2.0), (0.0, 0.0)), (0.1, 0.2, 0.3))


@dataclass(frozen=True)
class Problem:
    """Operators with random mixtures, for one arm."""

    operators: list[Operator]
    mixtures: list[oracles.Local]
    weights: np.ndarray

    @classmethod
    def of(cls, *operators: Operator, n_components: int = 3) -> "Problem":
        rng, arm = np.random.default_rng(0), PlanarArm()
        tip, posture = [0.9, 0.6], [0.4, 0.9, -0.5]
        centres = {2: np.array(tip), 3: np.array(posture), 5: np.array(tip + posture)}
        sizes = [operator.dimension(arm) for operator in operators]
        mixtures = [random_local(rng, n_components, centres[size]) for size in sizes]
        return cls(list(operators), mixtures, rng.dirichlet(3 * np.ones(n_components)))

    def regression(self, operators: list[Operator] | None = None, **options) -> Regression:
        mixtures = [local_mixture(local) for local in self.mixtures]
        log_weights = torch.from_numpy(self.weights).log()
        return Regression(
            PlanarArm(), operators or self.operators, mixtures, log_weights, **options
        )

    def step(self, operators: list[Operator] | None = None, joints: Tensor = Q, **options):
        regression = self.regression(operators, **options)
        state = regression.kinematics.state(joints)
        return regression.step(NOW, state, {}, candidates=True)

    def answer(self, rows: list[oracles.Row], **how) -> oracles.Answer:
        q = Q.numpy()
        return oracles.regress(float(NOW), q, rows, self.mixtures, self.weights, **how)


def test_the_arm_moves_as_its_jacobian_says():
    arm, step = PlanarArm(), 1e-6
    state = arm.state(Q)
    for joint, unit in enumerate(torch.eye(3, dtype=torch.float64)):
        ahead, behind = arm.state(Q + step * unit), arm.state(Q - step * unit)
        change = (ahead.position("tip") - behind.position("tip")) / (2 * step)
        assert_close(state.linear_jacobian("tip")[:, joint], change)


@pytest.mark.parametrize("operator", [NullSpace(), NullSpaceRows()], ids=repr)
def test_the_null_space_operator_is_the_printed_one(operator):
    state = PlanarArm().state(Q.expand(4, 3) + 0.1 * torch.arange(4.0)[:, None])
    for index in range(4):
        jacobian = state.linear_jacobian("tip")[index, :2].numpy()
        seen = np.linalg.pinv(jacobian) @ jacobian
        assert_close(operator.linear(state, {})[index], np.eye(3) - seen)
        assert_close(operator.offset(state, {})[index], seen @ state.joints[index].numpy())


@pytest.mark.parametrize("activation", ["time", "product"])
@pytest.mark.parametrize("batch", [(), (2,)], ids=["one", "batch"])
def test_a_null_space_operator_fuses_in_covariance_form(activation, batch):
    problem = Problem.of(PlanarPosition(), NullSpace(), Canonical())
    options = {"fusion": "covariance", "epsilon": 1e-3, "activation": activation}
    joints = Q.expand(*batch, 3)
    printed = problem.step(joints=joints, **options)
    state = PlanarArm().state(Q)
    jacobian = planar_jacobian(state).numpy()
    seen = np.linalg.pinv(jacobian) @ jacobian
    q, tip = Q.numpy(), state.position("tip")[:2].numpy()
    rows = [
        oracles.Row(jacobian, np.eye(2), -tip),
        oracles.Row(np.eye(3), np.eye(3) - seen, seen @ q - q),
        oracles.Row(np.eye(3), np.eye(3), -q),
    ]
    expected = problem.answer(rows, activation=activation, epsilon=1e-3)
    assert_close(printed.joints, expected.mean + np.zeros((*batch, 3)))
    assert_close(printed.covariance, expected.covariance + np.zeros((*batch, 3, 3)))
    by_rows = problem.step([PlanarPosition(), NullSpaceRows(), Canonical()], joints, **options)
    assert_equal_estimates(by_rows, printed, 1e-8)


def test_a_null_space_operator_of_full_row_rank_fuses_in_information_form():
    problem = Problem.of(PlanarPosition(), NullSpaceRows(), n_components=1)
    state = PlanarArm().state(Q)
    jacobian = planar_jacobian(state)
    basis = torch.linalg.svd(jacobian).Vh[2:]  # of either sign
    tip, posture = (local_mixture(local).at(NOW)[0] for local in problem.mixtures)
    asked = torch.cat((tip - state.position("tip")[:2], basis @ (posture - Q)))
    expected = Q + torch.linalg.solve(torch.cat((jacobian, basis)), asked)
    assert_close(problem.step(prior_std=1e5).joints, expected)


def test_both_forms_agree_on_task_and_null_space_together():
    whole = Stack(PlanarPosition(), NullSpaceRows())  # a square Jacobian
    problem = Problem.of(whole)
    information = problem.step(prior_std=1e5)
    covariance = problem.step(fusion="covariance", epsilon=0.0)
    assert_equal_estimates(information, covariance, 1e-7)


def test_a_singular_linear_map_is_refused_in_information_form_with_advice():
    with pytest.raises(DataError, match=r"projected component is not positive definite"):
        Problem.of(NullSpace(), Canonical()).step()


def test_an_operator_known_by_its_a_and_b():
    state = PlanarArm().state(Q.expand(2, 3))
    matrix, shift = np.array(CONSTANT.rows), np.array(CONSTANT.shift)
    assert_close(CONSTANT.linear(state, {}), np.stack((matrix, matrix)))
    assert_close(CONSTANT.offset(state, {}), np.stack((shift, shift)))
    problem = Problem.of(CONSTANT, Canonical())
    estimate = problem.step(fusion="covariance", epsilon=1e-2)
    q = Q.numpy()
    rows = [oracles.Row(np.eye(3), matrix, shift - q), oracles.Row(np.eye(3), np.eye(3), -q)]
    expected = problem.answer(rows, activation="time", epsilon=1e-2)
    assert_close(estimate.joints, expected.mean)
    assert_close(estimate.covariance, expected.covariance)


def test_a_joint_without_variance_of_its_own_gets_no_share():
    estimate = Problem.of(CONSTANT, Canonical()).step(fusion="covariance", epsilon=1e-2)
    constant, canonical = (candidate.share for candidate in estimate.candidates)
    assert bool((constant[:2] > 0).all())
    assert constant[2] == 0
    assert canonical[2] == 1


@pytest.mark.parametrize(
    ("operator", "fusion"), [(NullSpaceRows(), "information"), (NullSpace(), "covariance")]
)
def test_gradients_pass_through_operators_of_ones_own(operator, fusion):
    problem = Problem.of(PlanarPosition(), operator)
    regression = problem.regression(fusion=fusion, epsilon=1e-2, prior_std=2.0)

    def step(joints: Tensor) -> Tensor:
        return regression.step(NOW, regression.kinematics.state(joints), {}).joints

    assert torch.autograd.gradcheck(step, Q.clone().requires_grad_())

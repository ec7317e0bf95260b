"""What all operators share: names, errors, values; and operators of a user's own."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support import oracles
from tests.support.local_coordinates import local_coordinates
from tests.support.mixtures import (
    assert_close,
    assert_equal_estimates,
    conditionals_of,
    form,
    random_local,
)
from tests.support.own_operators import (
    CONSTANT,
    NullSpace,
    NullSpaceRows,
    PlanarArm,
    PlanarPosition,
    Q,
    planar_jacobian,
)
from tests.support.refusals import refused
from tests.support.worlds import CARRIED, GRASP, LEFT, OBJECT, RIGHT, OnPoses, OnRobot, World
from tpgmm_torch import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.operators import Linearization, Operator
from tpgmm_torch.operators.base import carried_objects, frame_names
from tpgmm_torch.regression.fusion_forms import CovarianceFusion
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.training.mixture_settings import check_operators

WORLDS = pytest.mark.parametrize("world", [OnRobot(), OnPoses()], ids=["robot", "poses"])


@WORLDS
@pytest.mark.parametrize("kind", [RelativePosition, RelativeOrientation])
def test_a_link_is_seen_from_another_like_from_an_object_but_moves_with_it(kind, world: World):
    state, _ = world.scene(3)
    there = {OBJECT: Frame(state.position(RIGHT), state.orientation(RIGHT))}
    link, thing = kind(LEFT, RIGHT), kind(LEFT, OBJECT)
    expected = thing.coordinates(state, there)
    torch.testing.assert_close(link.coordinates(state, {}), expected, rtol=0, atol=1e-14)
    assert not torch.allclose(link.linear(state, {}), thing.linear(state, there), atol=1e-2)


LINK = r"'elbow' is not in the .*; it has \['l_hand', 'object', 'r_hand'\]"
FRAME = r"frame 'cup' is not in .*\['l_hand', 'obj"
UNKNOWN = [
    (AbsolutePosition("elbow"), LINK, LINK),
    (AbsoluteOrientation("elbow"), LINK, LINK),
    (RelativePosition("elbow", OBJECT), LINK, LINK),
    (RelativeOrientation("elbow", OBJECT), LINK, LINK),
    (Stack(AbsolutePosition(LEFT), AbsolutePosition("elbow")), LINK, LINK),
    (RelativePosition(LEFT, "cup"), r"frame 'cup' is not in .*\['object'", FRAME),
    (RelativeOrientation(LEFT, "cup"), r"frame 'cup' is not in .*\['object'", FRAME),
    (Stack(RelativePosition(LEFT, OBJECT), RelativePosition(LEFT, "cup")),
     r"frame 'cup' is not in .*\['object'", FRAME),
]  # fmt: skip


@WORLDS
@pytest.mark.parametrize(("operator", "at_once", "later"), UNKNOWN)
def test_an_unknown_name_comes_with_those_that_exist(operator, at_once, later, world: World):
    state, frames = world.scene()
    refused(lambda: operator.check(world.kinematics, frames), UnknownNameError, at_once)
    refused(lambda: operator.linearize(state, frames), UnknownNameError, later)
    refused(lambda: operator.coordinates(state, frames), UnknownNameError, later)


@WORLDS
def test_a_frame_with_the_name_of_a_link_is_refused(world: World):
    _, frames = world.scene()
    with pytest.raises(UnknownNameError, match=r"'r_hand'.* it is a link .*rename the frame"):
        RelativePosition(LEFT, RIGHT).check(world.kinematics, {RIGHT: frames[OBJECT]})


KINDS = pytest.mark.parametrize("kind", [RelativePosition, RelativeOrientation])
ABSOLUTE = {RelativePosition: AbsolutePosition, RelativeOrientation: AbsoluteOrientation}


def silent(at: Linearization) -> bool:
    """Whether the rows are 0 = 0, exactly."""
    parts = (at.jacobian, at.matrix, at.displacement)
    return all(bool((part == 0).all()) for part in parts) and bool((at.noise == 1).all())


@WORLDS
@KINDS
@pytest.mark.parametrize("batch", [(), (3,)])
def test_nothing_is_said_of_what_no_joint_moves(kind, world: World, batch):
    state, frames = world.scene(*batch)
    frames[CARRIED] = Frame([0.1, 0.2, 0.3])
    carrying = state.with_link(CARRIED, RIGHT, GRASP)
    free = [kind(CARRIED, OBJECT), kind(CARRIED, OBJECT, held=True), ABSOLUTE[kind](CARRIED)]
    for operator in free:
        assert silent(operator.linearize(state, frames))
        assert silent(operator.linearize(state.with_link(CARRIED, None, GRASP), frames))
        assert (operator.linear(state, frames) == 0).all()
        assert (operator.offset(state, frames) == state.joints).all()
    for operator in (kind(RIGHT, CARRIED, held=True), kind(CARRIED, RIGHT)):
        assert silent(operator.linearize(carrying, frames))
        assert operator.linearize(state, frames).noise is None
    held = kind(LEFT, CARRIED, held=True)
    for operator in (held, kind(CARRIED, OBJECT), kind(CARRIED, LEFT)):
        at = operator.linearize(carrying, frames)
        assert at.noise is None
        assert torch.linalg.matrix_rank(at.jacobian).min() == 3


@WORLDS
@KINDS
def test_to_a_place_nothing_changes_bit_for_bit(kind, world: World):
    state, frames = world.scene(3)
    operator = kind(LEFT, OBJECT)
    before = operator.linearize(state, frames)
    after = operator.linearize(state.with_link(OBJECT, RIGHT, GRASP), frames)
    for name in ("jacobian", "matrix", "displacement"):
        assert torch.equal(getattr(before, name), getattr(after, name))
    assert after.noise is None
    assert torch.equal(
        operator.coordinates(state, frames),
        operator.coordinates(state.with_link(OBJECT, RIGHT, GRASP), frames),
    )


@WORLDS
@KINDS
def test_robots_that_carry_and_robots_that_do_not_are_each_as_if_alone(kind, world: World):
    state, frames = world.scene(3)
    frames[CARRIED] = Frame([0.1, 0.2, 0.3])
    carries = torch.tensor([True, False, True])
    mixed = state.with_link(CARRIED, None, frames[CARRIED])
    mixed = mixed.with_link(CARRIED, RIGHT, GRASP, where=carries)
    operators = (
        kind(CARRIED, OBJECT),
        kind(RIGHT, CARRIED, held=True),
        kind(LEFT, CARRIED, held=True),
        ABSOLUTE[kind](CARRIED),
    )
    for operator in (*operators, Stack(*operators)):
        together = operator.linearize(mixed, frames)
        for row, carrying in enumerate(carries):
            here = {n: f[row] if f.batch_shape else f for n, f in frames.items()}
            one = state[row]
            alone = operator.linearize(
                one.with_link(CARRIED, RIGHT, GRASP) if carrying else one, here
            )
            for name in ("jacobian", "matrix", "displacement"):
                found, wanted = getattr(together, name)[row], getattr(alone, name)
                torch.testing.assert_close(found, wanted, rtol=0, atol=1e-14)
                assert torch.equal(found == 0, wanted == 0)
            noise = torch.zeros_like(alone.displacement) if alone.noise is None else alone.noise
            found = noise.new_zeros(3, len(noise)) if together.noise is None else together.noise
            assert torch.equal(found[row], noise)


def test_a_situation_needs_each_frame_once_and_no_link():
    operators = [
        Stack(RelativePosition(LEFT, "cup"), RelativePosition(RIGHT, "lid")),
        RelativeOrientation(LEFT, "cup"),
        RelativePosition(LEFT, RIGHT),
        Canonical(),
    ]
    assert frame_names(operators, OnRobot().kinematics) == ("cup", "lid")
    assert frame_names(operators, PlanarArm()) == ("cup", "lid", RIGHT, LEFT)
    assert frame_names([], PlanarArm()) == ()


def test_a_situation_needs_the_objects_that_may_be_carried():
    operators = [
        Stack(RelativePosition(CARRIED, "tray"), RelativePosition(LEFT, CARRIED)),
        RelativeOrientation(RIGHT, "lid", held=True),
    ]
    robot = OnRobot().kinematics
    assert frame_names(operators, robot) == ("tray", CARRIED, "lid")
    assert carried_objects(operators, robot) == (CARRIED, "lid")
    frames = dict.fromkeys((CARRIED, "tray", "lid"))
    for operator in operators:
        operator.check(robot, frames)
        with pytest.raises(
            UnknownNameError, match=r"'tray'|'lid' is not in the robot or the f"
        ):
            operator.check(robot, [CARRIED])


def test_coordinates_of_another_size_than_announced_are_refused():
    class Liar(AbsolutePosition):
        def dimension(self, kinematics):
            return 2

    poses = OnPoses()
    joints = poses.joints(np.random.default_rng(0), 5)
    with pytest.raises(ShapeError, match=r"has 2 coordinates.*\(5, 3\) for 5 time steps"):
        local_coordinates(
            Liar(LEFT), Demonstration(torch.arange(5.0), joints), poses.kinematics
        )


NOW = torch.tensor(0.9, dtype=torch.float64)


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
        mixtures = [conditionals_of(local) for local in self.mixtures]
        log_weights = torch.from_numpy(self.weights).log()
        return Regression(
            PlanarArm(), operators or self.operators, mixtures, log_weights, **options
        )

    def step(self, operators: list[Operator] | None = None, joints: Tensor = Q, **options):
        regression = self.regression(operators, **options)
        state = regression.kinematics.state(joints)
        return regression.estimate(NOW, state, {}, candidates=True)

    def answer(self, rows: list[oracles.Row], **how) -> oracles.Answer:
        q = Q.numpy()
        return oracles.regress(float(NOW), q, rows, self.mixtures, self.weights, **how)


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
    options = {"fusion": CovarianceFusion(1e-3, activation)}
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


def test_a_singular_linear_map_is_refused_in_information_form_with_advice():
    with pytest.raises(DataError, match=r"projected component is not positive definite"):
        Problem.of(NullSpace(), Canonical()).step()


def test_an_operator_known_by_its_a_and_b():
    state = PlanarArm().state(Q.expand(2, 3))
    matrix, shift = np.array(CONSTANT.rows), np.array(CONSTANT.shift)
    assert_close(CONSTANT.linear(state, {}), np.stack((matrix, matrix)))
    assert_close(CONSTANT.offset(state, {}), np.stack((shift, shift)))
    problem = Problem.of(CONSTANT, Canonical())
    estimate = problem.step(fusion=CovarianceFusion(1e-2))
    q = Q.numpy()
    rows = [oracles.Row(np.eye(3), matrix, shift - q), oracles.Row(np.eye(3), np.eye(3), -q)]
    expected = problem.answer(rows, activation="time", epsilon=1e-2)
    assert_close(estimate.joints, expected.mean)
    assert_close(estimate.covariance, expected.covariance)


def test_a_joint_without_variance_of_its_own_gets_no_share():
    estimate = Problem.of(CONSTANT, Canonical()).step(fusion=CovarianceFusion(1e-2))
    constant, canonical = (candidate.share for candidate in estimate.candidates)
    assert bool((constant[:2] > 0).all())
    assert constant[2] == 0
    assert canonical[2] == 1


@pytest.mark.parametrize(
    ("operator", "fusion"), [(NullSpaceRows(), "information"), (NullSpace(), "covariance")]
)
def test_gradients_pass_through_operators_of_ones_own(operator, fusion):
    problem = Problem.of(PlanarPosition(), operator)
    regression = problem.regression(fusion=form(fusion, epsilon=1e-2, prior_std=2.0))

    def step(joints: Tensor) -> Tensor:
        return regression.estimate(NOW, regression.kinematics.state(joints), {}).joints

    assert torch.autograd.gradcheck(step, Q.clone().requires_grad_())


@pytest.mark.parametrize("kind", [RelativePosition, RelativeOrientation])
def test_what_is_no_name_is_given_by_name(kind):
    """The third value was ``held`` of one and the gain of the other."""
    refused(lambda: kind(LEFT, OBJECT, True), TypeError, "positional")
    assert kind(LEFT, OBJECT, held=True).links() == (LEFT, OBJECT)
    refused(lambda: kind(LEFT, OBJECT, held="no"), DataError, "held is True or False, got 'no'")
    refused(lambda: kind(LEFT, LEFT), DataError, f"'{LEFT}' seen from itself")


@pytest.mark.parametrize("gain", [math.nan, math.inf, 0.0, -2.0, True, "2"])
@pytest.mark.parametrize(
    "kind", [AbsoluteOrientation, partial(RelativeOrientation, frame=OBJECT)]
)
def test_a_gain_is_a_positive_number(gain, kind):
    refused(lambda: kind(LEFT, gain=gain), DataError, "gain is a positive number, got")


def test_nothing_counts_twice():
    one, other = AbsolutePosition(LEFT), Canonical()
    with pytest.raises(DataError, match="twice"):
        check_operators([Stack(one, AbsolutePosition(RIGHT)), one, other])
    assert check_operators([one, other]) == (one, other)

    @dataclass(frozen=True)
    class Weighted(AbsolutePosition):
        weights: np.ndarray | None = None

    own = [Weighted(LEFT, weights=np.full(3, weight)) for weight in (1.0, 2.0)]
    assert all(x is y for x, y in zip(check_operators(own), own, strict=True))

"""Forces beside poses: coordinates, no rows in joint space, and what refuses them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.support.pressing import LEAVE, PRESS, TOUCH, board, slides, wipes, wiping
from tests.support.refusals import refused
from tpgmm_control import Controller
from tpgmm_torch import Canonical, Frame, RelativePosition, Stack
from tpgmm_torch import TaskParameterizedGMM as Model
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.operators import Wrench
from tpgmm_torch.operators.text import format_operator, parse_operator

HAND = Wrench("hand", "board")


@pytest.fixture(scope="module")
def model():
    return wiping()


def test_coordinates_are_components_in_the_axes_of_the_frame_and_contact():
    turn, state = Rotation.random(random_state=1), slides().state(torch.zeros(50, 3))
    force = np.random.default_rng(0).normal(0, 1, (50, 6))
    state = replace(state, wrenches={"hand": torch.from_numpy(force)})
    frames = {"board": Frame([0.1, 0.2, 0.3], turn.as_quat()[[3, 0, 1, 2]])}
    local = Wrench("hand", "board", [0, 2]).coordinates(state, frames)
    expected = force[:, :3] @ turn.as_matrix()
    np.testing.assert_allclose(local[:, :2], expected[:, [0, 2]], atol=1e-12)
    np.testing.assert_array_equal(local[:, 2], np.linalg.norm(force[:, :3], axis=1) >= 1.5)


def test_expected_force_and_share_of_contact_follow_the_demonstrations(model):
    for time, force, share in ((0.7, 0, 0), ((TOUCH + LEAVE) / 2, -PRESS, 1), (5.3, 0, 0)):
        [expected] = model.skill.expected_forces(torch.tensor(time).double())
        assert float(expected.force) == pytest.approx(force, abs=0.2)
        assert float(expected.share) == pytest.approx(share, abs=0.02)


def test_joint_estimates_are_those_of_the_other_operators(model):
    whole = model.skill
    alone = replace(whole, operators=whole.operators[:2], conditionals=whole.conditionals[:2])
    state = slides().state(torch.tensor([[0.3, 0.0, 0.3]]))
    for time in torch.tensor([0.5, 3.0]).double():
        one, other = (each.estimate(time, state, {"board": board()}) for each in (whole, alone))
        assert torch.equal(one.joints, other.joints)
        assert torch.equal(one.covariance, other.covariance)
        assert len(whole.candidates(time, state, {"board": board()}, one)) == 2
    grid = torch.linspace(0, 5, 20).double()
    likelihoods = (
        skill.log_likelihood(grid, state, {"board": board()}) for skill in (whole, alone)
    )
    assert torch.equal(*likelihoods)


def test_without_wrenches_a_controller_runs_the_joints_alone(model):
    quiet = Controller(model.skill, [0.4, 0, 0.4], {"board": board()}, admittance=None)
    with pytest.warns(UserWarning, match="no wrench"):
        given = Controller(model.skill, [0.4, 0, 0.4], {"board": board()})
        given.step(0.01)
    quiet.step(0.01)
    for _ in range(50):
        assert torch.equal(given.step(0.01).reference, quiet.step(0.01).reference)
    assert given.contacts == {}


def test_text_of_an_operator():
    for text in ("wrench:hand@board", "wrench[z]:hand@board", "wrench[xz]:hand@board~0.2"):
        assert format_operator(parse_operator(text)) == text
    assert parse_operator("wrench[xz]:hand@board").axes == (0, 2)


def test_what_is_refused():
    own = Canonical(), RelativePosition("hand", "board")
    for operators, text in (
        ([HAND, *own], "behind at least one"),
        ([HAND], "behind at least one"),
        ([*own, Stack(HAND)], "behind at least one"),
        ([*own, HAND, HAND], "twice"),
        ([*own, Wrench("hand", "board", contact=50.0)], "never in contact"),
    ):
        refused(
            lambda operators=operators: Model(3, operators, slides()).fit(wipes()),
            DataError,
            text,
        )
    for axes in ([3], [], [1, 0], "z"):
        refused(lambda axes=axes: Wrench("hand", "board", axes), DataError, "axes")
    refused(lambda: Wrench("hand", "board", contact=0.0), DataError, "above 0")
    with pytest.raises(UnknownNameError, match="hand"):
        Wrench("hand", "board", [2]).coordinates(
            slides().state([0.0, 0, 0]), {"board": board()}
        )

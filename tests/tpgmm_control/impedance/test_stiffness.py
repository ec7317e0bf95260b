"""Stiffness from covariance: its optimality, its bounds, and what it does with odd input."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch
from torch import Tensor

from tests.support.worlds import upper_body
from tpgmm_control.impedance.stiffness import Impedance, Stiffness, geometric_mean
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError

#: Bounds so wide that they do not count.
FREE = {"lowest": 1e-9, "highest": 1e9}


def covariances(*shape: int, n: int = 5, seed: int = 0) -> Tensor:
    """Random, of standard deviations from 1 mrad to 0.3 rad."""
    rng = torch.Generator().manual_seed(seed)
    draw = torch.randn(*shape, n, n, generator=rng, dtype=torch.float64)
    turn, _ = torch.linalg.qr(draw)
    scales = torch.logspace(-3, -0.5, n, dtype=torch.float64)
    return turn @ torch.diag_embed(scales.square()) @ turn.mT


def within(low: Tensor, high: Tensor, rounding: float = 1e-9) -> bool:
    """Whether high - low is positive semi-definite."""
    return bool((torch.linalg.eigvalsh(high - low) >= -rounding).all())


def test_the_geometric_mean_solves_its_equation():
    a, b = covariances(3), covariances(3, seed=1)
    mean = geometric_mean(a, b)
    torch.testing.assert_close(mean, mean.mT)
    torch.testing.assert_close(mean @ torch.linalg.inv(a) @ mean, b, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(mean, geometric_mean(b, a), rtol=1e-6, atol=1e-9)


def test_without_bounds_it_is_the_linear_quadratic_regulator():
    # of the double integrator with unit inertia, for a cost of control that is isotropic
    covariance, effort = covariances() + 1e-4 * torch.eye(5), 3.0
    rule = Stiffness(**FREE, effort=effort, inertia=1.0)
    n = len(covariance)
    zero, one = np.zeros((n, n)), np.eye(n)
    a, b = np.block([[zero, one], [zero, zero]]), np.vstack((zero, one))
    precision = np.linalg.inv(covariance.numpy())
    q = scipy.linalg.block_diag((precision + precision.T) / 2, zero)
    r = one / effort**2
    gain = np.linalg.solve(r, b.T @ scipy.linalg.solve_continuous_are(a, b, q, r))
    stiffness = rule.matrix(covariance)
    np.testing.assert_allclose(stiffness, gain[:, :n], rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(rule.damping(stiffness), gain[:, n:], rtol=1e-5, atol=1e-3)


def test_each_coordinate_answers_a_deviation_with_its_effort():
    deviation, effort = torch.tensor([0.001, 0.1], dtype=torch.float64), (2.0, 5.0)
    stiffness = Stiffness(**FREE, effort=effort).matrix(deviation.square().diag())
    expected = torch.tensor(effort, dtype=torch.float64)
    # the bound is a spring in series, 2e-6 of whose compliance is the other's
    torch.testing.assert_close(stiffness @ deviation, expected, rtol=1e-5, atol=0)


def test_it_keeps_within_its_bounds_in_every_direction():
    low, high = (1.0, 2.0, 3.0, 4.0, 5.0), (100.0, 300.0, 3.0, 200.0, 50.0)
    rule = Stiffness(low, high, effort=(0.1, 1.0, 1.0, 10.0, 1.0))
    covariance = torch.cat([covariances(20) * scale for scale in (1e-8, 1.0, 1e8)])
    stiffness = rule.matrix(covariance)
    lowest, highest = torch.tensor((low, high), dtype=torch.float64).diag_embed()
    torch.testing.assert_close(stiffness, stiffness.mT)
    assert within(lowest.expand_as(stiffness), stiffness)
    assert within(stiffness, highest.expand_as(stiffness))
    firm, loose = stiffness[:20], stiffness[40:]
    torch.testing.assert_close(firm, highest.expand_as(firm), rtol=0.2, atol=1.0)
    torch.testing.assert_close(loose, lowest.expand_as(loose), rtol=0.1, atol=0.1)


def test_the_more_demonstrations_agree_the_stiffer():
    rule, covariance = Stiffness(), covariances(10)
    more = covariance + covariances(10, seed=2)
    assert within(rule.matrix(more), rule.matrix(covariance))


def test_directions_without_variance_are_as_stiff_as_may_be():
    rule = Stiffness(lowest=1.0, highest=50.0)
    singular = torch.diag(torch.tensor([0.0, 1e12], dtype=torch.float64))
    torch.testing.assert_close(
        rule.matrix(singular), torch.diag(torch.tensor([50.0, 1.0], dtype=torch.float64)),
        rtol=0, atol=1e-5,
    )  # fmt: skip
    torch.testing.assert_close(rule.matrix(0 * singular), 50 * torch.eye(2).double())


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_known_is_soft_and_spares_the_others(value):
    covariance = covariances(3)
    expected = Stiffness().matrix(covariance)
    covariance[1, 2, 3] = value
    stiffness = Stiffness().matrix(covariance)
    torch.testing.assert_close(stiffness[[0, 2]], expected[[0, 2]])
    torch.testing.assert_close(stiffness[1], 5 * torch.eye(5).double())


def test_a_robot_of_a_batch_is_the_robot_alone():
    covariance = covariances(64)
    both = Stiffness().matrix(covariance)
    alone = torch.stack([Stiffness().matrix(one) for one in covariance])
    torch.testing.assert_close(both, alone, rtol=1e-9, atol=1e-9)
    assert both.dtype == torch.float64
    assert Stiffness().matrix(covariance.float()).dtype == torch.float32


def ratio(a: Tensor, b: Tensor) -> Tensor:
    """Thompson's distance: the largest absolute logarithm of x'a x / x'b x over all x."""
    factor = torch.linalg.cholesky(b)
    left = torch.linalg.solve_triangular(factor, a, upper=False)
    inner = torch.linalg.solve_triangular(factor, left.mT, upper=False)
    return torch.linalg.eigvalsh(inner).log().abs().amax(-1)


def test_it_changes_at_most_half_as_fast_as_the_covariance():
    one, other = covariances(30), covariances(30, seed=3)
    rule = Stiffness(lowest=1.0, highest=(50.0, 100.0, 200.0, 400.0, 800.0))
    for share in (1e-3, 0.1, 1.0):
        later = (1 - share) * one + share * other
        change = ratio(rule.matrix(one), rule.matrix(later))
        assert (change <= 0.5 * ratio(one, later) + 1e-9).all()


def test_modes_have_the_damping_ratio():
    rule = Stiffness(inertia=1.0, damping_ratio=0.6)
    inertia, stiffness = covariances(4, seed=4), rule.matrix(covariances(4))
    damping = rule.damping(stiffness, inertia)
    for m, d, k in zip(inertia.numpy(), damping.numpy(), stiffness.numpy(), strict=True):
        squares, modes = scipy.linalg.eigh(k, m)
        modal = modes.T @ d @ modes
        np.testing.assert_allclose(modal, np.diag(1.2 * np.sqrt(squares)), rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(
        rule.damping(stiffness), rule.damping(stiffness, torch.eye(5).double())
    )
    diagonal = torch.tensor([4.0, 9.0], dtype=torch.float64)
    torch.testing.assert_close(
        rule.damping(diagonal.diag()).diagonal(), rule.diagonal_damping(diagonal)
    )


def test_a_link_is_stiff_where_the_joints_leave_its_pose_no_freedom():
    robot = upper_body()
    impedance = Impedance(robot)
    joints = torch.full((2, robot.n_joints), 0.2, dtype=torch.float64)
    state = robot.state(joints)
    jacobian = state.linear_jacobian("l_hand")
    # the joints vary freely, but for what moves the hand up and down
    up = jacobian[..., 2:, :]
    precision = torch.eye(robot.n_joints) / 0.3**2 + up.mT @ up / 1e-3**2
    stiffness = impedance.at_link("l_hand", joints, torch.linalg.inv(precision))
    assert stiffness.shape == (2, 6, 6)
    assert (stiffness[..., 2, 2] > 5 * stiffness[..., 0, 0]).all()
    lowest, highest = torch.tensor(impedance.link.lowest), torch.tensor(impedance.link.highest)
    assert within(lowest.diag().expand_as(stiffness), stiffness)
    assert within(stiffness, highest.diag().expand_as(stiffness))
    with pytest.raises(UnknownNameError, match=r"'foot'.*l_hand"):
        impedance.at_link("foot", joints, torch.linalg.inv(precision))


def test_numbers_that_cannot_be_are_refused():
    for wrong in ({"lowest": 0.0}, {"effort": math.nan}, {"inertia": (1.0, -1.0)}):
        with pytest.raises(DataError, match=f"{next(iter(wrong))} is above 0 and finite, got"):
            Stiffness(**wrong)
    with pytest.raises(DataError, match=r"highest is not below lowest, got.*20.*10"):
        Stiffness(lowest=20.0, highest=10.0)
    with pytest.raises(ShapeError, match=r"lengths differ.*2.*3"):
        Stiffness(lowest=(1.0,) * 2, highest=(2.0,) * 3)
    with pytest.raises(ShapeError, match="effort has 2 numbers for 17 coordinates"):
        Impedance(upper_body(), Stiffness(effort=(1.0, 2.0)))
    with pytest.raises(ShapeError, match="highest has 3 numbers for 6 coordinates"):
        Impedance(upper_body(), link=Stiffness(highest=(50.0,) * 3))

"""The tracker against dense least squares, scipy, and the stiffness of its endless limit."""

import numpy as np
import pytest
import scipy.linalg
import torch
from torch import Tensor

from tests.support.skills import bottle_demonstrations, small_bottle
from tpgmm_torch import Situation
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.impedance.linear_quadratic import LinearDynamics, TrackingPlan, stationary_cost
from tpgmm_torch.impedance.stiffness import Stiffness

DT = 0.05


def drawn(*shape: int, seed: int = 0) -> Tensor:
    rng = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def definite(*shape: int, n: int, seed: int = 0) -> Tensor:
    root = drawn(*shape, n, n, seed=seed)
    return root @ root.mT + 0.1 * torch.eye(n)


def least_squares(dynamics, targets, costs, control_cost, start) -> Tensor:
    """Controls (T, m) of least cost over states 0 to T, all of them solved for at once.

    ``targets`` and ``costs`` are of T + 1 states.
    """
    a, b = dynamics.transition.numpy(), dynamics.control.numpy()
    length, d = len(targets) - 1, a.shape[0]
    power = [np.linalg.matrix_power(a, k) for k in range(length + 1)]
    free = np.concatenate([power[t] @ start.numpy() for t in range(length + 1)])
    forced = np.block(
        [
            [power[t - 1 - s] @ b if s < t else np.zeros_like(b) for s in range(length)]
            for t in range(length + 1)
        ]
    )
    roots = [np.linalg.cholesky(r.numpy() + 1e-14 * np.eye(d)).T for r in costs]
    weight = scipy.linalg.block_diag(*roots)
    effort = np.kron(np.eye(length), np.linalg.cholesky(control_cost.numpy()).T)
    left = np.vstack((weight @ forced, effort))
    right = np.concatenate((weight @ (targets.numpy().ravel() - free), np.zeros(len(effort))))
    return torch.from_numpy(np.linalg.lstsq(left, right, rcond=None)[0].reshape(length, -1))


def followed(plan: TrackingPlan, dynamics: LinearDynamics, start: Tensor, steps: int):
    """Controls (steps, ..., m) and states (steps + 1, ..., d)."""
    states, controls = [start], []
    for t in range(steps):
        control = plan.control(t, states[-1])
        controls.append(control)
        states.append(
            (
                dynamics.transition @ states[-1][..., None]
                + dynamics.control @ control[..., None]
            )[..., 0]
        )
    return torch.stack(controls), torch.stack(states)


@pytest.mark.parametrize("hold", [False, True])
def test_its_controls_are_those_of_least_squares(hold):
    dynamics = LinearDynamics(torch.eye(3) + 0.2 * drawn(3, 3), drawn(3, 2, seed=1))
    if hold:
        dynamics = LinearDynamics.double_integrator(2, DT)
    d, length = len(dynamics.transition), 12
    targets, costs = drawn(length, d, seed=2), definite(length, n=d, seed=3)
    targets[-1, d // 2 :] = 0
    r, start = definite(n=2, seed=4), drawn(d, seed=5)
    plan = TrackingPlan.of(dynamics, targets, costs, r, hold=hold)
    controls, _ = followed(plan, dynamics, start, length)
    after = torch.zeros(d, d, dtype=torch.float64)
    if hold:
        a, b = dynamics.transition.numpy(), dynamics.control.numpy()
        after = torch.from_numpy(scipy.linalg.solve_discrete_are(a, b, costs[-1].numpy(), r))
    expected = least_squares(
        dynamics,
        torch.cat((targets, targets[-1:])),
        torch.cat((costs, after[None])),
        r,
        start,
    )
    torch.testing.assert_close(controls, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e8])
def test_the_stationary_cost_is_that_of_scipy(scale):
    for dynamics in (
        LinearDynamics.double_integrator(3, 0.01),
        LinearDynamics(1.2 * drawn(6, 6), drawn(6, 3, seed=1)),
    ):
        q, r = scale * definite(n=6, seed=2), definite(n=3, seed=3)
        a, b = dynamics.transition.numpy(), dynamics.control.numpy()
        expected = scipy.linalg.solve_discrete_are(a, b, q.numpy(), r.numpy())
        error = stationary_cost(dynamics, q, r).numpy() - expected
        assert np.abs(error).max() < 1e-7 * np.abs(expected).max()


def test_a_long_horizon_comes_to_the_stationary_gain():
    dynamics = LinearDynamics.double_integrator(2, DT)
    q, r = torch.diag(torch.tensor([4.0, 1.0, 0.0, 0.0]).double()), 0.01 * torch.eye(2).double()
    path = torch.zeros(400, 4, dtype=torch.float64)
    ends, held = (
        TrackingPlan.of(dynamics, path, q.expand(400, 4, 4), r, hold) for hold in (False, True)
    )
    a, b = dynamics.transition.numpy(), dynamics.control.numpy()
    p = scipy.linalg.solve_discrete_are(a, b, q.numpy(), r.numpy())
    gain = torch.from_numpy(np.linalg.solve(r.numpy() + b.T @ p @ b, b.T @ p @ a))
    torch.testing.assert_close(ends.gains[0], gain, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(held.gains, gain.expand_as(held.gains), rtol=1e-6, atol=1e-6)
    assert ends.gains[-1].abs().max() == 0  # nothing counts after it
    assert held.feedforward.abs().max() == 0


def test_without_end_it_is_as_stiff_as_the_rule_says():
    covariance = 1e-4 * definite(n=3)
    path = torch.zeros(2, 3, dtype=torch.float64)
    plan = TrackingPlan.along(path, covariance.expand(2, 3, 3), dt=1e-4, effort=2.0)
    rule = Stiffness(lowest=1e-9, highest=1e9, effort=2.0, inertia=1.0)
    stiffness = rule.matrix(covariance)
    expected = torch.cat((stiffness, rule.damping(stiffness)), -1)
    torch.testing.assert_close(plan.gains[-1], expected, rtol=5e-3, atol=1e-2)


def test_paths_of_a_batch_are_the_paths_alone():
    joints = drawn(5, 20, 2).cumsum(1) * 0.05
    covariance = 1e-3 * definite(5, 20, n=2, seed=1)
    both = TrackingPlan.along(joints, covariance, DT)
    for row in range(5):
        alone = TrackingPlan.along(joints[row], covariance[row], DT)
        torch.testing.assert_close(both.gains[row], alone.gains, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(
            both.feedforward[row], alone.feedforward, rtol=1e-9, atol=1e-9
        )
    start = torch.zeros(5, 4, dtype=torch.float64)
    assert both.control(3, start).shape == (5, 2)
    torch.testing.assert_close(both.control(99, start), both.control(19, start))


def test_a_reproduction_is_followed_where_it_is_precise():
    recorded = bottle_demonstrations()[6]
    situation = Situation(recorded.joints[0], recorded.frames)
    [path] = small_bottle().predict([situation], candidates=False)
    dt = float(path.time[1] - path.time[0])
    plan = TrackingPlan.along(path.joints, path.covariance, dt, effort=10.0)
    dynamics = LinearDynamics.double_integrator(17, dt)
    start = torch.cat((path.joints[0] + 0.05, torch.zeros(17))).double()
    controls, states = followed(plan, dynamics, start, len(path) + 50)
    errors = states[: len(path), :17] - path.joints
    deviations = torch.linalg.solve_triangular(
        torch.linalg.cholesky(path.covariance), errors[..., None], upper=False
    )
    assert deviations[len(path) // 4 :].square().mean() < 0.2
    torch.testing.assert_close(states[-1, :17], path.joints[-1], rtol=0, atol=1e-3)
    # errors that demonstrations have as well cost less to leave alone
    firm = path.covariance / 100
    firmer = TrackingPlan.along(path.joints, firm, dt, effort=10.0)
    more, _ = followed(firmer, dynamics, start, len(path))
    assert controls[: len(path)].square().sum() < 0.5 * more.square().sum()


def test_it_is_differentiable():
    joints = (0.1 * drawn(6, 2)).requires_grad_()
    covariance = (0.01 * definite(6, n=2)).requires_grad_()
    plan = TrackingPlan.along(joints, covariance, DT)
    plan.control(0, torch.zeros(4, dtype=torch.float64)).sum().backward()
    assert joints.grad.isfinite().all() and covariance.grad.abs().sum() > 0


def test_what_does_not_fit_is_refused():
    path, covariance = drawn(5, 2), definite(5, n=2)
    with pytest.raises(ShapeError, match=r"\(5, 2, 2\), got \(4, 2, 2\)"):
        TrackingPlan.along(path, covariance[:4], DT)
    for wrong in ({"dt": 0.0}, {"dt": DT, "effort": -1.0}):
        with pytest.raises(DataError, match="is above 0 and finite, got"):
            TrackingPlan.along(path, covariance, **wrong)
    with pytest.raises(DataError, match="the covariance of the path is not positive definite"):
        TrackingPlan.along(path, 0 * covariance, DT)
    with pytest.raises(ShapeError, match=r"A of shape \(..., d, d\).*\(2, 3\)"):
        LinearDynamics(drawn(2, 3), drawn(2, 1))
    dynamics, r = LinearDynamics.double_integrator(1, DT), torch.eye(1).double()
    with pytest.raises(DataError, match=r"does not rest.*hold=False"):
        TrackingPlan.of(dynamics, torch.ones(3, 2).double(), definite(3, n=2), r)
    with pytest.raises(ShapeError, match="for 2 states"):
        TrackingPlan.of(dynamics, torch.ones(3, 4).double(), definite(3, n=4), r)
    runaway = LinearDynamics(2 * torch.eye(2).double(), torch.zeros(2, 1).double())
    with pytest.raises(DataError, match="there is no stationary cost"):
        stationary_cost(runaway, torch.eye(2).double(), r)

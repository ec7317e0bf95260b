"""The pass over the points: both formulations and the gate against dense EM in float64."""

import numpy as np
import pytest
import torch

from tests.support.em_reference import (
    WIDTHS,
    assert_same_mixture,
    binned,
    columns,
    family,
    movements,
    reference_joint,
    reference_step,
    standardized,
)
from tpgmm_torch.em import sufficient_statistics
from tpgmm_torch.em.ascent import maximize
from tpgmm_torch.em.block_gaussians import Parameters, Whitener
from tpgmm_torch.em.component_gating import Gate, Selection
from tpgmm_torch.em.e_step import Workspace, expect
from tpgmm_torch.em.reseeding import worst_points

K = 8


def random_data():
    rng = np.random.RandomState(1)
    centers = 3 * rng.randn(K, 7)
    return centers[rng.randint(0, K, 6000)] + rng.randn(6000, 7) @ rng.randn(7, 7)


def badly_scaled():
    return movements() * 10.0 ** np.arange(-4, 3) * [1, 1, 1, 1, 1, 1, 100] + 1e4


def nearly_singular():
    X = movements(noise=1e-5)
    X[:, 2] = X[:, 1] + 1e-5 * np.random.RandomState(2).randn(len(X))
    return X


DATA = {"random": random_data, "badly scaled": badly_scaled, "singular": nearly_singular}


@pytest.mark.parametrize("kept", [True, False], ids=["kept", "anew"])
@pytest.mark.parametrize("form", ["packed", "whitened"])
@pytest.mark.parametrize("name", DATA)
def test_iterations_equal_the_reference(name, form, kept, monkeypatch):
    monkeypatch.setattr(sufficient_statistics, "MOST_KEPT", 2**23 if kept else 0)
    monkeypatch.setattr(sufficient_statistics, "MANY_COMPONENTS", 0)
    if form == "whitened":
        monkeypatch.setattr(sufficient_statistics, "MANY_POINTS", 10**9)
    points, units = standardized(DATA[name]())
    lambdas = family(units)
    blocks = columns(points)
    parameters = binned(points, lambdas, K)
    workspace, previous = Workspace(points), ()
    for _ in range(6):
        expected, bound = reference_step(parameters, blocks, lambdas)
        previous = expect([parameters], points, workspace=workspace, previous=previous)
        assert previous[0].bound == pytest.approx(bound, rel=1e-9, abs=1e-9)
        parameters = maximize(previous[0], lambdas, floored=False)
        assert_same_mixture(parameters, expected)


@pytest.mark.parametrize("covariance_type", ["full", "tied", "diag", "spherical"])
@pytest.mark.parametrize("group_size", [1, 5])
def test_all_families_and_groups_equal_the_reference(covariance_type, group_size):
    points, units = standardized(movements(), group_size=group_size)
    lambdas = family(units, covariance_type=covariance_type)
    blocks = columns(points)
    parameters = lambdas.admit(binned(points, lambdas, K))
    workspace, previous = Workspace(points), ()
    for _ in range(4):
        expected, bound = reference_step(parameters, blocks, lambdas, group_size)
        previous = expect(
            [parameters],
            points,
            group_size=group_size,
            workspace=workspace,
            previous=previous,
        )
        assert previous[0].bound == pytest.approx(bound, rel=1e-9)
        parameters = maximize(previous[0], lambdas, floored=False)
        assert_same_mixture(parameters, expected)


def constant_time():
    X = movements()
    X[:, [0, 3]] = 7.0
    return X


def outliers():
    X = movements()
    X[[100, 3000], 1] = 1e3
    X[17, 0] = -50.0
    return X


def time_runs_backwards_in_the_other_block():
    X = movements()
    X[:, 3] = X[::-1, 3]
    return X


def two_clocks():
    """Points at two instants only."""
    X = movements()
    X[:, [0, 3]] = np.round(X[:, [0, 3]])
    return X


def shuffled():
    return np.random.RandomState(0).permutation(movements())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize(
    "data",
    [movements, constant_time, outliers, two_clocks, shuffled,
     time_runs_backwards_in_the_other_block, badly_scaled, nearly_singular],
)  # fmt: skip
def test_the_gate_does_not_show(data, dtype, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.em.block_gaussians.CHUNK_SIZE", {"cpu": 2**13})
    points, units = standardized(data(), dtype)
    lambdas = family(units, dtype=dtype)
    parameters = binned(points, lambdas, K)
    workspace, previous = Workspace(points), ()
    tolerance = {torch.float64: 1e-9, torch.float32: 1e-5}[dtype]
    for _ in range(8):
        previous = expect([parameters], points, workspace=workspace, previous=previous)
        [dense] = expect([parameters], points)
        [gated] = previous
        assert gated.bound == pytest.approx(dense.bound, rel=tolerance, abs=tolerance)
        after = [maximize(one, lambdas, floored=False) for one in (gated, dense)]
        assert_same_mixture(*after, tolerance)
        parameters = after[0]


def selections(points, parameters, count=3):
    """What the gate chooses in each chunk after some passes."""
    workspace, previous = Workspace(points), ()
    for _ in range(count):
        previous = expect([parameters], points, workspace=workspace, previous=previous)
    peaks = Whitener(parameters, torch.float64).peaks[None]
    guess = previous[0].least[:, None]
    return list(workspace.gate.selections(parameters, peaks, guess)), previous[0].least


def test_along_time_most_components_are_left_out(monkeypatch):
    monkeypatch.setattr("tpgmm_torch.em.block_gaussians.CHUNK_SIZE", {"cpu": 2**12})
    points, units = standardized(movements())
    parameters = binned(points, family(units), 20)
    chosen = [s.components for s in selections(points, parameters)[0]]
    assert np.mean([20 if one is None else len(one) for one in chosen]) < 10
    points, _ = standardized(shuffled())
    assert all(s.components is None for s in selections(points, parameters)[0])


@pytest.mark.parametrize("data", [movements, outliers, badly_scaled, shuffled])
def test_ceilings_hold_and_what_is_left_out_is_negligible(data, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.em.block_gaussians.CHUNK_SIZE", {"cpu": 2**12})
    points, units = standardized(data())
    parameters = binned(points, family(units), K)
    chosen, least = selections(points, parameters)
    for chunk, selection, lowest in zip(points, chosen, least, strict=True):
        joint = reference_joint(parameters, [block[:-1].T for block in chunk])
        slack = 1e-9 * joint.abs().max()
        assert (joint.amax(0) <= selection.ceilings[0] + slack).all()
        assert float(torch.logsumexp(joint, 1).min()) == pytest.approx(float(lowest), rel=1e-9)
        if selection.components is not None:
            left_out = torch.ones(K, dtype=torch.bool)
            left_out[selection.components] = False
            responsibilities = torch.softmax(joint, 1)[:, left_out]
            assert float(responsibilities.max()) < 3e-16


def test_a_wrong_guess_is_found_and_done_again(monkeypatch):
    monkeypatch.setattr("tpgmm_torch.em.block_gaussians.CHUNK_SIZE", {"cpu": 2**12})
    again = []
    above = Selection.above
    monkeypatch.setattr(
        Selection, "above", lambda *arguments: again.append(1) or above(*arguments)
    )
    points, units = standardized(movements())
    lambdas = family(units)
    narrow = binned(points, lambdas, 20)
    workspace = Workspace(points)
    previous = expect([narrow], points, workspace=workspace)
    # the other mixture explains the same points far worse than the gate was told
    moved = tuple(mean + 0.5 for mean in narrow.means)
    other = Parameters(narrow.weights, moved, narrow.factors)
    [gated] = expect([other], points, workspace=workspace, previous=previous)
    [dense] = expect([other], points)
    assert again
    assert gated.bound == pytest.approx(dense.bound, rel=1e-9)
    for own, expected in zip(gated.moments, dense.moments, strict=True):
        torch.testing.assert_close(own, expected, rtol=1e-9, atol=1e-9)


def test_a_box_is_measured_once():
    gate = Gate()
    chunk = (torch.tensor([[0.0, 2.0], [1.0, 1.0]]), torch.tensor([[5.0, -1.0], [1.0, 1.0]]))
    gate.record(0, chunk)
    gate.record(0, (chunk[0] * 9, chunk[1] * 9))
    unit = Parameters.standard(2, (1, 1))
    far = Parameters(unit.weights, (unit.means[0] + 12.0, unit.means[1]), unit.factors)
    peaks = Whitener(far, torch.float64).peaks[None]
    [selection] = gate.selections(far, peaks, torch.zeros(1, 1, dtype=torch.float64))
    torch.testing.assert_close(selection.ceilings, peaks - 50.0)


@pytest.mark.parametrize("narrow", [1e-1, 1e-2, 1e-3])
def test_float32_keeps_narrow_covariances(narrow):
    """Components with sigma / range down to 1e-3, narrow in rotated directions."""
    rng = np.random.RandomState(0)
    time = np.sort(rng.rand(20_000))
    plane = np.linalg.qr(rng.randn(7, 7))[0]
    X = np.stack([np.sin((i + 1) * 3 * time + i) for i in range(7)], 1)
    X += 2 * narrow * (rng.randn(len(X), 7) * [1, 1, 1, 3, 3, 3, 3]) @ plane
    X = X.astype(np.float32).astype(np.float64)
    results = []
    for dtype in (torch.float64, torch.float32):
        points, units = standardized(X, dtype)
        lambdas = family(units, 2e-6)
        parameters = binned(standardized(X)[0], lambdas, 40)
        workspace, previous = Workspace(points), ()
        for _ in range(3):
            previous = expect([parameters], points, workspace=workspace, previous=previous)
            parameters = maximize(previous[0], lambdas, floored=False)
        results.append((parameters, previous[0].bound))
    (exact, bound), (single, other) = results
    assert other == pytest.approx(bound, rel=1e-4)
    for factor, covariance in zip(exact.factors, single.covariances, strict=True):
        inverse = torch.linalg.inv(factor)
        seen = inverse @ covariance @ inverse.mT  # the identity, if they agree
        assert float((seen - torch.eye(len(seen[0]))).abs().max()) < 1e-4


def test_worst_points_are_the_worst(monkeypatch):
    monkeypatch.setattr("tpgmm_torch.em.block_gaussians.CHUNK_SIZE", {"cpu": 2**10})
    points, units = standardized(movements())
    parameters = binned(points, family(units), K)
    blocks = columns(points)
    density = torch.logsumexp(reference_joint(parameters, blocks), 1)
    expected = torch.cat(blocks, 1)[density.argsort()[:300]]
    torch.testing.assert_close(worst_points(parameters, points, 300), expected)
    assert worst_points(parameters, points, 10**5).shape == (points.total, sum(WIDTHS))


@pytest.mark.parametrize("shift", [0.0, 3.0], ids=["good start", "poor start"])
def test_the_first_pass_leaves_components_out_too(shift, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.em.block_gaussians.CHUNK_SIZE", {"cpu": 2**12})
    evaluated = []
    joint = sufficient_statistics.PackedStatistics.joint
    monkeypatch.setattr(
        sufficient_statistics.PackedStatistics,
        "joint",
        lambda self, chosen: evaluated.append(chosen) or joint(self, chosen),
    )
    points, units = standardized(movements())
    start = binned(points, family(units), 20)
    start = Parameters(start.weights, tuple(m + shift for m in start.means), start.factors)
    [dense] = expect([start], points)
    assert all(chosen is None for chosen in evaluated)
    evaluated.clear()
    [gated] = expect([start], points, workspace=Workspace(points))
    if shift:  # the guess fails, and that is noticed
        assert len(evaluated) > len(list(points))
    else:
        assert sum(len(chosen) < 20 for chosen in evaluated if chosen is not None) > 0
    assert gated.bound == pytest.approx(dense.bound, rel=1e-9)
    for own, expected in zip(gated.moments, dense.moments, strict=True):
        torch.testing.assert_close(own, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("components", "kept", "copies", "packed"),
    [(8, True, 1, True), (8, False, 1, False), (40, False, 1, True), (8, False, 5, True)],
    ids=["kept", "few components", "many components", "restarts"],
)
def test_products_are_made_where_they_pay(components, kept, copies, packed, monkeypatch):
    if not kept:
        monkeypatch.setattr(sufficient_statistics, "MOST_KEPT", 0)
    used = []
    for form in ("Packed", "Whitened"):
        make = getattr(sufficient_statistics, f"{form}Statistics")
        monkeypatch.setattr(
            f"tpgmm_torch.em.e_step.{form}Statistics",
            lambda *given, make=make, form=form: used.append(form) or make(*given),
        )
    points, units = standardized(random_data())
    expect([binned(points, family(units), components)] * copies, points)
    assert used == ["Packed" if packed else "Whitened"] * (1 if packed else copies)

"""The gate: its bounds hold, what it leaves out is negligible, and a wrong guess is noticed."""

import numpy as np
import pytest
import torch

from tests.support.em_reference import (
    binned,
    family,
    movements,
    one,
    reference_joint,
    standardized,
)
from tpgmm_torch.em import sufficient_statistics
from tpgmm_torch.em.component_gating import Gate, Selection
from tpgmm_torch.em.e_step import e_step
from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.em.whitening import Whitener

K = 8
EPS = torch.finfo(torch.float64).eps


def badly_scaled():
    return movements() * 10.0 ** np.arange(-4, 3) * [1, 1, 1, 1, 1, 1, 100] + 1e4


def outliers():
    X = movements()
    X[[100, 3000], 1] = 1e3
    X[17, 0] = -50.0
    return X


def shuffled():
    return np.random.RandomState(0).permutation(movements())


def selections(points, parameters, count=3):
    """What the gate chooses in each chunk after some passes."""
    gate, previous = Gate(), None
    for _ in range(count):
        previous = e_step(one(parameters), points, gate=gate, previous=previous)
    peaks = Whitener(parameters, torch.float64).peaks[None]
    found = list(gate.selections(one(parameters), peaks, previous.least))
    return found, previous.least[0]


def test_along_time_most_components_are_left_out(monkeypatch):
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": 2**12})
    points, units = standardized(movements())
    parameters = binned(points, family(units), 20)
    chosen = [s.components for s in selections(points, parameters)[0]]
    assert np.mean([20 if one is None else len(one) for one in chosen]) < 10
    points, _ = standardized(shuffled())
    assert all(s.components is None for s in selections(points, parameters)[0])


@pytest.mark.parametrize("data", [movements, outliers, badly_scaled, shuffled])
def test_ceilings_hold_and_what_is_left_out_is_negligible(data, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": 2**12})
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
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": 2**12})
    again = []
    above = Selection.above
    monkeypatch.setattr(
        Selection, "above", lambda *arguments: again.append(1) or above(*arguments)
    )
    points, units = standardized(movements())
    lambdas = family(units)
    narrow = binned(points, lambdas, 20)
    gate = Gate()
    previous = e_step(one(narrow), points, gate=gate)
    # the other mixture explains the same points far worse than the gate was told
    moved = tuple(mean + 0.5 for mean in narrow.means)
    other = Parameters(narrow.weights, moved, narrow.factors)
    gated = e_step(one(other), points, gate=gate, previous=previous)
    dense = e_step(one(other), points)
    assert again
    assert float(gated.bound) == pytest.approx(float(dense.bound), rel=1e-9)
    for own, expected in zip(gated.moments, dense.moments, strict=True):
        torch.testing.assert_close(own, expected, rtol=1e-9, atol=1e-9)


def unit(n_components, mean=0.0):
    """Standard normals in two blocks of one column, the first shifted."""
    ones = torch.ones(n_components, 1, 1, dtype=torch.float64)
    means = (ones[:, 0] * mean, ones[:, 0] * 0)
    weights = torch.full((n_components,), 1 / n_components, dtype=torch.float64)
    return Parameters(weights, means, (ones, ones))


def test_a_box_is_measured_once():
    gate = Gate()
    chunk = (torch.tensor([[0.0, 2.0], [1.0, 1.0]]), torch.tensor([[5.0, -1.0], [1.0, 1.0]]))
    gate.record(0, chunk)
    gate.record(0, (chunk[0] * 9, chunk[1] * 9))
    far = unit(2, 12.0)
    peaks = Whitener(far, torch.float64).peaks[None]
    [selection] = gate.selections(one(far), peaks, torch.zeros(1, 1, dtype=torch.float64))
    torch.testing.assert_close(selection.ceilings, peaks - 50.0)


def test_many_boxes_keep_their_order():
    gate, mixture = Gate(), unit(2)
    for index in range(130):
        column = torch.tensor([[float(index)] * 2, [1.0, 1.0]])
        gate.record(index, (column, 0 * column))
    peaks = Whitener(mixture, torch.float64).peaks[None]
    found = list(gate.selections(one(mixture), peaks))
    assert len(found) == 130
    for index, selection in enumerate(found):
        torch.testing.assert_close(selection.ceilings, peaks - index**2 / 2)


def test_mixtures_have_the_same_number_of_components_in_a_chunk():
    """Of S mixtures each its best ones; as many as the one that needs most."""
    ceilings = torch.tensor([[0.0, -100.0, -1.0, -2.0], [-200.0, -300.0, 5.0, -300.0]])
    selection = Selection.above(ceilings, [-3.0, 4.0])
    assert selection.components.tolist() == [0, 2, 3, 6, 4, 5] or (
        set(selection.components[:3].tolist()) == {0, 2, 3}
        and {6, 4} <= set(selection.components[3:].tolist())
    )
    assert Selection.above(ceilings, [-100.0, 4.0]).components is None


def test_a_selection_holds_while_no_point_is_less_likely():
    ceilings = torch.tensor([[0.0, -100.0], [0.0, -100.0]])
    selection = Selection.above(ceilings, [-3.0, -4.0])
    assert selection.holds([-3.0, -4.0])
    assert not selection.holds([-3.0, -4.1])
    assert not selection.holds([-3.1, 0.0])
    assert Selection(ceilings, [0.0, 0.0], None).holds([-9.0, -9.0])


@pytest.mark.parametrize("shift", [0.0, 3.0], ids=["good start", "poor start"])
@pytest.mark.parametrize("packed", [True, False], ids=["packed", "whitened"])
def test_the_first_pass_leaves_components_out_too(packed, shift, monkeypatch):
    """Packed moments are off by eps * sharpness of their component's mass."""
    monkeypatch.setattr("tpgmm_torch.em.points.CHUNK_SIZE", {"cpu": 2**12})
    monkeypatch.setattr(sufficient_statistics, "MANY_COMPONENTS", 0 if packed else 10**9)
    evaluated = []
    form = "PackedStatistics" if packed else "WhitenedStatistics"
    kind = getattr(sufficient_statistics, form)
    log_joint = kind.log_joint
    monkeypatch.setattr(
        kind,
        "log_joint",
        lambda self, chunk, chosen: evaluated.append(chosen) or log_joint(self, chunk, chosen),
    )
    points, units = standardized(movements())
    start = binned(points, family(units), 20)
    start = Parameters(start.weights, tuple(m + shift for m in start.means), start.factors)
    dense = e_step(one(start), points)
    assert all(chosen is None for chosen in evaluated)
    evaluated.clear()
    gated = e_step(one(start), points, gate=Gate())
    if shift:  # the guess fails, and that is noticed
        assert len(evaluated) > len(list(points))
    else:
        assert sum(len(chosen) < 20 for chosen in evaluated if chosen is not None) > 0
    assert float(gated.bound) == pytest.approx(float(dense.bound), rel=1e-9)
    sharpness = sufficient_statistics.sharpness(Whitener(start, torch.float64))
    lost = float(sharpness.max()) if packed else float(sharpness.max()) ** 0.5
    lost = max(lost, abs(float(dense.bound)))  # log-densities are rounded, too
    for own, expected in zip(gated.moments, dense.moments, strict=True):
        assert (own - expected).abs().max() < 16 * EPS * lost * expected.abs().max()

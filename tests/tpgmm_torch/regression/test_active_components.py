"""Windows of time and the components that count in them."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tpgmm_torch.regression import active_components
from tpgmm_torch.regression.active_components import ActiveComponents
from tpgmm_torch.regression.conditionals import TimeMarginals


def marginals(seed: int, k: int = 12) -> TimeMarginals:
    rng = np.random.default_rng(seed)
    means = torch.from_numpy(rng.uniform(0, 10, k))
    variances = torch.from_numpy(10 ** rng.uniform(-4, 0, k))
    return TimeMarginals.of(torch.from_numpy(rng.dirichlet(np.ones(k))).log(), means, variances)


def shares(of: TimeMarginals, instants: Tensor) -> Tensor:
    """Weights of all components, relative to the largest one."""
    log_h = of.log_activation(instants[:, None])
    return torch.exp(log_h - log_h.amax(1, keepdim=True))


def evenly(negligible: float = 1e-9) -> ActiveComponents:
    """Eleven components of 0.2 s, a second apart."""
    means = torch.linspace(0, 10, 11, dtype=torch.float64)
    of = TimeMarginals.of(torch.zeros(11).double(), means, torch.full((11,), 0.04).double())
    return ActiveComponents(of, negligible)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("negligible", [1e-9, 1e-3])
def test_what_windows_leave_out_is_negligible_everywhere(seed, negligible):
    of = marginals(seed)
    active = ActiveComponents(of, negligible)
    instants = torch.from_numpy(np.random.default_rng(seed).uniform(-8, 18, 2000))
    fewer = 0
    for instant, share in zip(instants.tolist(), shares(of, instants), strict=True):
        left_out = sorted(set(range(12)) - set(active.at(instant)))
        assert bool((share[left_out] < negligible).all())
        fewer += len(left_out)
    assert fewer > 1000
    assert active.largest < 12 or negligible < 1e-3


def test_times_of_a_batch_are_asked_one_by_one():
    active = ActiveComponents(marginals(0), 1e-6)
    instants = torch.linspace(-20, 30, 101, dtype=torch.float64)
    both = active.counts(instants.view(101, 1).expand(101, 2))
    assert both.shape == (101, 2, 12)
    for time, counts in zip(instants.tolist(), both, strict=True):
        for row in counts:
            assert tuple(row.nonzero()[:, 0].tolist()) == active.at(time)


def test_near_a_component_only_its_neighbours_count():
    active = evenly()
    # a component at a distance of d s weighs exp(-25 d^2 / 2): its neighbours 4e-6 of it, those
    # beyond 2e-22; halfway to the next one, both neighbours weigh 1e-11
    assert active.at(5.0) == (4, 5, 6)
    assert active.at(5.5) == (5, 6)
    assert active.largest == 3


def test_the_bound_is_the_share_that_is_asked_for():
    # between two equal components the share of the farther one is exp(-(10 x)^2 / 2) at first
    loose, tight = evenly(0.5), evenly(1e-30)
    assert loose.at(5.01) == (5,)
    assert loose.at(5.5) == (5, 6)
    assert len(tight.at(5.0)) == 5


@pytest.mark.parametrize("negligible", [1e-9, 0.5])
def test_windows_reach_six_deviations_beyond_the_means(negligible):
    active = evenly(negligible)
    reach = 6 * 0.2
    assert len(active.at(-reach + 0.01)) < 11
    assert len(active.at(10 + reach - 0.01)) < 11
    for beyond in (-reach - 0.01, 10 + reach + 0.01, 1e9):
        assert active.at(beyond) == tuple(range(11))
        assert bool(active.counts(torch.tensor([beyond], dtype=torch.float64)).all())


def test_windows_are_a_quarter_of_the_narrowest_deviation_and_not_too_many():
    active = evenly()
    assert len(active.counts(torch.zeros(1).double())) == 1
    assert len(active._sets) - 2 in (248, 249)  # 4 (10 + 12 * 0.2) / 0.2, and rounding
    means = torch.tensor([0.0, 1e6], dtype=torch.float64)
    zeros = torch.zeros(2, dtype=torch.float64)
    many = ActiveComponents(TimeMarginals.of(zeros, means, torch.ones(2).double()), 1e-9)
    assert len(many._sets) - 2 == active_components.MOST


def test_keeping_all_keeps_all():
    means = torch.tensor([0.0, 100.0], dtype=torch.float64)
    zeros = torch.zeros(2, dtype=torch.float64)
    assert ActiveComponents(TimeMarginals.of(zeros, means, zeros + 1), 0).at(0.0) == (0, 1)

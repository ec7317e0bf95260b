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


@pytest.mark.parametrize("seed", range(5))
def test_what_a_window_keeps_counts_somewhere_near(seed):
    of = marginals(seed)
    active = ActiveComponents(of, 1e-9)
    # a window is a quarter of a deviation wide: an instant apart, shares differ that much
    width = float(of.precision.rsqrt().min()) / active_components.PER_DEVIATION
    for instant in np.random.default_rng(seed).uniform(0, 10, 200):
        near = shares(of, torch.linspace(instant - width, instant + width, 41).double())
        log_bound = near.amax(0).log()
        steepest = (2 * width * of.precision * (10 + width)).clamp(max=50)
        kept = torch.tensor(active.at(float(instant)))
        assert bool((log_bound + steepest)[kept].min() >= np.log(1e-9))

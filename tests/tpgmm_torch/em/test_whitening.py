"""The log-density in whitened coordinates against torch.distributions."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from tests.support.em_reference import columns, movements, random_mixture, standardized
from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.em.whitening import Whitener, select


def problem(dtype=torch.float64):
    points, _ = standardized(movements(200)[:, :5], dtype, widths=(2, 3))
    [chunk] = points
    return chunk, columns(points), [random_mixture(seed) for seed in range(2)]


def expected_joint(parameters, blocks):
    """Log of weight times density, (K, n)."""
    joint = parameters.weights.log()[:, None]
    for x, mean, covariance in zip(
        blocks, parameters.means, parameters.covariances, strict=True
    ):
        joint = joint + MultivariateNormal(mean[:, None], covariance[:, None]).log_prob(x)
    return joint


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-3)], ids=str
)
def test_the_density_is_that_of_torch(dtype, tolerance):
    chunk, blocks, mixtures = problem(dtype)
    whitener = Whitener(Parameters.stack(mixtures), dtype)
    joint, whitened = whitener.log_joint(chunk)
    expected = torch.cat([expected_joint(one, blocks) for one in mixtures])
    assert joint.dtype == dtype == whitener.dtype
    torch.testing.assert_close(joint.double(), expected, rtol=tolerance, atol=tolerance)
    for y, x, name in zip(whitened, blocks, range(2), strict=True):
        for k in range(8):
            one = mixtures[k // 4]
            mean, factor = one.means[name][k % 4], one.factors[name][k % 4]
            own = torch.linalg.solve_triangular(factor, (x - mean).T, upper=False)
            torch.testing.assert_close(
                y[k, :-1].double(), own, rtol=10 * tolerance, atol=10 * tolerance
            )
        assert (y[:, -1] == 1).all()


def test_one_mixture_needs_no_stack():
    chunk, _, [one, _] = problem()
    stacked = Whitener(Parameters.stack([one]), torch.float64).log_joint(chunk)[0]
    assert torch.equal(Whitener(one, torch.float64).log_joint(chunk)[0], stacked)


def test_some_components_are_evaluated():
    chunk, _, [one, _] = problem()
    whitener, chosen = Whitener(one, torch.float64), torch.tensor([3, 1])
    joint, whitened = whitener.log_joint(chunk, chosen)
    every, all_whitened = whitener.log_joint(chunk)
    torch.testing.assert_close(joint, every[chosen])
    torch.testing.assert_close(whitened[1], all_whitened[1][chosen])


def test_peaks_are_the_densities_at_the_means():
    _, _, [one, _] = problem()
    peaks = Whitener(one, torch.float64).peaks
    at_means = expected_joint(one, one.means).diagonal()
    torch.testing.assert_close(peaks, at_means)


def test_nothing_chosen_is_everything():
    rows = torch.arange(6.0).view(3, 2)
    assert select(rows, None) is rows
    assert select(rows, torch.tensor([2, 0])).tolist() == [[4.0, 5.0], [0.0, 1.0]]

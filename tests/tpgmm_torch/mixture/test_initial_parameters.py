"""Initial parameters as the user gives them."""

import numpy as np
import pytest
import torch

from tests.support.em_reference import random_mixture
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.mixture.initial_parameters import InitialParameters

WIDTHS = (2, 3)


def checked(weights=None, means=None, covariances=None):
    return InitialParameters.checked(weights, means, covariances, 4, WIDTHS)


@pytest.mark.parametrize("kept", range(8))
def test_what_is_given_is_in_the_place_of_what_is_drawn(kept):
    own, drawn = random_mixture(0), random_mixture(1)
    wanted = [bool(kept & flag) for flag in (1, 2, 4)]
    parts = [own.weights.tolist(), [m.numpy() for m in own.means], own.covariances]
    given = checked(*(part if use else None for part, use in zip(parts, wanted, strict=True)))
    assert given.complete == all(wanted)
    found = given.over(None if all(wanted) else drawn)
    torch.testing.assert_close(found.weights, (own if wanted[0] else drawn).weights)
    torch.testing.assert_close(found.means, (own if wanted[1] else drawn).means)
    torch.testing.assert_close(found.factors, (own if wanted[2] else drawn).factors)


def test_weights_are_normalised():
    given = checked(np.array([0.25, 0.25, 0.25, 0.2505]))
    assert float(given.weights.sum()) == pytest.approx(1, abs=1e-15)
    assert given.weights.dtype == torch.float64
    assert checked([0.0, 0.0, 0.5, 0.5]).weights.tolist() == [0.0, 0.0, 0.5, 0.5]


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"weights": [0.5, 0.5]}, ShapeError, r"weights must have shape \(4,\), got \(2,\)"),
        ({"weights": [0.3, 0.3, 0.2, 0.202]}, DataError, "add up to 1"),
        ({"weights": [1.1, -0.1, 0.0, 0.0]}, DataError, "must be positive"),
        ({"means": [np.zeros((4, 2))]}, ShapeError, "one array per block, 2; it holds 1"),
        (
            {"means": [np.zeros((4, 2)), np.zeros((4, 2))]},
            ShapeError,
            r"means\[1\] must have shape \(4, 3\), got \(4, 2\)",
        ),
        (
            {"covariances": [np.zeros((4, 2)), np.zeros((4, 3, 3))]},
            ShapeError,
            r"covariances\[0\] must have shape \(4, 2, 2\)",
        ),
    ],
)
def test_what_does_not_fit_is_refused(given, error, message):
    with pytest.raises(error, match=message):
        checked(**given)

"""A few points per instant in the place of all demonstrations."""

import numpy as np
import pytest
import torch

from tests.support.skills import HANDLING, HANDS, handlings
from tpgmm_torch.mixture.row_file import RowFile
from tpgmm_torch.training.local_data import local_data
from tpgmm_torch.training.training_rows import equivalent_points, equivalent_rows


def test_a_few_points_have_the_moments_of_many():
    rows = local_data(handlings(6), HANDLING, HANDS)
    many = torch.stack(rows)[:, :, :5]  # demonstrations, instants, columns
    mean = many.mean(0)
    scatter = torch.einsum("mti,mtj->tij", many - mean, many - mean) / len(many)
    few = equivalent_points(mean, scatter, 8)
    torch.testing.assert_close(few.mean(1), mean)
    spread = few - mean[:, None]
    torch.testing.assert_close(spread.mT @ spread / 8, scatter, rtol=1e-12, atol=1e-15)


def test_points_without_spread_are_their_mean():
    mean = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    found = equivalent_points(mean, torch.zeros(1, 2, 2, dtype=torch.float64), 3)
    assert torch.equal(found, mean.expand(3, 2)[None])


@pytest.mark.parametrize("in_file", [False, True])
def test_instants_have_the_moments_of_all_demonstrations_block_by_block(in_file):
    """However far the reference."""
    rng, widths, length = np.random.RandomState(0), (2, 3), 20
    many = rng.standard_normal((7, length, 5)) + 1e3
    rows = many.reshape(-1, 5)
    given = RowFile.of([rows]) if in_file else rows
    points, size = equivalent_rows(given, many[0] + 0.5, widths)
    assert size == 4
    points = points.reshape(length, size, 5)
    np.testing.assert_allclose(points.mean(1), many.mean(0), rtol=1e-12)
    for block in (slice(0, 2), slice(2, 5)):
        for t in range(length):
            expected = np.cov(many[:, t, block].T, bias=True)
            found = np.cov(points[t, :, block].T, bias=True)
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)

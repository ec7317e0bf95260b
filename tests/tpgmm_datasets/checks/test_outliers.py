"""Robust outliers: none by chance, all that are far."""

import numpy as np
import pytest

from tpgmm_datasets.checks.outliers import FEWEST, outliers


@pytest.mark.parametrize("law", ["standard_normal", "random"])
def test_samples_of_one_law_have_hardly_any(law):
    drawn = (getattr(np.random.default_rng(seed), law)(20) for seed in range(200))
    found = [len(outliers(values, floor=0.0)) for values in drawn]
    assert np.mean(found) < 0.05  # of twenty, in each of 200


@pytest.mark.parametrize("size", [5, 10, 40])
def test_a_fifth_of_far_ones_is_found_farthest_first(size):
    values = np.random.default_rng(size).standard_normal(size)
    far = np.arange(size // 5)
    values[far] = 40.0 + far
    assert outliers(values, floor=0.0) == far[::-1].tolist()


def test_the_floor_forgives_and_few_say_nothing():
    assert outliers([1.0, 1.0, 1.0, 1.0, 1.4], floor=0.5) == []
    assert outliers([1.0, 1.0, 1.0, 1.0, 1.6], floor=0.5) == [4]
    assert outliers([0.0, 0.0, 99.0], floor=0.0) == [] and FEWEST == 4

"""Moments of columns, merged from parts."""

import numpy as np
import pytest

from tpgmm_torch.em import column_moments
from tpgmm_torch.em.column_moments import ColumnMoments

RNG = np.random.RandomState(0)
ROWS = RNG.standard_normal((500, 4)) * [1.0, 1e3, 1e-3, 5.0] + [0.0, 1e6, 7.0, -3.0]


def assert_moments(found, rows, rtol=1e-9):
    assert found.count == len(rows)
    np.testing.assert_allclose(found.mean, rows.mean(0), rtol=rtol)
    np.testing.assert_allclose(found.scatter, rows.var(0) * len(rows), rtol=rtol)
    np.testing.assert_array_equal(found.smallest, rows.min(0))
    np.testing.assert_array_equal(found.largest, rows.max(0))


@pytest.mark.parametrize("part", [2**16, 40, 1])
def test_moments_are_those_of_numpy(part, monkeypatch):
    monkeypatch.setattr(column_moments, "PART", part)
    assert_moments(ColumnMoments.of(ROWS), ROWS)
    assert_moments(ColumnMoments.of(ROWS[:1]), ROWS[:1])
    assert ColumnMoments.of(ROWS.astype(np.float32)).mean.dtype == np.float64


def test_parts_are_merged_whatever_their_sizes():
    parts = [ColumnMoments.of(part) for part in np.split(ROWS, [1, 30, 31, 400])]
    assert_moments(ColumnMoments.merge(parts), ROWS)
    assert_moments(ColumnMoments.merge(parts[::-1]), ROWS)
    assert ColumnMoments.merge(parts[:1]) is parts[0]


def test_a_constant_column_varies_by_nothing():
    rows = np.full((1000, 1), 0.1)
    assert ColumnMoments.of(rows).scatter.tolist() == [0.0]


@pytest.mark.parametrize("isotropic", [False, True])
def test_units_have_deviation_one(isotropic):
    units = ColumnMoments.of(ROWS).standardization((1, 3), isotropic=isotropic)
    standard = units.rows(ROWS).numpy()
    np.testing.assert_allclose(standard.mean(0), 0, atol=1e-8)
    if isotropic:
        np.testing.assert_allclose([standard[:, :1].var(), standard[:, 1:].var()], 1)
        assert len(set(units.scales[1].tolist())) == 1
    else:
        np.testing.assert_allclose(standard.std(0), 1)


def test_a_constant_column_takes_the_mean_variance_of_its_block():
    rows = np.column_stack([2.0 * ROWS[:, 0], 0.1 + 0 * ROWS[:, 0], 5 + 0 * ROWS[:, 0]])
    rows[::2, 1] += 1e-16  # rounding, no variance
    units = ColumnMoments.of(rows).standardization((2, 1), isotropic=False)
    assert units.scales[0].tolist() == pytest.approx(
        [rows[:, 0].std(), (rows[:, 0].var() / 2) ** 0.5]
    )
    assert units.scales[1].tolist() == [1.0]


@pytest.mark.parametrize(("times", "varies"), [(5, False), (20, True)])
def test_rounding_is_ten_times_the_precision_of_the_largest(times, varies):
    eps = np.finfo(np.float64).eps
    rows = np.array([[1.0 - times * eps], [1.0 + times * eps]] * 50) * -1.0
    scale = ColumnMoments.of(rows).standardization((1,), isotropic=False).scales[0]
    assert (float(scale) < 1) == varies

"""Moments of columns, part by part, and the units that follow from them."""

import numpy as np
import pytest

from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture.column_moments import ColumnMoments
from tpgmm_torch.mixture.row_file import RowFile


@pytest.mark.parametrize("part", [2**16, 40, 1])
@pytest.mark.parametrize("in_file", [False, True])
def test_moments_are_those_of_numpy(part, in_file, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.row_file.FILE_ROWS", part)
    X = np.random.RandomState(0).randn(101, 4) * [1e-3, 1.0, 1e3, 2.0] + [0, 1e5, 0, -3]
    X[:, 3] = 0.1
    found = ColumnMoments.of(RowFile.of([X]) if in_file else X)
    assert found.count == 101
    np.testing.assert_allclose(found.mean, X.mean(0), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(found.scatter / 101, X.var(0), rtol=1e-10, atol=1e-28)
    np.testing.assert_array_equal(found.smallest, X.min(0))
    np.testing.assert_array_equal(found.largest, X.max(0))
    assert found.scatter[3] == 0 and found.mean[3] == 0.1  # a constant varies by nothing


@pytest.mark.parametrize("isotropic", [False, True])
def test_units_have_deviation_one(isotropic):
    X = np.random.RandomState(0).randn(300, 5) * [1e-3, 1.0, 1e3, 2.0, 5.0]
    scales = ColumnMoments.of(X).scales((2, 3), isotropic=isotropic)
    variance = (X / scales).var(0)
    if isotropic:
        assert scales[0] == scales[1] and scales[2] == scales[3] == scales[4]
        variance = [variance[:2].mean(), variance[2:].mean()]
    np.testing.assert_allclose(variance, 1.0)


def test_a_constant_column_takes_the_mean_variance_of_its_block():
    X = np.random.RandomState(0).randn(300, 4)
    X[:, 1], X[:, 3] = 7.3, -1e4
    scales = ColumnMoments.of(X).scales((3, 1), isotropic=False)
    mean = (X[:, 0].var() + X[:, 2].var()) / 3
    np.testing.assert_allclose(scales**2, [X[:, 0].var(), mean, X[:, 2].var(), 1.0])


@pytest.mark.parametrize(("times", "varies"), [(5, False), (20, True)])
def test_rounding_is_ten_times_the_precision_of_the_largest(times, varies):
    X = np.array([[1e4, 1.0], [1e4, 3.0]])
    X[1, 0] += 2 * times * np.finfo(float).eps * 1e4
    [scale, _] = ColumnMoments.of(X).scales((2,), isotropic=False)
    assert (scale < 1e-6) == varies


@pytest.mark.parametrize(
    ("rows", "message"),
    [(np.empty((0, 3)), "there are no rows"), (np.array([[1e200], [-1e200]]), "overflows")],
)
def test_rows_without_moments_are_refused(rows, message):
    with pytest.raises(DataError, match=message):
        ColumnMoments.of(rows)

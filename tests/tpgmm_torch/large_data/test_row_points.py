"""Rows as points: sorted by time within batches, groups together, made once if they can be."""

import numpy as np
import pytest
import torch

from tests.support.em_reference import columns, movements
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.large_data import row_points
from tpgmm_torch.large_data.row_batches import BatchedRows, StoredRows
from tpgmm_torch.large_data.row_points import RowPoints

ROWS = np.random.RandomState(0).permutation(movements(600))
UNITS = ColumnMoments.of(ROWS).standardization((3, 4), isotropic=False)


def points(rows, **settings):
    return RowPoints(rows, 600, UNITS, 5, torch.float64, **settings)


def batched(*cuts, group_size=1):
    return BatchedRows(np.split(ROWS, cuts), group_size)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Small batches are not put together, and pieces are smaller than they."""
    monkeypatch.setattr("tpgmm_torch.large_data.row_batches.FEWEST_ROWS", 1)
    monkeypatch.setattr(row_points, "PIECE", 64)


@pytest.mark.parametrize("cuts", [(), (100, 101, 400)])
@pytest.mark.parametrize("group_size", [1, 4])
@pytest.mark.parametrize("time_feature", [None, 0, 2])
def test_points_are_the_rows_by_time(cuts, group_size, time_feature):
    cuts = [cut // group_size * group_size for cut in cuts]
    source = batched(*cuts, group_size=group_size) if cuts else StoredRows(ROWS)
    found = points(source, group_size=group_size, time_feature=time_feature)
    expected = []
    for batch in np.split(np.arange(600), cuts):
        groups = batch.reshape(-1, group_size)
        if time_feature is not None:
            groups = groups[np.argsort(ROWS[groups[:, 0], time_feature], kind="stable")]
        expected.append(groups.ravel())
    order = np.concatenate(expected)
    np.testing.assert_array_equal(found.numbers(), order)
    for _ in range(2):
        rows = torch.cat(columns(found), 1)
        assert torch.equal(rows, UNITS.rows(ROWS)[torch.from_numpy(order)])
    assert all(chunk[0].shape[1] % group_size == 0 for chunk in found)
    assert (found.widths, found.total, found.dtype) == ((3, 4), 600, torch.float64)


def test_rows_in_memory_are_standardised_once():
    stored, read = points(StoredRows(ROWS)), points(batched(300))
    assert next(iter(stored)) is next(iter(stored))
    assert next(iter(read)) is not next(iter(read))


def test_sums_and_rows_are_those_of_the_processes():
    class Double:
        def sum(self, *tensors):
            return tuple(2 * tensor for tensor in tensors)

        def concatenate(self, values):
            return torch.cat([values, values])

    found = points(StoredRows(ROWS), processes=Double())
    one = torch.ones(2)
    assert [total.tolist() for total in found.combine(one, one)] == [[2.0, 2.0]] * 2
    assert found.concatenate(one).tolist() == [1.0] * 4

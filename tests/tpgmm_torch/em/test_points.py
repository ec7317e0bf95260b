"""Points in chunks."""

import numpy as np
import pytest
import torch

from tests.support.em_reference import movements
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.em.points import CHUNK_SIZE, StoredPoints, standardized_chunks


def chunks(rows, n_components=1, dtype=torch.float64, group_size=1):
    units = ColumnMoments.of(rows).standardization((3, 4), isotropic=False)
    return standardized_chunks(rows, units, n_components, dtype, group_size), units


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_chunks_hold_the_standardised_rows_and_ones(dtype, monkeypatch):
    monkeypatch.setitem(CHUNK_SIZE, "cpu", 500)
    rows = movements(300)
    found, units = chunks(rows, dtype=dtype)
    expected = units.rows(rows).to(dtype)
    blocks = [torch.cat(block, 1) for block in zip(*found, strict=True)]
    assert torch.equal(blocks[0][:-1].T, expected[:, :3])
    assert torch.equal(blocks[1][:-1].T, expected[:, 3:])
    assert all((block[-1] == 1).all() for block in blocks)
    assert all(block.is_contiguous() and block.dtype == dtype for c in found for block in c)


@pytest.mark.parametrize(
    ("n_components", "dtype", "group_size", "size"),
    [
        (1, torch.float64, 1, 1000 // 9 + 1),  # (3 + 1) + (4 + 1) whitened coordinates
        (2, torch.float64, 1, 1000 // 18 + 1),
        (50, torch.float64, 1, 1000 // 25 + 1),  # 10 + 15 products, if they are expanded
        (2, torch.float32, 1, 2000 // 18 + 1),
        (2, torch.float64, 7, 1000 // 18 // 7 * 7 + 7),
        (2, torch.float64, 200, 200),
    ],
)
def test_chunks_fit_the_cache_and_end_where_groups_end(
    n_components, dtype, group_size, size, monkeypatch
):
    monkeypatch.setitem(CHUNK_SIZE, "cpu", 1000)
    found, _ = chunks(movements(2800), n_components, dtype, group_size)
    lengths = [chunk[0].shape[1] for chunk in found]
    assert lengths[0] == size
    assert set(lengths[:-1]) == {size}
    assert sum(lengths) == 2800


def test_points_in_memory_know_what_they_are():
    found, _ = chunks(movements(300))
    points = StoredPoints([*found, tuple(block[:, :7] for block in found[0])])
    assert (points.widths, points.total) == ((3, 4), 307)
    assert (points.dtype, points.device.type) == (torch.float64, "cpu")
    assert [chunk[0].shape[1] for chunk in points] == [300, 7]
    assert next(iter(points)) is found[0]


def test_alone_sums_and_rows_are_the_own():
    points, total = StoredPoints(chunks(movements(300))[0]), torch.ones(3)
    assert points.combine(total, total)[1] is total
    assert points.concatenate(total) is total


def test_rows_that_may_not_be_written_are_left_alone():
    rows = movements(300)
    before = rows.copy()
    rows.flags.writeable = False
    chunks(rows)
    np.testing.assert_array_equal(rows, before)

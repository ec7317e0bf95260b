"""Points: the rows, standardised and by time, in chunks that end where groups end."""

import numpy as np
import pytest
import torch

from tests.support.em_reference import movements, points_of
from tpgmm_torch.mixture.row_file import RowFile

ROWS = movements(1200)[np.random.RandomState(0).permutation(1200)]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("group_size", [1, 4])
@pytest.mark.parametrize("piece", [None, 300])
def test_points_are_the_rows_by_time(dtype, group_size, piece, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.points.CHUNK_SIZE", {"cpu": 2**11})
    monkeypatch.setattr("tpgmm_torch.mixture.points.FILE_ROWS", piece)
    rows = None if piece is None else RowFile.of([ROWS])
    points = points_of(ROWS, dtype, group_size=group_size, rows=rows)
    groups = np.arange(1200).reshape(-1, group_size)
    pieces = np.split(groups, range(0, len(groups), (piece or 1200) // group_size)[1:])
    order = [own[np.argsort(ROWS[own[:, 0], 0], kind="stable")].ravel() for own in pieces]
    for _ in range(2):  # every pass is the same
        chunks, numbers = zip(*points, strict=True)
        np.testing.assert_array_equal(torch.cat(numbers), np.concatenate(order))
        found = torch.cat(chunks, 1)
        assert found.dtype == dtype
        standard = (ROWS - ROWS.mean(0)) / ROWS.std(0)
        expected = np.insert(standard, [3, 7], 1.0, axis=1)[np.concatenate(order)]
        np.testing.assert_allclose(found.T, expected, rtol=1e-5, atol=1e-6)
        assert len(chunks) > 5
        sizes = [chunk.shape[1] for chunk in chunks]
        assert all(size % group_size == 0 for size in sizes)
        assert max(sizes) * 70 <= 2**11 * 8 // dtype.itemsize + 70 * group_size
    for chunk, span in zip(chunks, points.spans, strict=True):
        for j, block in enumerate(points.blocks(chunk)):
            assert span[:, j].tolist() == [float(block[0].min()), float(block[0].max())]


def test_a_group_larger_than_all_chunks_is_not_cut(monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.points.CHUNK_SIZE", {"cpu": 8})
    assert [chunk.shape[1] for chunk, _ in points_of(ROWS, group_size=400)] == [400] * 3


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("largest", [2**16, 150])
def test_few_rows_are_sampled_whole_and_of_many_some(every, largest, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.mixture.points.FILE_ROWS", largest)
    samples = [points_of(ROWS, rows=rows).sample(every) for rows in (None, RowFile.of([ROWS]))]
    for found, numbers in samples:
        assert len(numbers) == 1200 // every if largest > 1200 else 100 < len(numbers) <= 150
        assert (np.diff(numbers) > 0).all() and numbers.max() > 0.9 * (1200 // every)
        expected = ((ROWS - ROWS.mean(0)) / ROWS.std(0))[::every][numbers]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)

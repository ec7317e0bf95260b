"""Rows in a temporary file."""

import numpy as np
import pytest

from tpgmm_torch.large_data import row_file
from tpgmm_torch.large_data.row_file import RowFile

ROWS = np.random.RandomState(0).standard_normal((70, 3))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rows_come_back_in_batches(dtype, monkeypatch):
    monkeypatch.setattr(row_file, "BATCH_ROWS", 32)
    rows = ROWS.astype(dtype)
    with RowFile() as file:
        for part in np.split(rows, [1, 40]):
            file.append(np.asfortranarray(part))
        assert file.n_rows == 70
        for _ in range(2):
            batches = list(file)
            assert [len(batch) for batch in batches] == [32, 32, 6]
            np.testing.assert_array_equal(np.concatenate(batches), rows)
            assert batches[0].dtype == dtype
        np.testing.assert_array_equal(file.read(30, 35), rows[30:35])
        np.testing.assert_array_equal(file.read(69, 99), rows[69:])


def test_rows_may_be_added_between_passes_that_interleave():
    with RowFile() as file:
        file.append(ROWS[:10])
        walk = file.batches()
        file.append(ROWS[10:])
        assert len(next(walk)) == 70
        np.testing.assert_array_equal(file.read(9, 12), ROWS[9:12])


def test_constant_columns_are_read_as_their_values():
    with RowFile() as file:
        file.append(ROWS)
        file.make_constant(np.array([True, False, True]), np.array([7.0, 8.0, 9.0]))
        [batch] = file
        assert set(batch[:, 0]) == {7.0}
        np.testing.assert_array_equal(batch[:, 1], ROWS[:, 1])
        assert set(file.read(3, 5)[:, 2]) == {9.0}


def test_the_file_goes_with_the_block():
    with RowFile() as file:
        file.append(ROWS)
    with pytest.raises(ValueError, match="closed"):
        file.read(0, 1)


def test_rows_that_are_kept_move_up_and_are_as_written():
    written = np.arange(24.0).reshape(8, 3)
    with RowFile() as rows:
        rows.append(written)
        rows.make_constant(np.array([True, False, False]), np.full(3, 7.0))
        assert rows.keep([(0.5, 1, 3), (1.5, 6, 8)]) == [(0.5, 0, 2), (1.5, 2, 4)]
        assert rows.n_rows == 4
        np.testing.assert_array_equal(next(rows.batches()), written[[1, 2, 6, 7]])
        rows.append(written[:1])
        np.testing.assert_array_equal(next(rows.batches()), written[[1, 2, 6, 7, 0]])

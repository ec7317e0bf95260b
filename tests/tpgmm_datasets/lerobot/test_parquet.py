"""Parquet files: read in parts, and named where they are damaged."""

import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.support.lerobot_sets import (
    DATA,
    EPISODES,
    assert_equal,
    assert_refused,
    change_info,
    joints_of,
    set_column,
    to_v21,
)
from tpgmm_datasets import DatasetError, DatasetWarning, load_lerobot
from tpgmm_datasets.lerobot import parquet


def test_small_batches_give_the_same_demonstrations(root, monkeypatch):
    expected = joints_of(load_lerobot(root))
    monkeypatch.setattr(parquet, "BATCH_ROWS", 4)
    assert_equal(joints_of(load_lerobot(root)), expected)


def test_another_data_path_and_list_columns_are_read(root):
    expected = joints_of(load_lerobot(root))
    (root / "data" / "all").mkdir()
    lists = pa.list_(pa.float64())
    table = pq.read_table(root / DATA).replace_schema_metadata(None)
    column = table["observation.state"].combine_chunks().cast(lists)
    table = set_column(table, "observation.state", column)
    pq.write_table(table, root / "data/all/0-0.parquet")
    (root / DATA).unlink()
    template = "data/all/{chunk_index}-{file_index}.parquet"
    change_info(root, lambda info: info.update(data_path=template))
    assert_equal(joints_of(load_lerobot(root)), expected)


def test_a_missing_file_can_be_relaxed(root, tmp_path):
    old = to_v21(root, tmp_path / "old")
    (old / "data/chunk-000/episode_000001.parquet").unlink()
    with pytest.warns(DatasetWarning, match="episode_000001.parquet: the file is missing"):
        assert len(load_lerobot(old, relax=["missing"])) == 2


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.unlink(),
        lambda file: file.write_bytes(b""),
        lambda file: file.write_bytes(file.read_bytes()[:-200]),
    ],
)
def test_a_file_that_is_missing_or_cut_off_is_named(root, damage):
    damage(root / DATA)
    assert_refused(root, "missing", DATA)


@pytest.mark.parametrize(
    ("place", "message"),
    [("pipe", "is not a regular file"), ("pointer", "Git LFS pointer.*`git lfs pull`")],
)
@pytest.mark.parametrize("file", [DATA, EPISODES, "meta/info.json"])
def test_what_stands_in_place_of_a_file_is_told(root, place, message, file):
    (root / file).unlink()
    if place == "pipe":
        os.mkfifo(root / file)
    else:
        text = "version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 345\n"
        (root / file).write_text(text)
    with pytest.raises(DatasetError, match="no meta/info.json|" + message) as caught:
        load_lerobot(root)
    assert caught.value.check == "missing"


@pytest.mark.parametrize("beside", ["._file-000.parquet", ".file.parquet", ".tmp/file.parquet"])
@pytest.mark.parametrize("file", [DATA, EPISODES])
def test_what_begins_with_a_dot_is_no_part_of_a_set(root, beside, file):
    expected = joints_of(load_lerobot(root))
    path = (root / file).parents[beside.count("/")] / beside
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"Mac OS X")
    assert_equal(joints_of(load_lerobot(root)), expected)


@pytest.mark.parametrize(("file", "most"), [(DATA, 20000000), (EPISODES, 285714)])
def test_files_of_too_many_rows_are_refused_before_they_are_read(root, file, most, monkeypatch):
    rows = {DATA: 1_500_000, EPISODES: 300_000}[file]
    table = pq.read_table(root / file).slice(0, 1).replace_schema_metadata(None)
    pq.write_table(table.take(np.zeros(rows, int)), root / file)
    monkeypatch.setattr(pq.ParquetFile, "iter_batches" if file == DATA else "read", None)
    with pytest.raises(DatasetError, match=f"{file}: it has {rows} rows.*at most {most}"):
        load_lerobot(root)

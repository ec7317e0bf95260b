"""Numbered parquet files."""

from tests.support.written_sets import FPS, assert_same, demonstration
from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_datasets.lerobot.files import file_path, free_place

TEMPLATE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


def test_the_first_free_number_is_taken_chunk_by_chunk(tmp_path):
    for expected in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1)):
        place = free_place(tmp_path, TEMPLATE, chunk_files=3)
        assert place == expected
        path = tmp_path / file_path(TEMPLATE, *place)
        path.parent.mkdir(exist_ok=True)
        path.touch()


def test_appended_episodes_are_in_files_of_their_own(tmp_path):
    written = [demonstration(seed) for seed in range(5)]
    for few in (written[:2], written[2:3], written[3:]):
        root = save_lerobot(few, tmp_path / "set", fps=FPS, task="reach", append=True)
    assert len(list(root.glob("data/*/*.parquet"))) == 3
    for found, expected in zip(load_lerobot(root), written, strict=True):
        assert_same(found, expected, 1e-6)

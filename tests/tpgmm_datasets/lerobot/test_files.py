"""Numbered parquet files."""

from tpgmm_datasets.lerobot.files import file_path, free_place

TEMPLATE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


def test_the_first_free_number_is_taken_chunk_by_chunk(tmp_path):
    for expected in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1)):
        place = free_place(tmp_path, TEMPLATE, chunk_files=3)
        assert place == expected
        path = tmp_path / file_path(TEMPLATE, *place)
        path.parent.mkdir(exist_ok=True)
        path.touch()

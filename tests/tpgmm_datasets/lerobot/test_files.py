"""Series of parquet files."""

from tests.support.written_sets import FPS, assert_same, demonstration
from tpgmm_datasets import load_lerobot, save_lerobot


def test_many_episodes_are_split_into_files_and_chunks(tmp_path):
    written = [demonstration(seed) for seed in range(12)]
    root = save_lerobot(
        written, tmp_path / "set", fps=FPS, task="reach", file_megabytes=0.006, chunk_files=3
    )
    files = sorted(root.glob("data/*/*.parquet"))
    assert len(files) > 3
    assert {len(list(chunk.iterdir())) for chunk in sorted(root.glob("data/*"))[:-1]} == {3}
    for found, expected in zip(load_lerobot(root), written, strict=True):
        assert_same(found, expected, 1e-6)

"""Pictures of episodes: videos and images, and what is wrong with them."""

import json
import shutil

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.support.lerobot_sets import change_info, change_table
from tests.support.recorded_tags import FPS, KEY, carried, picture, record
from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.layout import open_layout
from tpgmm_vision.episodes.video import EpisodePictures

pytestmark = pytest.mark.slow

EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{KEY}/chunk-000/file-000.mp4"
LENGTHS = (30, 24, 27)
#: Mean difference of grey values: what the codec may change, and what a motion of one row does.
CODEC, MOTION = 1.8, 1.0


@pytest.fixture(scope="module", params=["h264", "libsvtav1", "images"])
def recorded(request, tmp_path_factory):
    root = tmp_path_factory.mktemp(request.param) / "set"
    shown = [carried(rows)[:2] for rows in LENGTHS]
    images = request.param == "images"
    return record(root, shown, codec="h264" if images else request.param, images=images)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    root = tmp_path_factory.mktemp("set") / "set"
    return record(root, [carried(rows)[:2] for rows in LENGTHS], codec="h264")


@pytest.fixture
def root(original, tmp_path):
    return shutil.copytree(original, tmp_path / "set")


def read(root, number=1, keys=(KEY,)):
    layout = open_layout(root)
    episode = layout.episodes[number]
    time = np.arange(episode.length) / FPS
    return [shown for _, shown in EpisodePictures(layout, keys).read(episode, time)]


def test_each_row_has_its_own_picture(recorded):
    for number, rows in enumerate(LENGTHS):
        pictures, (drawn, *_) = read(recorded, number), carried(rows)
        assert len(pictures) == rows
        for row in (0, 21, 22, 23, rows - 1):
            shown = pictures[row][KEY]
            assert shown.dtype == np.uint8
            off = np.abs(shown - picture(drawn[row]).astype(float)).mean()
            other = np.abs(shown - picture(drawn[row - 1]).astype(float)).mean()
            assert off < CODEC
            assert row not in (21, 22, 23) or other > off + 0.1  # it moves there


def test_an_episode_of_its_own_file_is_read_in_v21(root, tmp_path):
    # the episode is alone in a video, as in v2.1
    whole = record(tmp_path / "one", [carried(LENGTHS[0])[:2]], codec="h264")
    old = tmp_path / "old"
    (old / "meta").mkdir(parents=True)
    info = json.loads((whole / "meta/info.json").read_text())
    info |= {
        "codebase_version": "v2.1",
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/"
        "episode_{episode_index:06d}.mp4",
    }
    (old / "meta/info.json").write_text(json.dumps(info))
    line = {"episode_index": 0, "tasks": ["carry"], "length": LENGTHS[0]}
    (old / "meta/episodes.jsonl").write_text(json.dumps(line))
    (old / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "carry"}))
    for source, target in (
        ("data/chunk-000/file-000.parquet", "data/chunk-000/episode_000000.parquet"),
        (VIDEO, f"videos/chunk-000/{KEY}/episode_000000.mp4"),
    ):
        (old / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(whole / source, old / target)
    same = zip(read(old, 0), read(whole, 0), strict=True)
    assert all((a[KEY] == b[KEY]).all() for a, b in same)
    shutil.copy(root / VIDEO, old / target)  # three episodes long
    with pytest.raises(DatasetError, match=r"episode 0.*goes on behind its 30 rows"):
        read(old, 0)


def test_cameras_that_are_not_there_are_named(root):
    with pytest.raises(DatasetError, match=r"no pictures \['wrist'\]; its cameras are.*front"):
        EpisodePictures(open_layout(root), ["wrist"])


def test_missing_and_damaged_videos_name_the_episode(root):
    content = bytearray((root / VIDEO).read_bytes())
    (root / VIDEO).unlink()
    with pytest.raises(DatasetError, match=r"file-000\.mp4, episode 1.*missing"):
        read(root)
    (root / VIDEO).write_bytes(content[: len(content) // 2])
    with pytest.raises(DatasetError, match="episode 1"):
        read(root)
    (root / VIDEO).write_bytes(b"not a video")
    with pytest.raises(DatasetError, match="damaged, or of a kind"):
        read(root)


@pytest.mark.parametrize("seed", range(5))
def test_flipped_bytes_are_no_picture(root, seed):
    rng, content = np.random.default_rng(seed), bytearray((root / VIDEO).read_bytes())
    start = content.find(b"mdat")
    for at in rng.integers(start + 100, len(content) - 2000, 200):
        content[at] ^= 0xFF
    (root / VIDEO).write_bytes(content)
    with pytest.raises(DatasetError, match=r"file-000\.mp4, episode"):
        for number in range(3):
            read(root, number)


def test_a_video_that_does_not_fit_the_rows_is_refused(root):
    key = f"videos/{KEY}/to_timestamp"

    def longer(table):
        values = pa.array(np.add(table[key], [0, 0.04, 0]))
        return table.set_column(table.column_names.index(key), key, values)

    change_table(root, EPISODES, longer)
    with pytest.raises(DatasetError, match=r"episode 1.*takes 1 s of the video, its rows 24 x"):
        read(root)


def test_a_video_of_another_rate_or_that_ends_early_is_refused(root):
    shown = read(root, 0)
    for rate, count in ((24, 81), (FPS, 60)):
        with av.open(str(root / VIDEO), "w") as made:
            stream = made.add_stream("libx264", rate=rate)
            stream.width, stream.height = 320, 240
            for row in range(count):
                image = shown[row % len(shown)][KEY]
                made.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
            made.mux(stream.encode())
        with pytest.raises(DatasetError, match=r"episode 2.*no picture is at"):
            read(root, 2)


def test_images_that_are_missing_are_refused(tmp_path):
    root = record(tmp_path / "set", [carried(24)[:2]], images=True)
    data = root / "data/chunk-000/file-000.parquet"
    table = pq.read_table(data)
    broken = table[KEY].to_pylist()
    broken[4]["bytes"] = b"no png"
    column = pa.array(broken, table[KEY].type)
    pq.write_table(table.set_column(table.column_names.index(KEY), KEY, column), data)
    with pytest.raises(DatasetError, match=r"episode 0.*image is missing or damaged"):
        read(root, 0)


def test_a_path_out_of_the_set_is_refused(root):
    change_info(root, lambda info: info.__setitem__("video_path", "../{video_key}.mp4"))
    with pytest.raises(DatasetError, match="leaves the set"):
        read(root)

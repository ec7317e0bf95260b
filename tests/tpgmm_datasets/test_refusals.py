import math
import pickle
import shutil

import numpy as np
import pyarrow as pa
import pytest
import torch

from tests.support.lerobot_sets import (
    DATA,
    EPISODES,
    FPS,
    assert_equal,
    change_info,
    change_table,
    in_data,
    in_info,
    joints_of,
    set_column,
    spoil,
    stuck,
    to_v21,
    undeclared,
    write,
)
from tpgmm_datasets import (
    DatasetError,
    DatasetWarning,
    describe_lerobot,
    load_lerobot,
)


@pytest.fixture
def root(tmp_path):
    write(tmp_path / "set")
    return tmp_path / "set"


def nulls(root):
    def change(table):
        values = table["observation.state"].to_pylist()
        values[20] = None
        kind = pa.list_(pa.float64(), 3)
        return set_column(table, "observation.state", pa.array(values, kind))

    change_table(root, DATA, change)


def later(values):
    values[15:21] += 0.1
    return values


def cut_file(root):
    (root / DATA).write_bytes((root / DATA).read_bytes()[:-200])


def copied_rows(root):
    def change(table):
        return pa.concat_tables((table, table.slice(12, 9)))

    change_table(root, DATA, change)


STATE, POSE = "observation.state", "observation.environment_state"
EXTRA = "data/chunk-000/file-007.parquet"
INFO = ("meta/info.json", None, None)


def without(name):
    return lambda root: change_table(root, DATA, lambda table: table.drop_columns([name]))


def listed_twice(root):
    index = pa.array([0, 1, 1])
    change_table(root, EPISODES, lambda table: set_column(table, "episode_index", index))


REFUSALS = [
    ("nan", in_data(STATE, spoil(14, 1, np.nan)), (DATA, 1, STATE)),
    ("nan", in_data(STATE, spoil(14, 1, np.inf)), (DATA, 1, STATE)),
    ("nan", in_data(POSE, spoil(14, 1, np.nan)), (DATA, 1, POSE)),
    ("nan", in_data("timestamp", spoil(14, 0, np.nan)), (DATA, 1, "timestamp")),
    ("nan", nulls, (DATA, 1, STATE)),
    ("time", in_data("timestamp", stuck), (DATA, 1, "timestamp")),
    ("gaps", in_data("timestamp", later), (DATA, 1, "timestamp")),
    ("metadata", in_data("frame_index", spoil(14, 0, 7)), (DATA, 1, "frame_index")),
    ("metadata", in_data("index", spoil(14, 0, 7)), (DATA, 1, "index")),
    ("metadata", lambda r: change_table(r, DATA, lambda t: t.slice(0, 35)), (DATA, 2, None)),
    ("metadata", in_data("episode_index", spoil(slice(12, 21), 0, 8)), (DATA, 8, None)),
    ("duplicates", copied_rows, (DATA, 1, None)),
    ("duplicates", listed_twice, (None, 1, None)),
    ("metadata", in_info(total_episodes=4), INFO),
    ("metadata", in_info(total_frames=35), INFO),
    ("metadata", in_info(fps=25), (DATA, None, "fps")),
    ("missing", lambda r: (r / DATA).unlink(), (DATA, None, None)),
    ("missing", cut_file, (DATA, None, None)),
    ("missing", lambda r: (r / DATA).write_bytes(b""), (DATA, None, None)),
    ("missing", lambda r: (r / EPISODES).unlink(), ("meta/episodes", None, None)),
    ("missing", lambda r: (r / "meta/info.json").unlink(), (None, None, None)),
    ("missing", lambda r: shutil.rmtree(r), (None, None, None)),
    ("metadata", lambda r: shutil.copy(r / DATA, r / EXTRA), (EXTRA, None, None)),
    ("", without(STATE), (DATA, None, STATE)),
    ("", without("episode_index"), (DATA, None, "episode_index")),
    ("", lambda r: (r / "meta/info.json").write_text("{"), INFO),
    ("", in_info(codebase_version="v1.6"), INFO),
    ("", in_info(fps="fast"), INFO),
    ("", in_info(features={}), INFO),
    ("", in_info(data_path="../{chunk_index}"), INFO),
    ("", in_info(data_path="{file}"), INFO),
]  # fmt: skip


@pytest.mark.parametrize(("check", "damage", "place"), REFUSALS)
def test_what_is_wrong_is_refused_and_located(root, check, damage, place):
    damage(root)
    with pytest.raises(DatasetError) as caught:
        load_lerobot(root)
    error = caught.value
    assert (error.check, error.file, error.episode, error.column) == (check, *place)
    for part in filter(None, place):
        assert str(part) in str(error)


def test_an_edit_of_the_metadata_is_noticed_by_the_data_files(root):
    change_info(root, lambda i: i["features"]["observation.state"].update(names=list("abc")))
    with pytest.raises(DatasetError, match="written with"):
        load_lerobot(root)


def test_declared_type_and_shape_must_be_those_of_the_data(root, tmp_path):
    for name, value in (("dtype", "float32"), ("shape", [2])):
        plain = to_v21(root, tmp_path / name)
        change = {name: value, "names": None, "info": None}
        change_info(plain, lambda i, c=change: i["features"]["observation.state"].update(c))
        with pytest.raises(DatasetError, match=r"info\.json declares") as caught:
            load_lerobot(plain)
        assert caught.value.column == "observation.state"


@pytest.mark.parametrize("check", ["nan", "time", "gaps", "metadata", "duplicates"])
def test_a_relaxed_check_leaves_the_episode_out_and_says_so(root, check):
    damage = {
        "nan": in_data("observation.state", spoil(14, 1, np.nan)),
        "time": in_data("timestamp", stuck),
        "gaps": in_data("timestamp", later),
        "metadata": in_data("frame_index", spoil(14, 0, 7)),
    }
    expected = joints_of(load_lerobot(root))
    damage.get(check, copied_rows)(root)
    with pytest.warns(DatasetWarning, match="episode 1"):
        found = load_lerobot(root, relax={check})
    # of an episode that is there twice the first is kept
    kept = expected if check == "duplicates" else [expected[0], expected[2]]
    assert_equal(joints_of(found), kept)


def test_a_missing_file_can_be_relaxed(root, tmp_path):
    old = to_v21(root, tmp_path / "old")
    (old / "data/chunk-000/episode_000001.parquet").unlink()
    with pytest.warns(DatasetWarning, match="episode_000001.parquet: the file is missing"):
        assert len(load_lerobot(old, relax=["missing"])) == 2


def test_errors_survive_pickling(root):
    (root / DATA).unlink()
    with pytest.raises(DatasetError) as caught:
        load_lerobot(root)
    copy = pickle.loads(pickle.dumps(caught.value))
    assert str(copy) == str(caught.value)
    assert (copy.file, copy.check) == (DATA, "missing")


def test_a_description_tells_what_is_there(root):
    found = describe_lerobot(root)
    assert (found.version, found.fps, found.robot_type) == ("v3.0", FPS, "arm")
    assert (found.joints, found.frames, found.events) == (
        "observation.state",
        ("bottle",),
        ("close",),
    )
    assert found.tasks == ("reach", "shake")
    assert found.lengths == (12, 9, 15)
    assert found.duration == pytest.approx(36 / FPS)
    assert found.problems == ()
    columns = {column.key: column for column in found.columns}
    assert columns["observation.state"].units == ("rad", "rad", "rad")
    every = torch.cat(joints_of(load_lerobot(root)))
    assert columns["observation.state"].high == tuple(every.amax(dim=0).tolist())


def test_a_description_guesses_units_and_lists_cameras(root, tmp_path):
    undeclared(root, 180 / math.pi)
    found = describe_lerobot(to_v21(root, tmp_path / "old"))
    state = next(column for column in found.columns if column.key == "observation.state")
    assert "deg" in state.units[0]
    assert found.cameras == ("camera",)


def test_a_description_lists_all_problems(root):
    in_info(total_episodes=4, total_frames=1)(root)
    in_data("timestamp", stuck)(root)
    in_data("observation.state", spoil(14, 1, np.nan))(root)
    in_data("action", spoil(30, 1, np.nan))(root)
    problems = describe_lerobot(root).problems
    assert [problem.check for problem in problems] == [
        "metadata",
        "metadata",
        "time",
        "nan",
        "nan",
    ]
    assert [problem.episode for problem in problems] == [None, None, 1, 1, 2]

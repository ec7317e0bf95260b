"""Data sets read as demonstrations: what is chosen, what is refused, what damage does."""

import inspect
import json
import os
import shutil
import warnings

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from tests.support.lerobot_sets import (
    DATA,
    NAMES,
    Arm,
    assert_equal,
    change_table,
    joints_of,
    set_column,
    spoil,
    to_v21,
)
from tpgmm_datasets import (
    DatasetError,
    LinkPose,
    iter_lerobot,
    load_lerobot,
    save_lerobot,
)
from tpgmm_datasets.reader import open_recording
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import TPGMMError


def test_both_layouts_give_the_same_demonstrations(root, tmp_path):
    expected = load_lerobot(root)
    found = load_lerobot(to_v21(root, tmp_path / "old"))
    assert_equal(joints_of(found), joints_of(expected))
    for a, b in zip(found, expected, strict=True):
        assert a.joint_names == b.joint_names == NAMES
        assert dict(a.events) == dict(b.events)
        torch.testing.assert_close(a.frames["bottle"].position, b.frames["bottle"].position)
        torch.testing.assert_close(a.time, b.time, rtol=0, atol=0)


def test_iteration_reads_an_episode_when_it_comes(root):
    change_table(root, DATA, lambda t: set_column(t, "observation.state", spoil(30, 0, np.nan)))
    episodes = iter_lerobot(root)
    assert len(next(episodes)) == 12
    assert len(next(episodes)) == 9
    with pytest.raises(DatasetError, match="episode 2"):
        next(episodes)


def test_columns_that_only_lerobot_needs_may_be_missing(root):
    expected = joints_of(load_lerobot(root))
    for name in ("index", "frame_index", "task_index", "timestamp"):
        change_table(root, DATA, lambda table, name=name: table.drop_columns([name]))
        assert_equal(joints_of(load_lerobot(root)), expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robot": Arm("waist")}, r"joint 'waist' is none of the values.*left_elbow"),
        ({"joint_names": {"waist": "x"}}, "joint_names has 'waist'"),
        ({"joint_names": ["a", "b"]}, "3 different names"),
        ({"joint_names": {"left_elbow": "gripper"}}, "3 different names"),
        ({"joints": "observation.velocity"}, r"'observation.velocity': there is no .*action"),
        ({"units": {"waist": "deg"}}, r"units names \['waist'\]"),
        ({"units": "degrees"}, "unit 'degrees' is unknown"),
        ({"frames": {"cup": "observation.cup"}}, "no numeric column"),
        ({"frames": {"cup": 3}}, "frame 'cup' is a feature's name"),
        ({"frames": {"cup": LinkPose("hand", "close")}}, "pass robot="),
        ({"episodes": [0, 7]}, r"no episodes \[7\]"),
        ({"episodes": "fly"}, r"no episode has the task 'fly'.*reach"),
        ({"rate": 0.0}, "the rate"),
        ({"trim": 1e9}, "nothing moves faster"),
        ({"relax": {"everything"}}, "relax names"),
        ({"events": {"late": lambda demonstration: 99.0}}, "'late' was found at 99 s"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(root, options, message):
    with pytest.raises(DatasetError, match=message) as caught:
        load_lerobot(root, **options)
    assert isinstance(caught.value, TPGMMError)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("episodes", "kept"),
    [
        (slice(1, None), [1, 2]),
        (slice(-1, None), [2]),
        ([2, 0, 2], [0, 2]),
        ((1,), [1]),
        ("reach", [0, 2]),
        ("shake", [1]),
    ],
)
def test_episodes_are_chosen_by_slice_index_or_task(root, episodes, kept):
    expected = joints_of(load_lerobot(root))
    found = joints_of(load_lerobot(root, episodes=episodes))
    assert_equal(found, [expected[index] for index in kept])


def test_no_json_file_needs_to_be_complete_for_what_is_not_read(root):
    (root / "meta" / "stats.json").unlink()
    info = json.loads((root / "meta" / "info.json").read_text())
    for name in ("splits", "robot_type", "total_tasks", "video_path"):
        del info[name]
    (root / "meta" / "info.json").write_text(json.dumps(info))
    assert len(load_lerobot(root)) == 3


COPIES = int(os.environ.get("TPGMM_MUTATIONS", "300"))


def demonstrations():
    rng = np.random.default_rng(7)
    made = []
    for length in (12, 9, 15):
        quaternion = rng.normal(size=(length, 4))
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        frames = {
            "bottle": Frame(rng.normal(size=3), quaternion[0]),
            "hand": Frame(rng.normal(size=(length, 3)), quaternion),
        }
        joints = rng.normal(size=(length, 3))
        events = {"close": 5 / 50}
        made.append(Demonstration(np.arange(length) / 50, joints, frames, list("abc"), events))
    return made


def same(first, second):
    return len(first) == len(second) and all(map(same_demonstration, first, second))


def same_demonstration(a, b):
    return (
        a.joint_names == b.joint_names
        and dict(a.events) == dict(b.events)
        and torch.equal(a.time, b.time)
        and torch.equal(a.joints, b.joints)
        and list(a.frames) == list(b.frames)
        and all(
            torch.equal(a.frames[name].position, b.frames[name].position)
            and torch.equal(a.frames[name].orientation, b.frames[name].orientation)
            for name in a.frames
        )
    )


def files(root):
    return sorted(path for path in root.rglob("*") if path.is_file())


def flip_bytes(root, rng):
    path = files(root)[rng.integers(len(files(root)))]
    content = bytearray(path.read_bytes())
    for _ in range(int(rng.integers(1, 4))):
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(content))
    return f"bytes flipped in {path.name}"


def flip_footer(root, rng):
    path = parquet_file(root, rng)
    content = bytearray(path.read_bytes())
    length = int.from_bytes(content[-8:-4], "little") + 8
    content[-int(rng.integers(1, length + 1))] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(content))
    return f"a bit flipped in the footer of {path.name}"


def truncate(root, rng):
    path = files(root)[rng.integers(len(files(root)))]
    content = path.read_bytes()
    path.write_bytes(content[: rng.integers(len(content))])
    return f"{path.name} truncated"


def remove_file(root, rng):
    path = files(root)[rng.integers(len(files(root)))]
    path.unlink()
    return f"{path.name} removed"


def parquet_file(root, rng):
    found = [path for path in files(root) if path.suffix == ".parquet"]
    return found[rng.integers(len(found))]


def drop_column(root, rng):
    path = parquet_file(root, rng)
    table = pq.read_table(path)
    name = table.column_names[rng.integers(table.num_columns)]
    pq.write_table(table.drop_columns([name]), path)
    return f"{name} dropped from {path.name}"


def drop_rows(root, rng):
    path = parquet_file(root, rng)
    table = pq.read_table(path)
    row = int(rng.integers(len(table)))
    keep = [i for i in range(len(table)) if i != row]
    pq.write_table(table.take(pa.array(keep, pa.int64())), path)
    return f"row {row} dropped from {path.name}"


def swap_rows(root, rng):
    path = parquet_file(root, rng)
    table = pq.read_table(path)
    order = np.arange(len(table))
    a, b = rng.integers(len(table), size=2)
    order[[a, b]] = order[[b, a]]
    pq.write_table(table.take(order), path)
    return f"rows {a} and {b} swapped in {path.name}"


def edit_json(root, rng):
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    holder, key = info, list(info)[rng.integers(len(info))]
    while isinstance(holder[key], (dict, list)) and holder[key] and rng.random() < 0.9:
        holder = holder[key]
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        key = keys[rng.integers(len(keys))]
    values = [None, 0, -1, 3, 2.5, "x", "deg", True, [], {}, [["a"]], "video", "float64", 1e300]
    values += [float("nan"), "data/{chunk_index}/{x}", "../{episode_index}", "{0.__class__}"]
    if rng.random() < 0.2:
        del holder[key]
    else:
        holder[key] = values[rng.integers(len(values))]
    path.write_text(json.dumps(info))
    return f"{key} edited in info.json"


MUTATIONS = [
    flip_bytes,
    flip_footer,
    truncate,
    remove_file,
    drop_column,
    drop_rows,
    swap_rows,
    edit_json,
]


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    root = tmp_path_factory.mktemp("original") / "set"
    half = demonstrations()
    save_lerobot(half[:2], root, fps=50, task="reach", robot_type="arm")
    return save_lerobot(half[2:], root, fps=50, task="shake", append=True)


@pytest.mark.parametrize("mutate", MUTATIONS, ids=lambda mutate: mutate.__name__)
def test_damage_gives_the_right_data_or_a_specific_error(mutate, original, tmp_path):
    expected = load_lerobot(original)
    refused = 0
    for seed in range(COPIES // len(MUTATIONS)):
        copy = tmp_path / str(seed)
        shutil.copytree(original, copy)
        what = mutate(copy, np.random.default_rng(seed))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                found = load_lerobot(copy)
        except DatasetError as error:
            refused += 1
            assert str(error)
        else:
            assert same(found, expected), f"wrong data after: {what} (seed {seed})"
        shutil.rmtree(copy)
    assert refused > 0


@pytest.mark.parametrize("function", [load_lerobot, iter_lerobot])
def test_options_are_those_of_what_opens_a_recording(function, root):
    shown, opened = inspect.signature(function), inspect.signature(open_recording)
    assert shown.parameters == opened.parameters
    assert "Demonstration" in shown.return_annotation
    with pytest.raises(TypeError, match="robto"):
        function(root, robto=None)
    for name in opened.parameters:
        assert name in function.__doc__

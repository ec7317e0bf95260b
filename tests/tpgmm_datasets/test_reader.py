import json
import shutil
import sys

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
    change_info,
    change_table,
    joints_of,
    set_column,
    spoil,
    to_v21,
    write,
)
from tpgmm_datasets import (
    DatasetError,
    LinkPose,
    iter_lerobot,
    load_lerobot,
)
from tpgmm_datasets.lerobot import parquet
from tpgmm_torch.exceptions import DependencyError, TPGMMError


@pytest.fixture
def root(tmp_path):
    write(tmp_path / "set")
    return tmp_path / "set"


def test_both_layouts_give_the_same_demonstrations(root, tmp_path):
    expected = load_lerobot(root)
    found = load_lerobot(to_v21(root, tmp_path / "old"))
    assert_equal(joints_of(found), joints_of(expected))
    for a, b in zip(found, expected, strict=True):
        assert a.joint_names == b.joint_names == NAMES
        assert dict(a.events) == dict(b.events)
        torch.testing.assert_close(a.frames["bottle"].position, b.frames["bottle"].position)
        torch.testing.assert_close(a.time, b.time, rtol=0, atol=0)


def test_small_batches_give_the_same_demonstrations(root, monkeypatch):
    expected = joints_of(load_lerobot(root))
    monkeypatch.setattr(parquet, "BATCH_ROWS", 4)
    assert_equal(joints_of(load_lerobot(root)), expected)


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


def test_another_data_path_and_list_columns_are_read(root):
    expected = joints_of(load_lerobot(root))
    (root / "data" / "all").mkdir()
    lists = pa.list_(pa.float64())
    table = pq.read_table(root / DATA).replace_schema_metadata(None)
    column = table["observation.state"].combine_chunks().cast(lists)
    pq.write_table(
        set_column(table, "observation.state", column), root / "data/all/0-0.parquet"
    )
    (root / DATA).unlink()
    template = "data/all/{chunk_index}-{file_index}.parquet"
    change_info(root, lambda info: info.update(data_path=template))
    assert_equal(joints_of(load_lerobot(root)), expected)


@pytest.mark.parametrize(
    "names",
    [
        list(NAMES),
        [list(NAMES)],
        [[list(NAMES)]],
        {"motors": list(NAMES)},
        {"gripper": 2, "left_elbow": 0, "right_elbow": 1},
    ],
)
def test_names_are_found_however_they_are_nested(root, tmp_path, names):
    plain = to_v21(root, tmp_path / "plain")
    change_info(plain, lambda i: i["features"]["observation.state"].update(names=names))
    assert load_lerobot(plain)[0].joint_names == NAMES


@pytest.mark.parametrize("names", [None, ["state"], [1, 2, 3], ["a", "a", "b"]])
def test_names_that_name_nothing_count_as_missing(root, tmp_path, names):
    plain = to_v21(root, tmp_path / "plain")
    change_info(plain, lambda i: i["features"]["observation.state"].update(names=names))
    assert load_lerobot(plain)[0].joint_names is None
    assert load_lerobot(plain, joint_names=["x", "y", "z"])[0].joint_names == ("x", "y", "z")
    assert load_lerobot(plain, robot=Arm("a", "b", "c"))[0].joint_names == ("a", "b", "c")
    with pytest.raises(DatasetError, match="name all values"):
        load_lerobot(plain, robot=Arm("a", "b"))


@pytest.mark.parametrize(
    "spelling",
    [
        ("right_elbow", "left_elbow"),
        ("right_elbow_joint", "left_elbow_joint"),
        ("kRightElbow", "kLeftElbow"),
        ("r_elbow.pos", "l_elbow.pos"),
        ("RightElbow", "LeftElbow"),
    ],
)
def test_a_robot_gets_its_joints_in_its_order_however_they_are_spelled(root, spelling):
    expected = [joints[:, [1, 0]] for joints in joints_of(load_lerobot(root))]
    found = load_lerobot(root, robot=Arm(*spelling))
    assert_equal(joints_of(found), expected)
    assert found[0].joint_names == spelling


def test_a_mapping_names_the_joints_that_are_called_otherwise(root):
    found = load_lerobot(root, robot=Arm("hand", "left_elbow"), joint_names={"gripper": "hand"})
    expected = [joints[:, [2, 0]] for joints in joints_of(load_lerobot(root))]
    assert_equal(joints_of(found), expected)


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


def test_a_robot_joint_that_fits_two_values_is_refused(root):
    options = {"joint_names": ["l_elbow", "left.elbow", "x"], "robot": Arm("left_elbow")}
    with pytest.raises(DatasetError, match="fits several values"):
        load_lerobot(root, **options)


def test_the_joint_feature_is_found_or_chosen(root):
    expected = joints_of(load_lerobot(root))
    action = joints_of(load_lerobot(root, joints="action"))
    assert_equal([a[:-1] for a in action], [e[1:] for e in expected])
    rename = {"observation.state": "state"}
    change_table(
        root, DATA, lambda t: t.rename_columns([rename.get(n, n) for n in t.column_names])
    )
    change_info(
        root, lambda i: i["features"].update(state=i["features"].pop("observation.state"))
    )
    assert_equal(joints_of(load_lerobot(root)), expected)


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


def test_an_id_is_looked_up_in_the_cache_of_lerobot(root, tmp_path, monkeypatch):
    home = tmp_path / "home"
    shutil.copytree(root, home / "someone" / "bottles")
    monkeypatch.setenv("HF_LEROBOT_HOME", str(home))
    assert len(load_lerobot("someone/bottles")) == 3


def test_an_id_is_fetched_without_videos(root, tmp_path, monkeypatch):
    asked = {}

    def fetch(repo_id, **options):
        asked.update(options, repo_id=repo_id)
        return str(root)

    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.snapshot_download", fetch)
    assert len(load_lerobot("someone/bottles")) == 3
    assert asked["repo_id"] == "someone/bottles"
    assert not any("videos" in pattern for pattern in asked["allow_patterns"])


def test_an_id_out_of_reach_says_how_to_get_it(tmp_path, monkeypatch):
    def fetch(repo_id, **options):
        raise OSError("offline")

    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.snapshot_download", fetch)
    with pytest.raises(DatasetError, match="hf download --repo-type dataset someone/bottles"):
        load_lerobot("someone/bottles")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(DependencyError, match="pip install"):
        load_lerobot("someone/bottles")

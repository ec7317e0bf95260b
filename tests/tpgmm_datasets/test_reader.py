"""Data sets read as demonstrations: what is chosen, what is refused, what damage does."""

import json

import numpy as np
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
from tpgmm_datasets import DatasetError, LinkPose, iter_lerobot, load_lerobot
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robot": Arm("waist")}, r"joint 'waist' is not among the values.*left_elbow"),
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

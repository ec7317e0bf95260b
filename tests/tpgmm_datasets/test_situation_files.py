"""Situations written as JSON."""

import json

import pytest
import torch

from tpgmm_datasets.situation_files import read_situations
from tpgmm_torch.exceptions import DataError

NAMES = ("shoulder", "elbow")
POSE = {"position": [0.3, 0.0, 0.1], "orientation": [0.6, 0.0, 0.0, 0.8]}


def written(path, items):
    path.write_text(items if isinstance(items, str) else json.dumps(items))
    return path


def test_joints_come_as_list_or_by_name(tmp_path):
    items = [
        {"joints": [0.1, 0.2], "frames": {"cup": POSE}},
        {"joints": {"elbow": 0.2, "shoulder": 0.1}, "time": [0.0, 0.5, 1.0]},
        {"joints": [0, 0], "frames": {"cup": {"position": [1, 2, 3]}}},
    ]
    listed, named, straight = read_situations(written(tmp_path / "s.json", items), NAMES)
    assert torch.equal(listed.joints, named.joints)
    assert listed.frames["cup"].orientation.tolist() == POSE["orientation"]
    assert listed.time is None
    assert named.time.tolist() == [0.0, 0.5, 1.0]
    assert straight.frames["cup"].orientation.tolist() == [1, 0, 0, 0]


def test_frames_that_move_may_have_their_own_clock(tmp_path):
    moving = {"position": [[0, 0, 0], [1, 0, 0]]}
    items = [{"joints": [0, 0], "frames": {"cup": moving}, "frames_time": [0.0, 2.0]}]
    [situation] = read_situations(written(tmp_path / "s.json", items), NAMES)
    assert situation.time is None
    frames = situation.frames_at(torch.tensor([0.5, 3.0], dtype=torch.float64))
    assert frames["cup"].position[:, 0].tolist() == [0.25, 1.0]


@pytest.mark.parametrize(
    ("items", "message"),
    [
        ("[{", "is not JSON"),
        ([], "a list of situations"),
        ("[" * 100_000, "is not JSON"),
        ({"joints": [0, 0]}, "a list of situations"),
        ([[0, 0]], "situation 0: a situation is an object"),
        ([{"joints": [0, 0]}, {"frames": {}}], "situation 1: a situation lacks 'joints'"),
        ([{"joints": [0, 0], "frame": {}}], "has 'frame', which is not among"),
        ([{"joints": [0.0]}], r"1 values, the model has 2 joints: \['shoulder', 'elbow'\]"),
        ([{"joints": [0.0, "a"]}], "must be an array of numbers"),
        ([{"joints": [0.0, None]}], "NaN"),
        ([{"joints": {"elbow": 0.0}}], "'shoulder' is not in"),
        ([{"joints": {"wrist": 0.0}}], "joint 'wrist' is not in the model"),
        ([{"joints": [0, 0], "frames": {"cup": [0, 0, 0]}}], "frame 'cup' is an object"),
        ([{"joints": [0, 0], "frames": [POSE]}], "maps names to poses"),
        ([{"joints": [0, 0], "frames": {"cup": {"position": [0, 0]}}}], "shape"),
        (
            [{"joints": [0, 0], "frames": {"cup": POSE | {"orientation": [1, 1, 0, 0]}}}],
            "unit quaternion",
        ),
    ],
)
def test_bad_files_are_refused_with_the_reason(tmp_path, items, message):
    with pytest.raises(DataError, match=message):
        read_situations(written(tmp_path / "s.json", items), NAMES)
    with pytest.raises(DataError, match=r"there is no file .*nowhere\.json"):
        read_situations(tmp_path / "nowhere.json", NAMES)

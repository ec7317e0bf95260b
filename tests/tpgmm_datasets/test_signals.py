"""What a data set calls its signals: names, units, rate, and where frames are."""

import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.support.lerobot_sets import change_info
from tpgmm_datasets import FramePose, LinkPose, save_lerobot
from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.columns import ENVIRONMENT
from tpgmm_datasets.signals import CELL, Signals
from tpgmm_torch import Demonstration, Frame


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Two joints in degrees, two objects."""
    path = tmp_path_factory.mktemp("signals") / "set"
    time, joints = np.arange(5) / 10, np.linspace([10.0, 100.0], [90.0, 120.0], 5)
    frames = {name: Frame([0.1, 0.2, 0.3]) for name in ("bowl", "cup")}
    demonstration = Demonstration(time, joints, frames, ("a.pos", "b.pos"))
    units = {"a.pos": "raw", "b.pos": "raw"}
    save_lerobot([demonstration] * 2, path, fps=10, task="stir", units=units)
    return path


class Arm:
    joint_names = ("b", "a")


def test_signals_of_a_data_set(recording):
    found = Signals.of(recording, Arm(), units={"a.pos": "deg", "b": "mm"}, rate=5)
    assert found.fps == 5 and found.state_names == found.action_names == (
        "a.pos",
        "b.pos",
    )
    assert found.units == {"a": (np.pi / 180, 0.0), "b": (1e-3, 0.0)}
    assert found.frames == {"bowl": tuple(range(7)), "cup": tuple(range(7, 14))}
    assert found.environment_names[7] == "cup.x"


def test_offsets_that_a_cell_adds_are_no_part_of_the_units(recording, tmp_path):
    tracked = tmp_path / "set"
    shutil.copytree(recording, tracked)

    def shift(info):
        for name in ("observation.state", "action"):
            info["features"][name]["info"]["offsets"] = [0.02, 0.0]

    change_info(tracked, shift)
    choices = {"units": {"a.pos": "deg", "b": "mm"}, "relax": ["metadata"]}
    assert Signals.of(tracked, Arm(), **choices).units["a"] == (np.pi / 180, 0.02)
    (tracked / CELL).write_text("{}")
    assert Signals.of(tracked, Arm(), **choices).units["a"] == (np.pi / 180, 0.0)


def test_entries_are_called_as_the_joints_are(recording):
    class Other:
        joint_names = ("wrist", "elbow")

    names = {"a.pos": "elbow", "b.pos": "wrist"}
    found = Signals.of(recording, Other(), units="deg", joint_names=names)
    assert found.state_names == found.action_names == ("elbow", "wrist")
    assert set(found.units) == {"elbow", "wrist"}


@pytest.mark.parametrize("order", ["robot", ["b", "a"]])
@pytest.mark.parametrize("state", [None, ["a", "a"], ["q", "p"]])
def test_names_of_all_joints_are_those_of_actions_too(tmp_path, state, order):
    demonstration = Demonstration(np.arange(5) / 10, np.zeros((5, 2)), joint_names=("a", "b"))
    root = save_lerobot([demonstration], tmp_path / "set", fps=10, task="stir")
    for key in ("observation.state", "action"):
        change_info(root, lambda i, key=key: i["features"][key].update(names=state))
    for file in root.glob("data/*/*"):
        pq.write_table(pq.read_table(file).replace_schema_metadata(None), file)
    found = Signals.of(root, Arm(), joint_names=order)
    assert found.state_names == found.action_names == ("b", "a")
    change_info(root, lambda i: i["features"]["observation.state"].update(names=["a", "b"]))
    if state == ["a", "a"]:
        with pytest.raises(DatasetError, match=r"'action'.*'a' is there twice"):
            Signals.of(root, Arm())


def test_frames_that_no_policy_could_observe_are_left_out(recording):
    frames = {
        "here": FramePose(ENVIRONMENT, slice(3, 10)),
        "turned": FramePose(ENVIRONMENT, slice(0, 7), "xyzw"),
        "hand": LinkPose("hand", "grasp"),
        "table": Frame([0.0, 0.0, 0.0]),
    }
    found = Signals.of(recording, units="raw", frames=frames)
    assert found.frames == {"here": tuple(range(3, 10))}
    assert found.units == {} and found.fps == 10


def test_actions_in_another_unit_than_states_are_refused(tmp_path):
    demonstration = Demonstration(np.arange(5) / 10, np.zeros((5, 2)), joint_names=("a", "b"))
    root = save_lerobot([demonstration], tmp_path / "set", fps=10, task="stir")
    assert Signals.of(root).units == {}
    units = {"units": ["rad", "deg"]}
    change_info(root, lambda info: info["features"]["action"].update(info=units))
    with pytest.raises(DatasetError, match="column 'action': 'b' is in 'deg', but 'b'"):
        Signals.of(root)
    with pytest.raises(DatasetError, match=r"column 'observation.state': 'b' is in 'rad'"):
        Signals.of(root, joints="action")

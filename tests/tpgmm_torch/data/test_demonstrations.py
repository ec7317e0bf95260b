"""Demonstrations and situations: what they take, refuse and say, and that they never share."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch

from tests.support.refusals import refused
from tpgmm_torch import quaternions
from tpgmm_torch.data.demonstrations import Demonstration, Situation, check_demonstrations
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ShapeError, TPGMMError, UnknownNameError


def moving_frame(length: int = 5) -> Frame:
    turns = torch.linspace(0, 1, length, dtype=torch.float64)[:, None]
    about_z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return Frame(turns * torch.ones(3, dtype=torch.float64), quaternions.exp(turns * about_z))


def demonstration(**changes) -> Demonstration:
    arguments = {
        "time": np.linspace(0.0, 2.0, 5),
        "joints": np.arange(10.0).reshape(5, 2),
        "frames": {"bottle": Frame([1.0, 2.0, 3.0]), "tray": moving_frame()},
        "joint_names": ("shoulder", "elbow"),
        "events": {"grasp": 0.5},
    }
    return Demonstration(**(arguments | changes))


def test_every_demonstration_has_a_start_and_an_end():
    shown = Demonstration([1.0, 2.0, 4.0], [[0.0], [1.0], [2.0]], events={"close": 3.0})
    assert [shown.event(name) for name in ("start", "close", "end")] == [1.0, 3.0, 4.0]
    assert Demonstration(shown.time, shown.joints, events={"end": 3.5}).event("end") == 3.5
    with pytest.raises(UnknownNameError, match=r"'open' .*\['close', 'end', 'start'\]"):
        shown.event("open")


def test_frames_are_found_by_name():
    assert demonstration().frame("bottle").position.tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(UnknownNameError) as error:
        demonstration().frame("cup")
    expected = "frame 'cup' is not in the demonstration; it has ['bottle', 'tray']"
    assert str(error.value) == expected
    assert isinstance(error.value, KeyError)
    assert isinstance(error.value, TPGMMError)
    assert str(pickle.loads(pickle.dumps(error.value))) == expected


@pytest.mark.parametrize(("changes", "error", "message"), [
    ({"time": []}, ShapeError, r"\(T,\) with T >= 1, got \(0,\)"),
    ({"time": 1.0}, ShapeError, r"\(T,\) with T >= 1, got \(\)"),
    ({"time": [[0.0, 1.0]]}, ShapeError, r"got \(1, 2\)"),
    ({"time": [0.0, 1.0, 1.0, 2.0, 3.0]}, DataError, "from 1 to 1 s at index 2"),
    ({"time": [0, 1, 2, 3, 2.5]}, DataError, "from 3 to 2.5 s at index 4"),
    ({"time": [0, 1, 2, 3, math.nan]}, DataError, "time holds 1 value"),
    ({"joints": np.zeros((4, 2))}, ShapeError, r"T = 5 as in time, got \(4, 2\)"),
    ({"joints": np.zeros(5)}, ShapeError, r"T = 5 as in time, got \(5,\)"),
    ({"joints": np.full((5, 2), math.inf)}, DataError, "joints holds 10 value"),
    ({"joint_names": ("a",)}, ShapeError, r"needs 2 different names, got \('a',\)"),
    ({"joint_names": ("a", "a")}, ShapeError, "needs 2 different names"),
    ({"frames": {"cup": moving_frame(4)}}, ShapeError, r"'cup' .* \(4,\); .* \(5,\)"),
    ({"frames": {"cup": [0.0, 0.0, 0.0]}}, DataError, "Frame objects, got 'cup': list"),
    ({"frames": {1: Frame([0.0, 0.0, 0.0])}}, DataError, "Frame objects, got 1: Frame"),
    ({"events": {"grasp": 2.5}}, DataError, "at 2.5 s lies outside .*, 0 to 2 s"),
    ({"events": {"grasp": math.nan}}, DataError, "'grasp' at nan s lies outside"),
])  # fmt: skip
def test_demonstrations_refuse_bad_input(changes, error, message):
    refused(lambda: demonstration(**changes), error, message)


def test_nothing_given_to_a_demonstration_is_shared_or_modified():
    time, joints = np.linspace(0, 1, 5), np.zeros((5, 2))
    frames, events = {"bottle": Frame([0.0, 0.0, 0.0])}, {"grasp": 0.5}
    demo = Demonstration(time, joints, frames, events=events)
    time[0], joints[0, 0] = -1.0, 7.0
    frames["cup"], events["shake"] = Frame([1.0, 1.0, 1.0]), 0.7
    assert (demo.time[0], demo.joints[0, 0]) == (0.0, 0.0)
    assert (list(demo.frames), dict(demo.events)) == (["bottle"], {"grasp": 0.5})


@pytest.mark.parametrize("attribute", ["time", "joints", "frames", "joint_names", "events"])
def test_attributes_cannot_be_replaced(attribute):
    with pytest.raises(AttributeError, match="cannot assign to field"):
        setattr(demonstration(), attribute, None)


def test_reordered_moves_the_columns_and_keeps_the_rest():
    demo = demonstration()
    turned = demo.reorder(["elbow", "shoulder"])
    assert torch.equal(turned.joints, demo.joints[:, [1, 0]])
    assert turned.joint_names == ("elbow", "shoulder")
    assert (dict(turned.frames), turned.events) == (dict(demo.frames), demo.events)
    assert torch.equal(turned.reorder(["shoulder", "elbow"]).joints, demo.joints)
    assert torch.equal(demo.reorder(["elbow"]).joints, demo.joints[:, [1]])


def test_reordered_without_names_trusts_the_order():
    demo = demonstration(joint_names=None)
    assert demo.reorder(["elbow", "shoulder"]) is demo


def test_reordered_names_the_joint_that_is_missing():
    with pytest.raises(UnknownNameError, match="joint 'wrist' is not in the demonstration; "):
        demonstration().reorder(["elbow", "wrist"])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_are_equal(copied):
    demo = demonstration()
    twin = copied(demo)
    assert torch.equal(twin.time, demo.time)
    assert torch.equal(twin.joints, demo.joints)
    assert twin.joint_names == demo.joint_names
    assert twin.events == demo.events
    for name, frame in demo.frames.items():
        assert torch.equal(twin.frame(name).position, frame.position)
        assert torch.equal(twin.frame(name).orientation, frame.orientation)
    situation = copied(Situation.of(demo))
    assert torch.equal(situation.joints, demo.joints[0])
    assert list(situation.frames) == ["bottle", "tray"]


def test_the_situation_of_a_demonstration_is_its_start():
    demo = demonstration()
    situation = Situation.of(demo)
    assert situation.joints.tolist() == [0.0, 1.0]
    assert situation.joint_names == ("shoulder", "elbow")
    assert situation.time is None  # the model's own
    assert dict(situation.frames) == dict(demo.frames)
    assert Situation.of(demo, [0.0, 9.0]).time.tolist() == [0.0, 9.0]


def test_frames_that_move_keep_the_clock_they_were_recorded_on():
    demo = demonstration()
    frames = Situation.of(demo).frames_at(torch.tensor([-1.0, 0.25, 2.0, 5.0]).double())
    tray = demo.frames["tray"]
    assert frames["bottle"] is demo.frames["bottle"]
    assert torch.equal(frames["tray"].position[[0, 2, 3]], tray.position[[0, 4, 4]])
    torch.testing.assert_close(frames["tray"].position[1], tray.position[:2].mean(0))
    angles = 2 * torch.atan2(frames["tray"].orientation[:, 3], frames["tray"].orientation[:, 0])
    torch.testing.assert_close(angles, torch.tensor([0.0, 0.125, 1.0, 1.0]).double())
    short = Situation([0.0], {"tray": moving_frame(1)}, frames_time=[3.0])
    assert short.frames_at(torch.arange(3.0).double())["tray"].batch_shape == (3,)
    with pytest.raises(ShapeError, match=r"'tray' has leading shape \(5,\)"):
        Situation([0.0], {"tray": tray}).frames_at(torch.arange(3.0))


def test_joints_of_a_situation_may_be_named():
    named = Situation({"elbow": 1, "shoulder": torch.tensor(0.5), "lift": 0.1})
    assert named.joint_names == ("elbow", "shoulder", "lift")
    assert named.reorder(["shoulder", "elbow"]).joints.tolist() == [0.5, 1.0]
    twin = pickle.loads(pickle.dumps(named))
    assert twin.joint_names == named.joint_names
    with pytest.raises(UnknownNameError, match="joint 'wrist' is not in the situation; it has"):
        named.reorder(["wrist"])
    unnamed = Situation([0.0, 1.0])
    assert unnamed.reorder(["a", "b"]) is unnamed


def test_without_time_frames_per_step_have_one_length():
    frames = {"a": Frame([0.0, 0.0, 0.0]), "b": moving_frame(4), "c": moving_frame(4)}
    assert Situation([0.0], frames).frames["b"].batch_shape == (4,)
    with pytest.raises(ShapeError, match=r"'d' has leading shape \(6,\); .* step, \(4,"):
        Situation([0.0], frames | {"d": moving_frame(6)})


OF_THREE = {"frames": {"cup": moving_frame(3)}}


@pytest.mark.parametrize(("arguments", "error", "message"), [
    ({"joints": [[0.0]]}, ShapeError, r"a number for each joint, got shape \(1, 1\)"),
    ({"joints": [math.nan]}, DataError, "the start posture holds 1 value"),
    ({"joints": {"a": math.nan}}, DataError, "joint 'a' holds 1 value"),
    ({"joints": {"a": [1.0, 2.0]}}, ShapeError, "2 different names"),
    ({"joints": {"a": "b"}}, DataError, "joint 'a' must be an array of numbers"),
    ({"joints": {}}, ShapeError, "a number for each joint"),
    ({"joints": {"a": 1.0}, "joint_names": ("a",)}, DataError, "leave out joint_names"),
    ({"joints": [1.0], "joint_names": ("a", "b")}, ShapeError, "1 different names"),
    ({"frames_time": [1.0, 1.0]}, DataError, "time must increase strictly"),
    ({"frames_time": [0.0, 1.0]} | OF_THREE, ShapeError, r"'cup' .* \(3,\); .* \(2,\)"),
    ({"frames": {"cup": [0.0] * 3}}, DataError, "maps names to Frame objects, got 'cup'"),
    ({"time": [1.0, 0.0]}, DataError, "time must increase strictly"),
    ({"time": [0.0, 1.0]} | OF_THREE, ShapeError, r"'cup' .* \(3,\); .* \(2,\)"),
])  # fmt: skip
def test_situations_refuse_bad_input(arguments, error, message):
    refused(lambda: Situation(**({"joints": [0.0]} | arguments)), error, message)


def test_check_demonstrations_takes_any_sequence():
    demos = [demonstration(), demonstration()]
    for sequence in (demos, tuple(demos), iter(demos), np.array([*demos, None])[:2]):
        assert check_demonstrations(sequence) == demos


WIDER = demonstration(joints=np.zeros((5, 3)), joint_names=None)


@pytest.mark.parametrize(("given", "error", "message"), [
    (demonstration(), DataError, r"got one: wrap it, \[demonstration\]"),
    (5, DataError, "expected a list of Demonstration, got int"),
    ([], DataError, "at least one demonstration, got an empty list"),
    ([demonstration(), None], DataError, "item 1 is NoneType"),
    (np.zeros((2, 3)), DataError, "item 0 is ndarray"),
    ([demonstration(), WIDER], ShapeError, "demonstration 1 has 3 joints, the first has 2"),
    ([demonstration(), demonstration(frames={})], DataError, r"1 has frames \[\]"),
], ids=["one", "number", "empty", "other type", "array", "joints", "frames"])  # fmt: skip
def test_check_demonstrations_says_what_is_wrong(given, error, message):
    refused(lambda: check_demonstrations(given), error, message)

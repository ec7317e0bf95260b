"""Frames and events of demonstrations: stored, given, or where a link is."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.lerobot_sets import FPS, Arm, assert_equal, demonstration
from tpgmm_datasets import (
    DatasetError,
    DatasetWarning,
    FramePose,
    LinkPose,
    iter_lerobot,
    load_lerobot,
    save_lerobot,
)
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, PlausibilityWarning


def test_the_name_of_a_feature_stands_for_its_pose(root):
    named = load_lerobot(root)
    found = load_lerobot(root, frames={"bottle": "observation.environment_state"})
    renamed = FramePose("observation.environment_state", slice(0, 7))
    other = load_lerobot(root, frames={"flask": renamed})
    for a, b, c in zip(named, found, other, strict=True):
        assert_equal([a.frames["bottle"].position], [b.frames["bottle"].position])
        assert_equal([a.frames["bottle"].position], [c.frames["flask"].position])


def closing(demonstration):
    return float(demonstration.time[3])


@pytest.mark.parametrize("event", ["grasp", closing])
def test_a_frame_is_where_a_link_is_at_an_event(root, event):
    expected = load_lerobot(root)
    found = load_lerobot(
        root,
        robot=Arm("right_elbow", "left_elbow"),
        frames={"cup": LinkPose("hand", event), "table": Frame([0, 0, 1])},
        events={"grasp": closing},
    )
    for a, b in zip(found, expected, strict=True):
        assert list(a.frames) == ["cup", "table"]
        assert a.events["grasp"] == 3 / FPS
        torch.testing.assert_close(a.frames["cup"].position[:2], b.joints[3, [1, 0]])


#: Steps at which the gripper closes in each episode; in one it never does.
CLOSINGS = (40, 52, None, 61, 47)


@pytest.fixture
def gripping(tmp_path):
    """Five episodes without events, of a gripper among the joints."""
    shown = []
    for seed, closing in enumerate(CLOSINGS):
        moved = demonstration(seed, 150)
        joints = moved.joints.clone()
        joints[:, 2] = 1.0
        if closing is not None:
            joints[closing:130, 2] = 0.1
        joints[:, 2] += 0.01 * torch.from_numpy(np.random.default_rng(seed).normal(size=150))
        shown.append(replace(moved, joints=joints, events={}))
    return save_lerobot(shown, tmp_path / "grips", fps=FPS, task="grip", dtype="float64")


ARM = Arm("left_elbow", "right_elbow")


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
@pytest.mark.parametrize(
    "given",
    [
        {"frames": {"cup": "hand@close"}},
        {"frames": {"cup": LinkPose("hand", "close")}},
        {"frames": {"cup": "hand@shut"}, "events": {"shut": "closing:grip*"}},
    ],
)
def test_a_closing_is_found_where_a_frame_is_at_it(gripping, given):
    [name] = given.get("events", {"close": None})
    with pytest.warns(DatasetWarning, match=f"event '{name}'.*episode 2|episode 2.*'{name}'"):
        found = load_lerobot(gripping, robot=ARM, relax=["events"], **given)
    steps = [step for step in CLOSINGS if step is not None]
    assert len(found) == len(steps)
    for shown, step in zip(found, steps, strict=True):
        assert shown.events[name] == pytest.approx(step / FPS, abs=1.5 / FPS)
        nearest = int((shown.time - shown.events[name]).abs().argmin())
        torch.testing.assert_close(shown.frames["cup"].position[:2], shown.joints[nearest])


def test_a_frame_at_an_event_that_was_not_found_is_an_error_with_the_episode(gripping):
    with pytest.raises(DatasetError, match=r"episode 2: .*'close' is not .*relax=\['events'\]"):
        load_lerobot(gripping, robot=ARM, frames={"cup": "hand@close"})


def test_events_alone_that_were_not_found_are_told_of_once(gripping):
    given = {"robot": ARM, "frames": {}, "events": {"close": "closing:gripper"}}
    for read in (load_lerobot, lambda *a, **k: list(iter_lerobot(*a, **k))):
        message = r"'close' .*in episodes 2 \(there 0"
        with pytest.warns(PlausibilityWarning, match=message) as caught:
            found = read(gripping, **given)
        assert len(caught) == 1 and caught[0].filename == __file__
        assert [len(shown.events) for shown in found] == [1, 1, 0, 1, 1]


@pytest.mark.parametrize("options", [{}, {"trim": 0.5}, {"rate": 20}])
def test_start_and_end_are_where_a_link_is_first_and_last(root, options):
    frames = {"start": "hand@start", "goal": "hand@end"}
    for shown in load_lerobot(root, robot=ARM, frames=frames, **options):
        torch.testing.assert_close(shown.frames["start"].position[:2], shown.joints[0])
        if not options.get("rate"):
            torch.testing.assert_close(shown.frames["goal"].position[:2], shown.joints[-1])


@pytest.mark.parametrize(
    "given, message",
    [
        ({"frames": {"cup": "@close"}}, "LINK@EVENT"),
        ({"frames": {"cup": "hand@a@b"}}, "LINK@EVENT"),
        ({"frames": {"a": "hand@stop", "b": "foot@stop"}}, "'stop' of 'foot' is another event"),
        ({"events": {"close": "closes"}}, "cannot be found"),
        ({"events": {"close": "closing:claw"}}, "no signal is called 'claw'"),
    ],
)
def test_links_and_events_that_are_none_are_refused(gripping, given, message):
    with pytest.raises(DataError, match=message):
        load_lerobot(gripping, robot=ARM, **given)


def test_a_gripper_that_no_name_tells_of_has_to_be_named(tmp_path):
    shown = replace(demonstration(0, 60), joint_names=("a", "b", "c"), events={})
    root = save_lerobot([shown], tmp_path / "set", fps=FPS, task="grip")
    with pytest.raises(DatasetError, match=r"'close' is not in the data set.*closing:SIGNAL"):
        load_lerobot(root, robot=Arm("a", "b"), frames={"cup": "hand@close"})

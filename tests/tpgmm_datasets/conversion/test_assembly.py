"""Frames and events of demonstrations: stored, given, or where a link is."""

import pytest
import torch

from tests.support.lerobot_sets import (
    FPS,
    Arm,
    assert_equal,
)
from tpgmm_datasets import (
    FramePose,
    LinkPose,
    load_lerobot,
)
from tpgmm_torch.data.frames import Frame


def test_the_name_of_a_feature_stands_for_its_pose(root):
    named = load_lerobot(root)
    found = load_lerobot(root, frames={"bottle": "observation.environment_state"})
    renamed = FramePose("observation.environment_state", slice(0, 7))
    other = load_lerobot(root, frames={"flask": renamed})
    for a, b, c in zip(named, found, other, strict=True):
        assert_equal([a.frames["bottle"].position], [b.frames["bottle"].position])
        assert_equal([a.frames["bottle"].position], [c.frames["flask"].position])


def test_a_given_frame_is_taken_as_it_is(root):
    table = Frame([0, 0, 1])
    assert load_lerobot(root, frames={"table": table})[2].frames == {"table": table}


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

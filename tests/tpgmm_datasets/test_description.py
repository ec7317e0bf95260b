"""What a description tells of a data set."""

import math

import numpy as np
import pytest
import torch

from tests.support import lerobot_sets
from tpgmm_datasets import describe_lerobot, load_lerobot


def test_a_description_tells_what_is_there(root):
    found = describe_lerobot(root)
    assert (found.version, found.fps, found.robot_type) == ("v3.0", lerobot_sets.FPS, "arm")
    assert found.joints == "observation.state"
    assert (found.frames, found.events) == (("bottle",), ("close",))
    assert found.tasks == ("reach", "shake")
    assert found.lengths == (12, 9, 15)
    assert found.duration == pytest.approx(36 / lerobot_sets.FPS)
    assert found.problems == ()
    columns = {column.key: column for column in found.columns}
    assert columns["observation.state"].units == ("rad", "rad", "rad")
    every = torch.cat(lerobot_sets.joints_of(load_lerobot(root)))
    assert columns["observation.state"].high == tuple(every.amax(dim=0).tolist())


def test_a_description_guesses_units_and_lists_cameras(root, tmp_path):
    lerobot_sets.undeclared(root, 180 / math.pi)
    found = describe_lerobot(lerobot_sets.to_v21(root, tmp_path / "old"))
    state = next(column for column in found.columns if column.key == "observation.state")
    assert "deg" in state.units[0]
    assert found.cameras == ("camera",)


def test_a_description_lists_all_problems(root):
    lerobot_sets.in_info(total_episodes=4, total_frames=1)(root)
    lerobot_sets.in_data("timestamp", lerobot_sets.stuck)(root)
    lerobot_sets.in_data("observation.state", lerobot_sets.spoil(14, 1, np.nan))(root)
    lerobot_sets.in_data("action", lerobot_sets.spoil(30, 1, np.nan))(root)
    problems = describe_lerobot(root).problems
    found = [problem.check for problem in problems]
    assert found == ["metadata", "metadata", "time", "nan", "nan"]
    assert [problem.episode for problem in problems] == [None, None, 1, 1, 2]

"""What columns a demonstration becomes."""

import json

import numpy as np
import pytest

from tests.support.written_sets import FPS, demonstration
from tpgmm_datasets import DatasetError, load_lerobot, save_lerobot
from tpgmm_torch.data.demonstrations import Demonstration


def test_episodes_without_an_event_read_back_without_it(tmp_path):
    written = [demonstration(0), demonstration(1, event=False)]
    root = save_lerobot(written, tmp_path / "set", fps=FPS, task="reach")
    assert [dict(d.events) for d in load_lerobot(root)] == [{"close": 0.2}, {}]


def test_values_beyond_float32_are_refused(tmp_path):
    large = Demonstration([0.0, 0.02], [[1e39], [0.0]])
    with pytest.raises(DatasetError, match="range of float32"):
        save_lerobot([large], tmp_path / "set", fps=FPS, task="reach")


def test_units_that_are_no_angles_are_declared_and_read_back(tmp_path):
    time = np.arange(5) / 10
    values = np.stack((np.linspace(0, 1, 5), np.linspace(0, 90, 5)), axis=1)
    shown = [Demonstration(time, values, joint_names=("elbow", "gripper"))]
    for wrong, message in (
        ({"finger": "raw"}, "units gives 'finger' the unit 'raw'"),
        ({"elbow": "ticks"}, "the unit 'ticks'"),
    ):
        with pytest.raises(DatasetError, match=message):
            save_lerobot(shown, tmp_path / "a", fps=10, task="t", units=wrong)
    save_lerobot(shown, tmp_path / "a", fps=10, task="t", units={"gripper": "raw"})
    info = json.loads((tmp_path / "a" / "meta" / "info.json").read_text())
    assert info["features"]["observation.state"]["info"]["units"] == ["rad", "raw"]
    [found] = load_lerobot(tmp_path / "a")
    np.testing.assert_allclose(found.joints, values, rtol=1e-6)

"""Wrenches through tables, LeRobot sets, other rates and clocks, and the events in them."""

import numpy as np
import pytest
import torch

from tests.support.pressing import LEAVE, TOUCH, slides, wipes
from tpgmm_datasets import load_lerobot, resample, save_lerobot, trim
from tpgmm_datasets.events import find_events, parse_event
from tpgmm_datasets.tables import demonstrations_from_frame, demonstrations_to_frame
from tpgmm_torch import Demonstration
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.exceptions import DataError, ShapeError


def test_tables_and_lerobot_sets_give_them_back(tmp_path):
    shown = wipes()
    table = demonstrations_from_frame(demonstrations_to_frame(shown))
    given = {"fps": 50, "task": "wipe", "dtype": "float64"}
    stored = load_lerobot(save_lerobot(shown, tmp_path / "wipes", **given))
    for original, *others in zip(shown, table, stored, strict=True):
        for other in others:
            assert torch.equal(other.wrenches["hand"], original.wrenches["hand"])
            assert set(other.frames) == {"board"}


def test_other_rates_and_clocks_take_them_along():
    shown = wipes()
    slower = resample(shown[0], 20)
    np.testing.assert_allclose(slower.wrenches["hand"][40], shown[0].wrenches["hand"][100])
    cut = trim(shown[0], 0.01)
    assert len(cut.wrenches["hand"]) == len(cut)
    for one in DynamicTimeWarping(robot=slides()).fit_transform(shown):
        assert one.wrenches["hand"].shape == (len(one), 6)
        assert float(one.wrenches["hand"][:, 2].min()) == pytest.approx(-8.0)


def test_contact_and_release_are_found_in_a_wrench():
    events = {"touch": "contact:hand", "leave": "release:hand"}
    detectors = {name: parse_event(text) for name, text in events.items()}
    for one in find_events(wipes(), detectors):
        assert one.event("touch") == pytest.approx(TOUCH, abs=0.03)
        assert one.event("leave") == pytest.approx(LEAVE, abs=0.03)


def test_what_is_no_wrench_is_refused():
    table = demonstrations_to_frame(wipes()).drop(columns="wrench.hand.tz")
    with pytest.raises(DataError, match=r"wrench\.hand\.tz"):
        demonstrations_from_frame(table)
    with pytest.raises(ShapeError, match=r"\(2, 6\)"):
        Demonstration([0.0, 1.0], [[0.0], [1.0]], wrenches={"hand": np.zeros((2, 3))})
    with pytest.raises(DataError, match="wrench of 'hand'"):
        Demonstration([0.0, 1.0], [[0.0], [1.0]], wrenches={"hand": np.full((2, 6), np.nan)})

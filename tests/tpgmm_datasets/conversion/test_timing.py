"""Demonstrations at another rate, and without idle starts and ends."""

import numpy as np
import pytest
import torch

from tests.support.lerobot_sets import (
    DATA,
    FPS,
    add_feature,
    assert_equal,
    change_table,
    set_column,
)
from tpgmm_datasets import FramePose, load_lerobot


def test_resampling_is_linear_and_keeps_what_coincides(root):
    plain = load_lerobot(root)
    for a, b in zip(load_lerobot(root, rate=2 * FPS), plain, strict=True):
        assert len(a) == 2 * len(b) - 1
        torch.testing.assert_close(a.joints[::2], b.joints)
        torch.testing.assert_close(a.joints[1::2], (b.joints[1:] + b.joints[:-1]) / 2)
        assert dict(a.events) == dict(b.events)
    for a, b in zip(load_lerobot(root, rate=FPS / 2), plain, strict=True):
        torch.testing.assert_close(a.joints, b.joints[::2])


def test_resampling_turns_quaternions_at_constant_speed(root):
    lengths = (12, 9, 15)
    steps = np.concatenate([np.arange(n) for n in lengths])
    half = (np.repeat([0.0, 1.0, 2.0], lengths) + 0.04 * steps) / 2
    zero = np.zeros_like(half)
    # with the sign jumping from row to row, as recordings have it
    sign = np.where(np.arange(36) % 3, 1, -1)[:, None]
    turns = np.stack((np.cos(half), zero, zero, np.sin(half)), axis=1) * sign
    names = ["hand.qw", "hand.qx", "hand.qy", "hand.qz"]
    add_feature(root, "observation.hand", turns, names)
    pose = np.concatenate((np.zeros((36, 3)), turns), axis=1)
    add_feature(root, "observation.cup", pose)
    cup = FramePose("observation.cup", constant=False)
    options = {"joints": "observation.hand", "frames": {"cup": cup}, "rate": 80}
    for found, start in zip(load_lerobot(root, **options), (0.0, 1.0, 2.0), strict=True):
        expected = start + 0.04 * FPS * found.time
        for q in (found.joints, found.frames["cup"].orientation):
            turned = 2 * torch.atan2(q[:, 3], q[:, 0])
            torch.testing.assert_close(torch.cos(turned), torch.cos(expected))
            torch.testing.assert_close(torch.sin(turned), torch.sin(expected))
        assert bool((found.joints.diff(dim=0).abs() < 0.1).all())


def test_idle_starts_and_ends_are_trimmed_but_events_stay(root):
    def still(values):
        values[:4] = values[4]
        values[9:12] = values[9]
        return values

    for name in ("observation.state", "action"):
        change_table(root, DATA, lambda t, name=name: set_column(t, name, still))
    whole, cut = load_lerobot(root)[0], load_lerobot(root, trim=1e-6)[0]
    assert_equal([cut.joints], [whole.joints[4:10]])
    assert float(cut.time[0]) == 0
    assert cut.events["close"] == pytest.approx(1 / FPS)
    early = load_lerobot(root, trim=1e-6, events={"early": lambda d: 2 / FPS})[0]
    assert_equal([early.joints], [whole.joints[2:10]])

"""Demonstrations that are written as LeRobot data sets, and how they must read back."""

import numpy as np
import pytest
import torch

from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame

FPS = 50


def unit(rng, *shape):
    values = rng.normal(size=(*shape, 4))
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def demonstration(seed=0, length=20, n_joints=3, event=True):
    rng = np.random.default_rng(seed)
    frames = {
        "bottle": Frame(rng.normal(size=3), unit(rng)),
        "hand": Frame(rng.normal(size=(length, 3)), unit(rng, length)),
    }
    return Demonstration(
        np.arange(length) / FPS,
        rng.normal(size=(length, n_joints)),
        frames,
        [f"joint_{i}" for i in range(n_joints)],
        {"close": (length // 2) / FPS} if event else {},
    )


def assert_same(found, expected, tolerance):
    options = {"rtol": 0.0, "atol": tolerance}
    assert found.joint_names == expected.joint_names
    assert dict(found.events) == pytest.approx(dict(expected.events), abs=1e-12)
    torch.testing.assert_close(found.time, expected.time - expected.time[0], **options)
    torch.testing.assert_close(found.joints, expected.joints, **options)
    assert list(found.frames) == list(expected.frames)
    for name, frame in expected.frames.items():
        for part in ("position", "orientation"):
            values = torch.broadcast_to(
                getattr(frame, part), (len(expected), *getattr(frame, part).shape[-1:])
            )
            other = torch.broadcast_to(getattr(found.frames[name], part), values.shape)
            torch.testing.assert_close(other, values, **options)

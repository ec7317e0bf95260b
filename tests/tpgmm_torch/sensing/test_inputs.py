"""Measured joints and poses of objects as a running skill hears them, tick by tick."""

import numpy as np
import pytest
import torch

from tpgmm_torch import Frame
from tpgmm_torch.exceptions import ShapeError, UnknownNameError
from tpgmm_torch.robots.joint_space import JointSpace
from tpgmm_torch.sensing.inputs import Inputs
from tpgmm_torch.sensing.pose_filter import OneEuro
from tpgmm_torch.sensing.trust import Trust

DT = 0.02
ROBOT = JointSpace(["a", "b"])
CUP = Frame([0.4, 0.1, 0.2])


def begun(*batch: int, smoothing: OneEuro | None = None) -> Inputs:
    start = torch.zeros(*batch, 2, dtype=torch.float64)
    return Inputs(ROBOT, start, {"cup": CUP.expand(batch)}, Trust(), smoothing)


def test_nothing_told_is_nothing_lost():
    inputs = begun()
    for _ in range(100):
        assert inputs.hear(DT, None, None) is inputs
    assert inputs.untrusted() is None
    assert inputs.measured is None


def test_what_was_told_once_is_expected():
    inputs = begun().hear(DT, torch.zeros(2), {"cup": CUP})
    for k in range(1, 60):
        inputs = inputs.hear(DT, torch.zeros(2), {"cup": None})
        lost = k * DT > Trust().frame_patience + 1e-9
        assert (inputs.untrusted() is not None) == lost
    text = inputs.reasons(inputs.untrusted())[()]
    assert text == "frame 'cup' is missing or not finite, for 1.2 s"
    assert torch.equal(inputs.frames["cup"].position, CUP.position)
    assert inputs.hear(DT, torch.zeros(2), {"cup": CUP}).untrusted() is None


def test_frames_of_the_start_that_are_told_again_are_no_stream():
    inputs = begun()
    frames = dict(inputs.frames)
    for _ in range(3):
        inputs = inputs.hear(DT, None, frames)
    assert not inputs.poses


def test_joints_that_are_not_believed_are_not_measured():
    inputs = begun(3).hear(DT, torch.zeros(3, 2), None)
    heard = torch.tensor([[0.01, 0.0], [torch.nan, 0.0], [2.9, 0.0]], dtype=torch.float64)
    inputs = inputs.hear(DT, heard, None)
    assert torch.equal(inputs.measured[0], heard[0])
    assert inputs.measured[1:].isnan().all()
    for _ in range(20):
        inputs = inputs.hear(DT, heard, None)
    # the third stays where it jumped to, the second has no sensor
    assert inputs.untrusted().tolist() == [False, True, False]
    assert list(inputs.reasons(inputs.untrusted())) == [(1,)]
    assert torch.equal(inputs.measured[2], heard[2])


def test_old_news_is_no_news():
    inputs = begun().hear(DT, torch.zeros(2), None, {"joints": 0.05})
    assert inputs.untrusted() is None
    inputs = inputs.hear(DT, torch.zeros(2), None, {"joints": 0.5})
    assert inputs.reasons(inputs.untrusted())[()] == "joints is 0.5 s old"
    inputs = inputs.hear(DT, torch.zeros(2), None, {"cup": float("nan")})
    assert inputs.untrusted() is not None
    assert inputs.hear(DT, torch.zeros(2), None).untrusted() is None


def test_poses_as_arrays():
    pose = np.array([0.41, 0.1, 0.2, 0.0, 0.0, 0.0, 1.0])
    turned = pose.copy()
    inputs = begun().hear(DT, None, {"cup": Frame(pose[:3])})
    turned[3:] = [-1, 0, 0, 0]  # the same rotation
    inputs = inputs.hear(DT, None, {"cup": turned})
    assert inputs.frames["cup"].position.tolist() == pose[:3].tolist()
    inputs = inputs.hear(DT, None, {"cup": turned * np.nan})
    assert inputs.frames["cup"].position.tolist() == pose[:3].tolist()


def test_poses_are_smoothed():
    rng, inputs = np.random.default_rng(0), begun(smoothing=OneEuro())
    seen = []
    for _ in range(200):
        position = CUP.position.numpy() + 5e-3 * rng.standard_normal(3)
        inputs = inputs.hear(DT, None, {"cup": Frame(position)})
        seen.append(inputs.frames["cup"].position.numpy())
    assert np.std(seen[50:], axis=0).max() < 2e-3


def test_an_array_that_is_written_into_later_does_no_harm():
    heard = torch.zeros(2, dtype=torch.float64)
    inputs = begun().hear(DT, heard, None)
    heard += 5
    assert inputs.measured.tolist() == [0, 0]


@pytest.mark.parametrize("shape", [(3,), (2, 2), (1, 1, 2)])
def test_other_robots_are_refused(shape):
    with pytest.raises(ShapeError, match=r"joints now has shape .*begin it anew"):
        begun().hear(DT, torch.zeros(shape), None)


def test_the_age_of_what_is_not_there():
    with pytest.raises(UnknownNameError, match="'glass'"):
        begun().hear(DT, None, None, {"glass": 0.1})

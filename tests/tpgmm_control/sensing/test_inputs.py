"""Measured joints and poses of objects, tick by tick."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tpgmm_control.sensing.inputs import Inputs
from tpgmm_control.sensing.pose_filter import OneEuro
from tpgmm_control.sensing.trust import Trust
from tpgmm_torch import Frame
from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.robots.kinematics import JointSpace

DT = 0.02
ROBOT = JointSpace(["a", "b"])
CUP = Frame([0.4, 0.1, 0.2])


def begun(*batch: int, smoothing: OneEuro | None = None) -> Inputs:
    start = torch.zeros(*batch, 2, dtype=torch.float64)
    return Inputs(ROBOT, start, {"cup": CUP.expand(batch)}, Trust(), smoothing)


def test_inputs_that_never_came_are_not_lost():
    inputs = begun()
    for _ in range(100):
        assert inputs.update(DT, None, None) is inputs
    assert not inputs.untrusted({})
    assert inputs.measured is None


def test_inputs_that_came_once_are_expected():
    inputs = begun().update(DT, torch.zeros(2), {"cup": CUP})
    for k in range(1, 60):
        inputs = inputs.update(DT, torch.zeros(2), {"cup": None})
        lost = k * DT > Trust().frame_timeout + 1e-9
        assert bool(inputs.untrusted({})) == lost
        assert not inputs.untrusted({"cup": np.asarray(True)})  # a hand that holds it knows
    text = inputs.reasons(inputs.untrusted({}))[()]
    assert text == "frame 'cup' is missing or not finite, for 1.2 s"
    assert torch.equal(inputs.frames["cup"].position, CUP.position)
    assert not inputs.update(DT, torch.zeros(2), {"cup": CUP}).untrusted({})


def test_frames_of_the_start_that_are_given_again_are_no_stream():
    inputs = begun()
    frames = dict(inputs.frames)
    for _ in range(3):
        inputs = inputs.update(DT, None, frames)
    assert not inputs.poses


def test_joints_that_are_not_accepted_are_not_measured():
    inputs = begun(3).update(DT, torch.zeros(3, 2), None)
    seen = torch.tensor([[0.01, 0.0], [torch.nan, 0.0], [0.45, 0.0]], dtype=torch.float64)
    inputs = inputs.update(DT, seen, None)
    assert torch.equal(inputs.measured[0], seen[0])
    assert inputs.measured[1:].isnan().all()
    for _ in range(20):
        seen += 1e-6
        inputs = inputs.update(DT, seen, None)
    # the third stays where it jumped to, the second has no sensor
    assert inputs.untrusted({}).tolist() == [False, True, False]
    assert list(inputs.reasons(inputs.untrusted({}))) == [(1,)]
    assert torch.equal(inputs.measured[2], seen[2])


def test_inputs_that_are_too_old_are_not_trusted():
    inputs = begun().update(DT, torch.zeros(2), None, {"joints": 0.05})
    assert not inputs.untrusted({})
    inputs = inputs.update(DT, torch.zeros(2), None, {"joints": 0.5})
    assert inputs.reasons(inputs.untrusted({}))[()] == "joints is 0.5 s old"
    inputs = inputs.update(DT, torch.zeros(2), None, {"cup": float("nan")})
    assert inputs.untrusted({})
    assert not inputs.update(DT, torch.zeros(2), None).untrusted({})


def test_poses_as_arrays():
    pose = np.array([0.41, 0.1, 0.2, 0.0, 0.0, 0.0, 1.0])
    turned = pose.copy()
    inputs = begun().update(DT, None, {"cup": Frame(pose[:3])})
    turned[3:] = [-1, 0, 0, 0]  # the same rotation
    inputs = inputs.update(DT, None, {"cup": turned})
    assert inputs.frames["cup"].position.tolist() == pose[:3].tolist()
    inputs = inputs.update(DT, None, {"cup": turned * np.nan})
    assert inputs.frames["cup"].position.tolist() == pose[:3].tolist()


def test_poses_are_smoothed():
    rng, inputs = np.random.default_rng(0), begun(smoothing=OneEuro())
    seen = []
    for _ in range(200):
        position = CUP.position.numpy() + 5e-3 * rng.standard_normal(3)
        inputs = inputs.update(DT, None, {"cup": Frame(position)})
        seen.append(inputs.frames["cup"].position.numpy())
    assert np.std(seen[50:], axis=0).max() < 2e-3


def test_an_array_that_is_written_into_later_does_no_harm():
    seen = torch.zeros(2, dtype=torch.float64)
    inputs = begun().update(DT, seen, None)
    seen += 5
    assert inputs.measured.tolist() == [0, 0]


@pytest.mark.parametrize("shape", [(3,), (2, 2), (1, 1, 2)])
def test_other_robots_are_refused(shape):
    with pytest.raises(ShapeError, match=r"joints now has shape .*begin it again"):
        begun().update(DT, torch.zeros(shape), None)


@pytest.mark.parametrize("joints", ["text", {"a": 1}, [[1], [1, 2]], object()])
@pytest.mark.parametrize("frames", [[CUP], {"cup": "text"}, {"cup": [[1], [1, 2]]}])
def test_what_is_no_number_is_lost(joints, frames):
    inputs = begun().update(DT, torch.zeros(2), {"cup": Frame([0.41, 0.1, 0.2])})
    for _ in range(60):
        inputs = inputs.update(DT, joints, frames, {"joints": "text", "glass": 0.1})
    assert inputs.untrusted({})
    assert "joints is missing or not finite" in inputs.reasons(inputs.untrusted({}))[()]


def test_grippers_tell_nothing():
    inputs = replace(begun(), ignored=np.array([False, True]))
    for angle in (0.0, np.nan, 3.0, np.inf):
        inputs = inputs.update(DT, np.array([0.01, angle]), None)
        assert inputs.joints.accepted

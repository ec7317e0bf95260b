"""Frames: poses with any leading shape, of unit norm, mapping points there and back."""

import math

import numpy as np
import pytest
import torch

from tests.support.refusals import refused
from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ShapeError

HALF = math.sqrt(0.5)


def moving_frame(length: int = 5) -> Frame:
    turns = torch.linspace(0, 1, length, dtype=torch.float64)[:, None]
    about_z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return Frame(turns * torch.ones(3, dtype=torch.float64), quaternions.exp(turns * about_z))


def test_a_frame_is_not_rotated_by_default():
    frame = Frame(np.zeros((5, 3)))
    assert frame.batch_shape == (5,)
    assert torch.equal(frame.orientation, quaternions.identity().expand(5, 4))


def test_frames_map_points_there_and_back():
    frame = Frame([1.0, 2.0, 3.0], [HALF, 0.0, 0.0, HALF])
    point = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    expected = torch.tensor([1.0, 3.0, 3.0], dtype=torch.float64)
    torch.testing.assert_close(frame.transform(point), expected)
    torch.testing.assert_close(frame.inverse_transform(expected), point)


def test_frames_select_along_their_leading_dimensions_only():
    frame = moving_frame(5)
    assert frame[2].batch_shape == ()
    assert torch.equal(frame[2].orientation, frame.orientation[2])
    assert torch.equal(frame[..., 2].position, frame.position[2])
    assert frame[1:3].batch_shape == (2,)
    assert frame[torch.tensor([True, False, False, True, False])].batch_shape == (2,)
    assert frame[None].batch_shape == (1, 5)
    refused(lambda: Frame([1.0, 2.0, 3.0])[0], IndexError)


def test_a_frame_has_one_type():
    frame = Frame(torch.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    assert frame.orientation.dtype == torch.float32


def test_rounded_quaternions_are_brought_to_unit_norm():
    given = np.array([0.7071, 0.0, 0.0, 0.7071])
    frame = Frame([0.0, 0.0, 0.0], given)
    torch.testing.assert_close(frame.orientation.norm().item(), 1.0, rtol=0, atol=1e-15)
    assert given.tolist() == [0.7071, 0.0, 0.0, 0.7071]


@pytest.mark.parametrize(("position", "orientation", "message"), [
    (1.0, None, r"position has shape \(\.\.\., 3\), got \(\)"),
    ([1.0, 2.0], None, r"position has shape \(\.\.\., 3\), got \(2,\)"),
    ([0.0] * 3, [1.0, 0.0, 0.0], r"an orientation of shape \(4,\), got \(3,\)"),
    (np.zeros((5, 3)), [1.0, 0, 0, 0], r"orientation of shape \(5, 4\), got \(4,\)"),
])  # fmt: skip
def test_frames_refuse_wrong_shapes(position, orientation, message):
    refused(lambda: Frame(position, orientation), ShapeError, message)


@pytest.mark.parametrize("orientation", [[0.0] * 4, [1.0, 0.1, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]])
def test_frames_refuse_quaternions_that_are_not_of_unit_norm(orientation):
    with pytest.raises(DataError, match=r"unit quaternion \(w, x, y, z\): a norm is off by"):
        Frame([0.0, 0.0, 0.0], orientation)


def test_frames_name_what_is_nan():
    with pytest.raises(DataError, match="the frame's position holds 1 value"):
        Frame([0.0, math.nan, 0.0])
    with pytest.raises(DataError, match="the frame's orientation holds 4 value"):
        Frame([0.0, 0.0, 0.0], [math.nan] * 4)


def test_what_is_of_unit_norm_but_for_rounding_stays_bit_for_bit():
    rng = np.random.default_rng(0)
    for dtype in (torch.float64, torch.float32):
        unit = quaternions.normalize(torch.from_numpy(rng.standard_normal((1000, 4))).to(dtype))
        once = Frame(torch.zeros(1000, 3, dtype=dtype), unit)
        assert torch.equal(once.orientation, unit)
        assert torch.equal(Frame(once.position, once.orientation).orientation, unit)


def test_gradients_of_an_orientation_stay_on_the_unit_sphere():
    given = torch.tensor([0.6, 0.8, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    orientation = Frame(torch.zeros(3, dtype=torch.float64), given).orientation
    (gradient,) = torch.autograd.grad(orientation[0], given)
    assert abs(float(gradient @ given.detach())) < 1e-15

"""General task parameters A, b: maps there and back, and what they refuse."""

import math

import numpy as np
import pytest
import torch

from tests.support.worlds import LEFT, upper_body
from tpgmm_torch import Affine, Demonstration, Frame, RelativePosition, Situation
from tpgmm_torch.exceptions import DataError, ShapeError

RNG = np.random.default_rng(0)
TALL = RNG.standard_normal((4, 5, 2)), RNG.standard_normal((4, 5))


def test_local_coordinates_are_those_of_the_dense_inverse():
    affine = Affine(*TALL)
    local = torch.from_numpy(RNG.standard_normal((4, 2)))
    point = (affine.linear @ local[..., None])[..., 0] + affine.offset
    torch.testing.assert_close(affine.local(point), local)
    elsewhere = torch.from_numpy(RNG.standard_normal((4, 5)))
    expected = [
        np.linalg.lstsq(a, x - b, rcond=None)[0]
        for a, b, x in zip(*TALL, elsewhere.numpy(), strict=True)
    ]
    np.testing.assert_allclose(affine.local(elsewhere), expected, rtol=1e-9, atol=1e-9)


def test_they_are_selected_spread_and_stacked_as_frames_are():
    affine = Affine(*TALL)
    assert affine.batch_shape == (4,)
    assert affine[1].batch_shape == ()
    assert torch.equal(affine[..., 2].linear, affine.linear[2])
    assert affine[0].expand((3, 2)).batch_shape == (3, 2)
    assert affine[0].expand((3, 2)).flatten().batch_shape == (6,)
    assert affine.to(torch.float32).offset.dtype == torch.float32
    stacked = Frame.stack([affine[0], affine])
    assert isinstance(stacked, Affine)
    assert stacked.batch_shape == (4, 2)
    assert torch.equal(stacked.linear[3, 0], affine.linear[0])
    middle = affine.between(torch.tensor([1]), torch.tensor([0.25]))
    torch.testing.assert_close(
        middle.offset[0], affine.offset[1:3].T @ torch.tensor([0.75, 0.25]).double()
    )
    with pytest.raises(DataError, match=r"\['Affine', 'Frame'\]"):
        Frame.stack([affine[0], Frame([0.0, 0.0, 0.0])])
    with pytest.raises(ShapeError, match="A of different shapes"):
        Frame.stack([affine[0], Affine(np.eye(2), np.zeros(2))])


@pytest.mark.parametrize(
    ("linear", "offset", "error", "message"),
    [
        (np.eye(2)[0], np.zeros(2), ShapeError, r"D from 1 to n.*got \(2,\)"),
        (np.ones((2, 3)), np.zeros(2), ShapeError, r"got \(2, 3\)"),
        (np.eye(2), np.zeros(3), ShapeError, r"b has shape \(2,\); got \(3,\)"),
        (np.ones((3, 2)), np.zeros(3), DataError, "rank 1 and 2 columns"),
        ([[math.nan]], [0.0], DataError, "parameter A holds 1 value"),
        ([[1.0]], [math.inf], DataError, "parameter b holds 1 value"),
    ],
)
def test_what_determines_no_local_coordinates_is_refused(linear, offset, error, message):
    with pytest.raises(error, match=message):
        Affine(linear, offset)


def test_whoever_needs_a_pose_says_so():
    affine = Affine(np.eye(3), np.zeros(3))
    demonstration = Demonstration([0.0, 1.0], np.zeros((2, 3)), {"shelf": affine})
    assert demonstration.frame("shelf") is affine
    assert Situation(np.zeros(3), {"shelf": affine}).frames["shelf"] is affine
    for part in ("position", "orientation"):
        with pytest.raises(DataError, match=r"no pose.*TaskParameters takes an Affine"):
            getattr(affine, part)
    state = upper_body().state(torch.zeros(17).double())
    with pytest.raises(DataError, match="TaskParameters"):
        RelativePosition(LEFT, "shelf").coordinates(state, {"shelf": affine})

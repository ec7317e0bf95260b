"""Orientation operators in tangent space: a rotation vector, and a base that is a path."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.support import oracles
from tests.support.operator_battery import OrientationLaws, RelativeLaws, laws_in_places
from tests.support.refusals import refused
from tests.support.worlds import CARRIED, LEFT, OBJECT, RIGHT, CarryingOnRobot, OnPoses, OnRobot
from tpgmm_torch import AbsoluteOrientation, Frame, RelativeOrientation, Stack, quaternions
from tpgmm_torch.exceptions import DataError


def row(at, link, frame=None):
    """``J_l(y)^-1 R_origin^T (J_o - J_of) dq = mu - y``, with the Jacobian's series."""
    poses = {**at.links, **at.frames}
    origin = np.eye(3) if frame is None else oracles.rotation(poses[frame][1])
    turn = origin.T @ oracles.rotation(at.links[link][1])
    y = Rotation.from_matrix(turn).as_rotvec()
    jacobian, power, factorial = np.zeros((3, 3)), np.eye(3), 1.0
    for k in range(60):  # J_l = sum_k [y]x^k / (k + 1)!
        factorial *= k + 1
        jacobian, power = jacobian + power / factorial, power @ oracles.skew(y)
    turning = at.jacobians[link][3:]
    if frame in at.links:
        turning = turning - at.jacobians[frame][3:]
    return oracles.Row(np.linalg.inv(jacobian) @ origin.T @ turning, np.eye(3), -y)


PLACES = {
    "Absolute": ([OnRobot, OnPoses], LEFT),
    "Relative": ([OnRobot, OnPoses], RIGHT, OBJECT),
    "HandToHand": ([OnRobot], RIGHT, LEFT),
    "CarriedToPlace": ([CarryingOnRobot], CARRIED, OBJECT),
}
KINDS = AbsoluteOrientation, RelativeOrientation
globals().update(laws_in_places(KINDS, OrientationLaws, PLACES, (row, row), geometry="tangent"))


class TestInAStackOnRobot(OnRobot, RelativeLaws, OrientationLaws):
    tangent = RelativeOrientation(LEFT, OBJECT, geometry="tangent")
    operator = Stack(RelativeOrientation(RIGHT, OBJECT), tangent)

    def row(self, at):
        other = oracles.relative_orientation(at, RIGHT, OBJECT)
        return oracles.stack(other, row(at, LEFT, OBJECT))


def path(n=7, seed=0):
    """Times, orientations and the rows of a path."""
    rng = np.random.default_rng(seed)
    steps = torch.from_numpy(0.3 * rng.standard_normal((n, 3))).cumsum(0)
    time, q = torch.linspace(1, 3, n, dtype=torch.float64), quaternions.exp(steps)
    return time, q, tuple(map(tuple, torch.cat((time[:, None], q), 1).tolist()))


def test_coordinates_are_of_the_turn_from_the_path():
    time, q, rows = path()
    state, frames = OnRobot().scene(len(time))
    operator = RelativeOrientation(RIGHT, OBJECT, geometry="tangent", path=rows)
    bound = Stack(operator, AbsoluteOrientation(RIGHT)).at(time)
    local = bound.coordinates(state, frames)[:, :3]
    origin = quaternions.product(frames[OBJECT].orientation, q)
    there = quaternions.product(origin, quaternions.exp(local))
    matrices = map(quaternions.to_matrix, (there, state.orientation(RIGHT)))
    torch.testing.assert_close(*matrices, rtol=0, atol=1e-12)
    # a path is the frame's turn: the laws of the operator without one are its own
    turned = {OBJECT: Frame(frames[OBJECT].position, origin)}
    plain = Stack(replace(operator, path=None), AbsoluteOrientation(RIGHT))
    expected, found = plain.linearize(state, turned), bound.linearize(state, frames)
    torch.testing.assert_close(found.jacobian, expected.jacobian)
    torch.testing.assert_close(found.displacement, expected.displacement)


def test_between_its_rows_a_path_turns_evenly_and_beyond_it_stands():
    time, q, rows = path()
    operator = AbsoluteOrientation(LEFT, geometry="tangent", path=rows)
    state = OnRobot().scene()[0]

    def origin(now):
        local = operator.at(torch.tensor(now, dtype=torch.float64)).coordinates(state, {})
        back = quaternions.conjugate(quaternions.exp(local))
        return quaternions.product(state.orientation(LEFT), back)

    for now, expected in (
        (0.0, q[0]),
        (float(time[2]), q[2]),
        (float(time[2:4].mean()), quaternions.slerp(q[2], q[3], 0.5)),
        (9.0, q[-1]),
    ):
        found = quaternions.match_hemisphere(origin(now), expected)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    one = replace(operator, path=rows[3:4])
    local = one.at(time).coordinates(state, {})
    assert local.shape == (7, 3) and torch.equal(local[0], local[-1])


def test_a_path_asks_for_the_time():
    operator = AbsoluteOrientation(LEFT, geometry="tangent", path=path()[2])
    with pytest.raises(DataError, match=r"operator\.at\(time\)"):
        operator.coordinates(OnRobot().scene()[0], {})


@pytest.mark.parametrize(("settings", "message"), [
    ({"geometry": "sphere"}, "'quaternion', 'tangent'"),
    ({"geometry": "tangent", "gain": 1.0}, "gain=1.0"),
    ({"path": ((0.0, 1.0, 0.0, 0.0, 0.0),)}, "geometry='tangent'"),
    ({"geometry": "tangent", "path": ((0.0, 1.0, 0.0),)}, "w, x, y, z"),
    ({"geometry": "tangent", "path": ()}, "w, x, y, z"),
])  # fmt: skip
def test_what_contradicts_itself_is_refused(settings, message):
    refused(lambda: AbsoluteOrientation(LEFT, **settings), DataError, message)

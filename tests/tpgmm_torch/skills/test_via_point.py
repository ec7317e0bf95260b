"""Via-points as they are written, and what is refused."""

import pytest

from tests.support.refusals import refused
from tests.support.skills import small_bottle
from tpgmm_torch import Canonical, Frame, ViaPoints
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.skills.via_point import ViaPoint


@pytest.mark.parametrize("text", [
    "3.2:position:l_hand@bottle=0.0,0.0,0.1",
    "1.5:pose:l_hand=0.3,0.1,0.2,1.0,0.0,0.0,0.0~0.01",
    "0.25:canonical=l_elbow:0.4,r_elbow:-0.1~0.001",
    "2.0:position:r_hand=0.3,0.1,0.2~1.0,1.0,0.0001",
])  # fmt: skip
def test_text_is_read_and_written(text):
    point = ViaPoint.parse(text)
    assert str(point) == text
    assert ViaPoint.parse(str(point)) == point


@pytest.mark.parametrize(
    "text", ["", "3.2", "position:l_hand=0,0,0", "a:canonical=1", "1:canonical=x,y", "1:hand=0"]
)
def test_other_text_is_refused(text):
    refused(lambda: ViaPoint.parse(text), DataError)


def test_a_frame_is_a_pose():
    frame = Frame([0.1, 0.2, 0.3], [0.0, 1.0, 0.0, 0.0])
    point = ViaPoint(1.0, "pose:l_hand", frame)
    assert point.value == (0.1, 0.2, 0.3, 0.0, 1.0, 0.0, 0.0)


def test_some_joints_go_by_name():
    kinematics = small_bottle().kinematics_
    point = ViaPoint(1.0, "canonical", {"r_elbow": 0.1, "l_elbow": 0.4})
    assert point.coordinates(kinematics).tolist() == [0.4, 0.1]  # as the robot has them
    assert point.operator == Canonical(joints=("r_elbow", "l_elbow"))


@pytest.mark.parametrize(("arguments", "error", "message"), [
    ((1.0, "canonical", {"nose": 0.4}), UnknownNameError, "nose"),
    ((1.0, "position:l_hand", [0.1, 0.2]), ShapeError, "2 numbers"),
    ((1.0, "orientation:l_hand", [2.0, 0, 0, 0]), DataError, "norm 2"),
    ((1.0, "position:l_hand", [0, 0, 0], [0.1, 0.1]), ShapeError, "2 tolerances"),
    ((99.0, "position:l_hand", [0, 0, 0]), DataError, "lasts from"),
    ((1.0, "position:nose", [0, 0, 0]), UnknownNameError, "nose"),
])  # fmt: skip
def test_what_does_not_fit_the_model_is_refused(arguments, error, message):
    refused(lambda: ViaPoints(small_bottle().skill, [ViaPoint(*arguments)]), error, message)


@pytest.mark.parametrize("arguments", [
    (1.0, "position:l_hand", {"x": 0.0}),
    (1.0, "position:l_hand", []),
    (float("nan"), "position:l_hand", [0, 0, 0]),
    (1.0, "position:l_hand", [0, 0, 0], -1.0),
    (1.0, None, [0, 0, 0]),
])  # fmt: skip
def test_what_is_none_is_refused(arguments):
    with pytest.raises(DataError):
        ViaPoint(*arguments)

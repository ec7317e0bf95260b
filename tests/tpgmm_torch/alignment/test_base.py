"""Playing demonstrations on another clock, and the contract of all alignments."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp
from sklearn.base import clone

from tests.support.motions import DEMONSTRATIONS
from tests.support.refusals import refused
from tpgmm_torch import quaternions
from tpgmm_torch.alignment import (
    Alignment,
    DynamicTimeWarping,
    EventAlignment,
    LinearTimeNormalization,
)
from tpgmm_torch.alignment.base import retime
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError, NotFittedError, ShapeError, UnknownNameError
from tpgmm_torch.robots.tracked_poses import Poses


@pytest.mark.parametrize("transformer", [DynamicTimeWarping(), LinearTimeNormalization()])
def test_errors_say_what_is_wrong_with_the_input(transformer):
    refused(lambda: clone(transformer).transform(DEMONSTRATIONS), NotFittedError, "call fit")
    for wrong in (DEMONSTRATIONS[0], [], [1], 5):
        refused(
            lambda wrong=wrong: clone(transformer).fit_transform(wrong), DataError, "expected"
        )
    with pytest.raises(DataError, match="one time step"):
        clone(transformer).fit([Demonstration([0.0], [[1.0]])])
    fitted = clone(transformer).fit(DEMONSTRATIONS[:2])
    with pytest.raises(UnknownNameError, match="'a' is not in the demonstration"):
        fitted.transform([Demonstration([0.0, 1.0], np.eye(2), joint_names=("x", "y"))])
    with pytest.raises(ShapeError, match="the robot has 7"):
        clone(transformer).set_params(robot=Poses(["hand"])).fit_transform(
            [Demonstration([0.0, 1.0], np.eye(2))]
        )


def moving(n=5, start=0.0):
    """Uneven steps, two joints, a frame that moves and one that stands, an event a step."""
    time = start + np.cumsum([0.0, *np.linspace(0.1, 0.5, n - 1)])
    joints = np.stack((time**2, np.sin(time)), axis=1)
    turn = quaternions.exp(torch.from_numpy(time)[:, None] * torch.tensor([0.3, 0.5, -0.4]))
    frames = {"moving": Frame(np.outer(time, [1.0, 2.0, 3.0]), turn), "still": Frame([1, 2, 3])}
    events = {f"step {i}": at for i, at in enumerate(time)} | {
        f"after {i}": 0.75 * at + 0.25 * after
        for i, (at, after) in enumerate(itertools.pairwise(time))
    }
    return Demonstration(time, joints, frames, ("a", "b"), events)


def instants(demonstration, steps):
    """The instants of fractional time steps."""
    own = demonstration.time.double().numpy()
    return np.interp(steps, np.arange(len(own)), own)


PATHS = {
    "whole": [0.0, 0.3, 1.7, 2.0, 3.9, 4.0],
    "a part": [0.0, 0.5, 1.0, 1.5, 3.25],
    "from within": [0.5, 2.0, 4.0],
}


@pytest.mark.parametrize("path", PATHS.values(), ids=list(PATHS))
def test_joints_frames_and_events_are_taken_over_along_the_path(path):
    own, time = moving(start=2.0), 10 + np.arange(float(len(path)))
    retimed = retime(own, instants(own, path), torch.from_numpy(time))
    assert torch.equal(retimed.time, torch.from_numpy(time))
    assert retimed.joint_names == ("a", "b")
    steps = np.arange(5.0)
    for actual, given in (
        (retimed.joints, own.joints),
        (retimed.frames["moving"].position, own.frames["moving"].position),
    ):
        expected = [np.interp(path, steps, column) for column in given.numpy().T]
        np.testing.assert_allclose(actual.T, expected, rtol=0, atol=1e-13)
    turns = Rotation.from_quat(own.frames["moving"].orientation.numpy(), scalar_first=True)
    expected = Slerp(steps, turns)(path).as_matrix()
    actual = quaternions.to_matrix(retimed.frames["moving"].orientation)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)
    assert retimed.frames["still"] is own.frames["still"]
    # an event is where its step is on the path; later ones are left out
    where = {f"step {i}": float(i) for i in range(5)} | {
        f"after {i}": i + 0.25 for i in range(4)
    }
    expected = {n: np.interp(s, path, time) for n, s in where.items() if s <= path[-1]}
    assert dict(retimed.events) == pytest.approx(expected, abs=1e-12)


def test_an_event_at_the_end_of_the_path_stays_in_spite_of_rounding():
    own = Demonstration([0.0, 0.1, 0.3], np.eye(3), events={"end": 0.3, "last step": 0.2})
    path = instants(own, [0.0, 1.0, 2.0 - 1e-12])
    retimed = retime(own, path, torch.tensor([0.0, 1.0, 2.0]).double())
    assert dict(retimed.events) == pytest.approx({"end": 2.0, "last step": 1.5})


def test_holds_stay_with_the_motion():
    frames = {"cup": Frame(torch.zeros(3))}
    holds = [Hold("cup", "hand", 1.5, 3.0), Hold("cup", "other", 3.0)]
    own = Demonstration(np.arange(5.0), np.eye(5), frames, holds=holds)
    path, time = np.array([0.0, 1.0, 2.0, 4.0]), torch.tensor([0.0, 2.0, 3.0, 4.0]).double()
    retimed = retime(own, path, time)
    assert retimed.holds == (Hold("cup", "hand", 2.5, 3.5), Hold("cup", "other", 3.5))
    early = retime(own, np.array([0.0, 1.0]), time[:2])  # ends before anything is held
    assert early.holds == ()
    assert retime(replace(own, holds=None), path, time).holds is None


def test_quaternions_among_the_joints_turn_and_keep_unit_norm():
    steps = np.arange(6.0)
    turns = Rotation.from_rotvec(np.outer(steps, [0.3, -0.4, 0.2]))
    signs = np.array([1, -1, -1, 1, -1, 1])[:, None]
    joints = np.column_stack((steps**2, 1.3 * signs * turns.as_quat(scalar_first=True), -steps))
    path = np.array([0.0, 0.5, 2.25, 4.75, 5.0])
    own = Demonstration(steps, joints)
    retimed = retime(own, path, torch.arange(5.0).double(), [[1, 2, 3, 4]])
    turned = retimed.joints[:, 1:5]
    torch.testing.assert_close(turned.norm(dim=1), torch.ones(5).double())
    expected = Slerp(steps, turns)(path).as_matrix()
    np.testing.assert_allclose(quaternions.to_matrix(turned), expected, atol=1e-12)
    np.testing.assert_allclose(retimed.joints[:, 5], -path, atol=1e-13)


class Backwards(Alignment):
    """Two instants, the end of the demonstration and one before it."""

    def __init__(self, robot=None):
        self.robot = robot

    def fit(self, X, y=None):
        self.joint_names_ = X[0].joint_names
        self.time_ = torch.tensor([0.0, 1.0], dtype=torch.float64)
        self.paths_ = [self._path(one) for one in X]
        return self

    def _path(self, demonstration):
        return instants(demonstration, len(demonstration) - np.array([1.5, 1.0]))


def test_an_alignment_of_ones_own_only_finds_paths():
    first, second = moving(5), moving(7)
    alignment = Backwards()
    aligned = alignment.fit_transform([first, second.reorder(["b", "a"])])
    for one, own in zip(aligned, (first, second), strict=True):
        assert one.joint_names == ("a", "b")
        assert torch.equal(one.time, alignment.time_)
        expected = torch.stack((own.joints[-2:].mean(0), own.joints[-1]))
        torch.testing.assert_close(one.joints, expected)
    again = alignment.transform([second.reorder(["b", "a"])])
    assert torch.equal(again[0].joints, aligned[1].joints)
    assert not alignment.__sklearn_tags__().input_tags.two_d_array


def test_situations_pass_unchanged_but_not_among_demonstrations():
    alignment = Backwards().fit([moving()])
    situations = [Situation([0.0, 1.0]), Situation([1.0, 0.0])]
    assert alignment.transform(situations) == situations
    with pytest.raises(DataError, match="item 0 is Situation"):
        alignment.transform([situations[0], moving()])
    refused(lambda: alignment.transform([]), DataError, "empty")
    with pytest.raises(NotFittedError, match=r"this Backwards is not fitted yet: call fit\("):
        Backwards().transform(situations)


@pytest.mark.parametrize(
    "alignment", [DynamicTimeWarping, EventAlignment, LinearTimeNormalization]
)
def test_the_name_of_a_file_is_no_robot(alignment):
    with pytest.raises(DataError, match=r"got 'arm.urdf'; .*Robot.from_urdf\(path, links\)"):
        alignment(robot="arm.urdf").fit(DEMONSTRATIONS)

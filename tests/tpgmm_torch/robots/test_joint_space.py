"""Joints without links."""

import copy

import pytest
import torch

from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.robots.kinematics import JointSpace


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_a_state_has_joints_and_no_link(batch):
    state = JointSpace(["a", "b"]).state(torch.ones(*batch, 2))
    assert torch.equal(state.joints, torch.ones(*batch, 2, dtype=torch.float64))
    assert state.links == ()
    assert state.positions.shape == (*batch, 0, 3)
    assert state.orientations.shape == (*batch, 0, 4)
    assert state.jacobians.shape == (*batch, 0, 6, 2)


def test_nothing_is_limited():
    space = JointSpace(["a", "b"], torch.float32)
    assert space.lower.tolist() == [-torch.inf] * 2
    assert space.upper.tolist() == space.velocity.tolist() == [torch.inf] * 2
    assert space.lower.dtype == space.upper.dtype == space.velocity.dtype == torch.float32
    assert space.state([1.0, 2.0]).joints.dtype == torch.float32


def test_its_names_are_all_of_it():
    space = JointSpace(("a", "b"))
    assert space.joint_names == ("a", "b")
    assert JointSpace.from_config(space.config()) == space == copy.deepcopy(space)
    assert hash(JointSpace.from_config(space.config())) == hash(space)
    assert space != JointSpace(("b", "a"))
    assert space != ("a", "b")
    assert repr(space) == "JointSpace(2 joints)"


def test_other_numbers_of_joints_are_refused():
    with pytest.raises(ShapeError, match=r"\['a', 'b'\], got \(3,\)"):
        JointSpace(("a", "b")).state(torch.zeros(3))

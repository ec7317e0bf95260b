"""Poses in place of a robot: the joint vector is the poses themselves."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.support.refusals import refused
from tpgmm_torch import AbsoluteOrientation, quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.robots.tracked_poses import Poses


def random_joints(poses: Poses, *batch: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    joints = torch.randn(*batch, poses.n_joints, generator=generator, dtype=torch.float64)
    return poses.retract(joints)


def test_joint_names_say_link_and_coordinate() -> None:
    poses = Poses(("hand", "cup"))
    assert poses.joint_names[:7] == tuple(
        f"hand.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")
    )
    assert (poses.n_joints, poses.quaternion_starts) == (14, (3, 10))
    plain = Poses(("hand", "cup"), orientation=False)
    assert plain.joint_names == ("hand.x", "hand.y", "hand.z", "cup.x", "cup.y", "cup.z")
    assert plain.quaternion_starts == ()


@pytest.mark.parametrize("batch", [(), (0,), (2, 3)])
@pytest.mark.parametrize("orientation", [True, False])
def test_the_state_is_the_joint_vector(batch: tuple[int, ...], orientation: bool) -> None:
    poses = Poses(("a", "b", "c"), orientation)
    joints = random_joints(poses, *batch)
    state = poses.state(joints)
    width = 7 if orientation else 3
    for index, link in enumerate(poses.links):
        part = joints[..., width * index : width * (index + 1)]
        unit = part[..., 3:] if orientation else quaternions.identity().expand(*batch, 4)
        torch.testing.assert_close(state.position(link), part[..., :3])
        torch.testing.assert_close(state.orientation(link), unit)
    assert state.jacobians.shape == (*batch, 3, 6, poses.n_joints)
    assert state.orientations.shape == (*batch, 3, 4)


def test_jacobian_gives_velocity_and_angular_velocity() -> None:
    poses = Poses()
    joints, step = random_joints(poses), 1e-6
    ahead, behind = (
        poses.state(poses.retract(joints + sign * step * random_joints(poses, seed=1)))
        for sign in (1, -1)
    )
    change = (ahead.joints - behind.joints) / (2 * step)
    turn = quaternions.product(ahead.orientations, quaternions.conjugate(behind.orientations))
    state = poses.state(joints)
    for index, link in enumerate(poses.links):
        velocity = (ahead.position(link) - behind.position(link)) / (2 * step)
        torch.testing.assert_close(state.linear_jacobian(link) @ change, velocity)
        omega = quaternions.log(turn[index]) / (2 * step)
        torch.testing.assert_close(
            state.angular_jacobian(link) @ change, omega, rtol=1e-6, atol=1e-8
        )


def test_poses_without_orientation_have_none() -> None:
    state = Poses(("hand",), orientation=False).state([0.0, 0.0, 0.0])
    with pytest.raises(DataError, match="'hand' has no orientation"):
        AbsoluteOrientation("hand").linearize(state, {})


def test_retraction_normalises_quaternions_and_nothing_else() -> None:
    poses = Poses()
    joints = random_joints(poses, 5)
    stretched = joints.clone()
    stretched[:, 3:7] *= 1.5
    stretched[:, 10:] *= 0.2
    torch.testing.assert_close(poses.retract(stretched), joints)
    torch.testing.assert_close(
        poses.state(stretched).orientations, poses.state(joints).orientations
    )
    plain = Poses(orientation=False)
    assert plain.retract(stretched[:, :6]).tolist() == stretched[:, :6].tolist()


def test_zero_quaternions_are_refused() -> None:
    poses = Poses(("hand",))
    for act in (poses.state, poses.retract):
        with pytest.raises(DataError, match="quaternion is zero"):
            act(torch.zeros(7, dtype=torch.float64))


def test_wrong_joint_vectors_are_refused() -> None:
    refused(lambda: Poses().state(torch.zeros(13)), ShapeError, r"'left.qw'.*got \(13,\)")
    refused(lambda: Poses().state(torch.full((14,), math.nan)), DataError, "NaN")


@pytest.mark.parametrize("links", ["left", (), ("left", "left")])
def test_wrong_links_are_refused(links: Any) -> None:
    refused(lambda: Poses(links), DataError, "links is a sequence of different names")


def test_made_in_inference_mode_it_serves_gradients() -> None:
    with torch.inference_mode():
        poses = Poses()
    joints = random_joints(poses).requires_grad_()
    poses.state(joints).jacobians.sum().backward()
    assert bool(joints.grad.abs().sum() > 0)


class TestRecordedPoses:
    def test_signs_become_continuous_along_time(self) -> None:
        angles = torch.linspace(0, 6, 50, dtype=torch.float64)
        turns = quaternions.exp(torch.stack((angles, 0 * angles, 0 * angles), dim=-1))
        flips = torch.where(torch.arange(50) % 3 == 0, -1.0, 1.0)[:, None]
        positions = torch.randn(50, 3, dtype=torch.float64)
        recorded = {"cup": Frame(positions, turns * flips), "hand": Frame(positions + 1)}
        joints = Poses.joints(recorded)
        assert joints.shape == (50, 14)
        assert float(joints[:, 3:7].diff(dim=0).norm(dim=-1).max()) < 0.1
        state = Poses(tuple(recorded)).state(joints)
        torch.testing.assert_close(state.position("hand"), positions + 1)
        torch.testing.assert_close(
            quaternions.to_matrix(state.orientation("cup")), quaternions.to_matrix(turns)
        )

    def test_positions_alone_and_single_poses(self) -> None:
        recorded = {"hand": Frame([1.0, 2.0, 3.0])}
        assert Poses.joints(recorded, orientation=False).tolist() == [1, 2, 3]
        assert Poses.joints(recorded).tolist() == [1, 2, 3, 1, 0, 0, 0]

    def test_lengths_must_agree(self) -> None:
        for shapes in ((4, 5), (4, None), ((2, 2), (2, 2)), ()):
            sizes = [(s,) if isinstance(s, int) else s or () for s in shapes]
            recorded = {str(i): Frame(torch.zeros(*size, 3)) for i, size in enumerate(sizes)}
            refused(
                lambda recorded=recorded: Poses.joints(recorded),
                ShapeError,
                "one common leading shape",
            )

"""A robot and operators of a user's own."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tpgmm_torch.operators import Linearization, Operator
from tpgmm_torch.robots import Kinematics, RobotState

Q = torch.tensor([0.3, 0.8, -0.6], dtype=torch.float64)


class PlanarArm(Kinematics):
    """Three hinges about z, links of half a metre."""

    joint_names, links = ("shoulder", "elbow", "wrist"), ("tip",)
    upper = torch.full((3,), torch.pi, dtype=torch.float64)
    lower, velocity = -upper, upper

    def state(self, joints):
        q = self.joint_tensor(joints)
        angles = q.cumsum(-1)
        segments = 0.5 * torch.stack((angles.cos(), angles.sin(), 0 * angles), dim=-1)
        outward = segments.flip(-2).cumsum(-2).flip(-2)  # from each hinge to the tip
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=q.dtype).expand_as(outward)
        twists = torch.cat((torch.linalg.cross(axis, outward), axis), dim=-1)
        half = 0.5 * angles[..., -1:]
        turn = torch.cat((half.cos(), 0 * half, 0 * half, half.sin()), dim=-1)
        positions = segments.sum(-2, keepdim=True)
        orientations, jacobians = turn[..., None, :], twists.mT[..., None, :, :]
        return RobotState(q, self.links, positions, orientations, jacobians)


def planar_jacobian(state: RobotState) -> Tensor:
    return state.linear_jacobian("tip")[..., :2, :]


@dataclass(frozen=True)
class PlanarPosition(Operator):
    """Where the tip is in the plane."""

    def dimension(self, kinematics):
        return 2

    def linearize(self, state, frames):
        return Linearization(planar_jacobian(state), None, -self.coordinates(state, frames))

    def coordinates(self, state, frames):
        return state.position("tip")[..., :2]


@dataclass(frozen=True)
class NullSpace(Operator):
    """``A = I - J^+ J``, ``b = J^+ J q``: the posture, where the tip does not feel it."""

    def dimension(self, kinematics):
        return kinematics.n_joints

    def linearize(self, state, frames):
        jacobian = planar_jacobian(state)
        seen = torch.linalg.pinv(jacobian) @ jacobian
        free = torch.eye(3, dtype=seen.dtype) - seen
        offset = (seen @ state.joints[..., None])[..., 0]
        return Linearization(None, free, offset - state.joints)

    def coordinates(self, state, frames):
        return state.joints


@dataclass(frozen=True)
class NullSpaceRows(NullSpace):
    """The same with an orthonormal basis N of the null space: ``N dq = N mu - N q_prev``.

    It has full row rank, as the information form needs.
    """

    def linearize(self, state, frames):
        across = torch.linalg.cross(*planar_jacobian(state).unbind(-2))
        basis = (across / across.norm(dim=-1, keepdim=True))[..., None, :]
        return Linearization(basis, basis, -(basis @ state.joints[..., None])[..., 0])


@dataclass(frozen=True)
class Constant(Operator):
    """An operator known by its ``A`` and ``b``, Definition 1 of the paper."""

    rows: tuple[tuple[float, ...], ...]
    shift: tuple[float, ...]

    def dimension(self, kinematics):
        return len(self.rows[0])

    def linearize(self, state, frames):
        shift = torch.tensor(self.shift, dtype=state.joints.dtype)
        matrix = torch.tensor(self.rows, dtype=state.joints.dtype)
        return Linearization(None, matrix, shift - state.joints)

    def coordinates(self, state, frames):
        raise NotImplementedError("its local data come from elsewhere")


CONSTANT = Constant(((1.0, 0.5), (0.0, 2.0), (0.0, 0.0)), (0.1, 0.2, 0.3))

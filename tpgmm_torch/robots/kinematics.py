"""Kinematics: where the links are at a joint vector, and how they move with it.

:class:`Kinematics` is what the operators need of a robot and what a user's own robot
derives from. Positions are in metres, joints in radians (or metres, where they slide),
quaternions ``(w, x, y, z)``, Jacobians geometric and in the base frame, linear rows above
angular rows.
"""

from __future__ import annotations

import abc
import copy
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.gaussians import common_shape

__all__ = ["JointSpace", "Kinematics", "RobotState"]

#: The lowest and the highest joints (..., n_joints) allowed [rad or m]; None allows all.
Bounds = tuple[Tensor, Tensor] | None


def parse_dtype(dtype: Any) -> torch.dtype:
    """Parse the ``dtype`` of a robot, also a name, ``"float32"`` or ``"float64"``.

    Raises
    ------
    DataError
        If it is another.
    """
    known = {"float32": torch.float32, "float64": torch.float64}
    name = str(dtype).removeprefix("torch.")
    if name not in known:
        raise DataError(f"a robot's dtype is one of {list(known)}, got {dtype!r}")
    return known[name]


@dataclass(frozen=True, eq=False)
class RobotState:
    """A robot at one joint vector q_{t-1}: having one means that the kinematics have run.

    Parameters
    ----------
    joints : Tensor of shape (..., n_joints)
        The joint vector [rad or m].
    links : tuple of str
        Names of the L links that follow.
    positions : Tensor of shape (..., L, 3)
        Origins of the links in the base frame [m].
    orientations : Tensor of shape (..., L, 4)
        Unit quaternions of the links in the base frame.
    jacobians : Tensor of shape (..., L, 6, n_joints)
        Geometric Jacobians in the base frame: velocity, then angular velocity.
    carriers : tuple of int or Tensor of int of shape (...), default=()
        For each of the last V links, which are objects (:meth:`with_link`), the index of the
        robot's link that carries it, -1 where it is free.
    joint_names : tuple of str, default=()
        Of the joints, for operators that look some of them up by name.
    wrenches : mapping of str to Tensor of shape (..., 6)
        Forces [N] and moments [N m] that links exert, at their origins, in the base frame;
        empty where none were measured.
    """

    joints: Tensor
    links: tuple[str, ...]
    positions: Tensor
    orientations: Tensor
    jacobians: Tensor
    carriers: tuple[int | Tensor, ...] = ()
    joint_names: tuple[str, ...] = ()
    wrenches: Mapping[str, Tensor] = field(default_factory=dict)

    def __repr__(self) -> str:
        kind = type(self).__name__
        return f"{kind}(joints of shape {tuple(self.joints.shape)}, links={self.links})"

    @property
    def robot_links(self) -> tuple[str, ...]:
        """The links of the robot itself, without objects."""
        return self.links[: len(self.links) - len(self.carriers)]

    def position(self, link: str) -> Tensor:
        """Return ``x_{t-1}`` of a link [m], shape (..., 3)."""
        return self.positions[..., self._index(link), :]

    def orientation(self, link: str) -> Tensor:
        """Return ``eps_{t-1}`` of a link, unit quaternion of shape (..., 4)."""
        return self.orientations[..., self._index(link), :]

    def pose(self, link: str) -> Frame:
        """Return position and orientation of a link."""
        return Frame.from_checked(self.position(link), self.orientation(link))

    def jacobian(self, link: str) -> Tensor:
        """Return ``J_p`` above ``J_o`` of a link, shape (..., 6, n_joints)."""
        return self.jacobians[..., self._index(link), :, :]

    def linear_jacobian(self, link: str) -> Tensor:
        """Return ``J_p`` of a link: velocity per joint velocity, shape (..., 3, n_joints)."""
        return self.jacobian(link)[..., :3, :]

    def angular_jacobian(self, link: str) -> Tensor:
        """Return ``J_o`` of a link: angular velocity per joint velocity, (..., 3, n_joints)."""
        return self.jacobian(link)[..., 3:, :]

    def quaternion_columns(self, link: str) -> slice | None:
        """Locate a link's quaternion in the joint vector: nowhere, on a robot."""
        return None

    def carrier(self, link: str) -> int | Tensor:
        """Return the index of the robot's link that a link is, or that carries it; else -1."""
        index = self._index(link)
        n_robot = len(self.links) - len(self.carriers)
        return index if index < n_robot else self.carriers[index - n_robot]

    def displace_link(self, link: str, step: Tensor) -> Self:
        """Move a link elsewhere, with the same orientation and Jacobian.

        Parameters
        ----------
        link : str
            Name of the link that is moved.
        step : Tensor of shape (..., 3)
            From where it is, in the base frame [m].
        """
        one_hot = torch.tensor([[name == link] for name in self.links]).to(self.positions)
        return replace(self, positions=self.positions + one_hot * step.unsqueeze(-2))

    def with_link(
        self, name: str, link: str | None, pose: Frame, where: Tensor | None = None
    ) -> Self:
        """Add an object as a link of its own, which a link of the robot carries.

        With ``r = R_l p`` from the origin of the link to the object, this is at ``x_l + r``
        and moves with ``J_p + J_o x r``, ``J_o``.

        Parameters
        ----------
        name : str
            Of the object. If the state has it already, it is replaced.
        link : str or None
            What carries it, a link or another object; None if it is free, so that the joints
            do not move it.
        pose : Frame
            Its pose in the link, the grasp; in the base frame if it is free.
        where : Tensor of bool, of shape (...), optional
            For which robots that holds; for the others, the object is as the state has it.

        Raises
        ------
        UnknownNameError
            If there is no such link.
        DataError
            If the name is that of a link of the robot, or ``where`` leaves out robots and the
            state does not have the object yet.

        Examples
        --------
        >>> import torch
        >>> joints, turn = torch.zeros(1), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        >>> hinge = torch.tensor([[[0.0], [0.0], [0.0], [0.0], [0.0], [1.0]]])
        >>> state = RobotState(joints, ("hand",), torch.zeros(1, 3), turn, hinge)
        >>> state.with_link("cup", "hand", Frame([0.5, 0, 0])).linear_jacobian("cup").T.tolist()
        [[0.0, 0.5, 0.0]]
        """
        if name in self.robot_links:
            raise DataError(f"{name!r} is a link of the robot: give the object another name")
        pose = pose.to(self.positions)
        jacobian = torch.zeros_like(self.jacobians[..., 0, :, :])
        carrier: int | Tensor = -1
        if link is not None:
            pose = self.pose(link).compose(pose)
            arm = pose.position - self.position(link)
            linear, angular = self.jacobian(link).split(3, -2)
            angular = angular.expand(*arm.shape[:-1], -1, -1)
            swing = torch.linalg.cross(angular, arm[..., None], dim=-2)
            jacobian = torch.cat((linear + swing, angular), dim=-2)
            carrier = self.carrier(link)
        position, orientation = pose.position, pose.orientation
        if where is not None:
            if name not in self.links:
                raise DataError(
                    f"some robots do not hold {name!r}, and the state does not know where it "
                    "is for them: add it as a free object first, with_link(name, None, pose)"
                )
            where = where.to(position.device)
            position = torch.where(where[..., None], position, self.position(name))
            orientation = torch.where(where[..., None], orientation, self.orientation(name))
            jacobian = torch.where(where[..., None, None], jacobian, self.jacobian(name))
            carrier = torch.where(where, carrier, self.carrier(name))
        kept = [i for i, one in enumerate(self.links) if one != name]
        first = len(self.robot_links)
        carriers = *(self.carriers[i - first] for i in kept[first:]), carrier
        batch = common_shape(self.joints.shape[:-1], position.shape[:-1])

        def append_object(links: Tensor, new: Tensor, rank: int) -> Tensor:
            shape = *batch, *new.shape[new.ndim - rank :]
            old = (links.select(-1 - rank, i).expand(shape) for i in kept)
            return torch.stack((*old, new.expand(shape)), -1 - rank)

        return replace(
            self,
            joints=self.joints.expand(*batch, -1),
            links=(*(self.links[i] for i in kept), name),
            positions=append_object(self.positions, position, 1),
            orientations=append_object(self.orientations, orientation, 1),
            jacobians=append_object(self.jacobians, jacobian, 2),
            carriers=tuple(_expand(one, batch) for one in carriers),
        )

    def _map(self, change: Callable[[Tensor, int], Tensor]) -> Self:
        """Change each of the tensors, given the rank behind the batch."""
        return replace(
            self,
            joints=change(self.joints, 1),
            positions=change(self.positions, 2),
            orientations=change(self.orientations, 2),
            jacobians=change(self.jacobians, 3),
            carriers=tuple(
                change(one, 0) if isinstance(one, Tensor) else one for one in self.carriers
            ),
            wrenches={link: change(one, 1) for link, one in self.wrenches.items()},
        )

    def flatten(self, batch: torch.Size) -> Self:
        """Flatten the dimensions of a whole batch into one."""
        last = len(batch) - 1

        def whole(part: Tensor, rank: int) -> Tensor:
            return part.expand(*batch, *part.shape[part.ndim - rank :]).flatten(0, last)

        return self._map(whole)

    def __getitem__(self, index: Any) -> Self:
        """Select along the leading dimensions."""
        return self._map(lambda part, _: part[index])

    def _index(self, link: str) -> int:
        if link not in self.links:
            raise UnknownNameError("link", link, "the state", self.links)
        return self.links.index(link)


def _expand(carrier: int | Tensor, batch: torch.Size) -> int | Tensor:
    return carrier.expand(batch) if isinstance(carrier, Tensor) else carrier


class Kinematics(abc.ABC):
    """Base class of robots: links' poses and Jacobians; derive from it to bring your own.

    A subclass sets the attributes below and defines :meth:`state`, nothing else. It must not
    change afterwards: models share one robot instead of copying it. To be saved with a
    model it needs ``config()``, a dict for JSON, and a classmethod ``from_config(dict)``.

    Attributes
    ----------
    joint_names : tuple of str
        Names of the n coordinates of the joint vector.
    links : tuple of str
        Names of the links in its states.
    lower, upper, velocity : Tensor of shape (n_joints,)
        Limits of position and speed, infinite where unknown. Their dtype and device are
        those of the robot.
    acceleration, jerk : Tensor of shape (n_joints,), optional
        More limits of the same kind.
    without_limits : tuple of str, default=()
        Joints of which limits should be known and are not.
    doubtful : tuple of str, default=()
        Those of them that the robot named in a warning when it was made.
    quaternion_starts : tuple of int, default=()
        Where unit quaternions start in the joint vector; robots have none.
    lengths : tuple of int, default=()
        Which coordinates are lengths [m]; others are angles, or numbers of another kind.
    angles : tuple of int, default=()
        Which coordinates are known to be angles [rad].

    Examples
    --------
    >>> import torch
    >>> class Slider(Kinematics):
    ...     joint_names, links = ("slide",), ("tip",)
    ...     lower, upper, velocity = torch.tensor([[0.0], [1.0], [0.5]], dtype=torch.float64)
    ...
    ...     def state(self, joints):
    ...         q = self.joint_tensor(joints)
    ...         positions = torch.nn.functional.pad(q, (0, 2))[..., None, :]
    ...         orientations = torch.eye(4, dtype=q.dtype)[:1].expand(*q.shape[:-1], 1, 4)
    ...         jacobians = torch.eye(6, 1, dtype=q.dtype).expand(*q.shape[:-1], 1, 6, 1)
    ...         return RobotState(q, self.links, positions, orientations, jacobians)
    >>> Slider().state([0.2]).position("tip").tolist()
    [0.2, 0.0, 0.0]
    """

    joint_names: tuple[str, ...]
    links: tuple[str, ...]
    lower: Tensor
    upper: Tensor
    velocity: Tensor
    acceleration: Tensor | None = None
    jerk: Tensor | None = None
    without_limits: tuple[str, ...] = ()
    doubtful: tuple[str, ...] = ()
    quaternion_starts: tuple[int, ...] = ()
    lengths: tuple[int, ...] = ()
    angles: tuple[int, ...] = ()

    @property
    def n_joints(self) -> int:
        """Number of coordinates of the joint vector."""
        return len(self.joint_names)

    @abc.abstractmethod
    def state(self, joints: Any) -> RobotState:
        """Run the kinematics at ``joints``, array-like of shape (..., n_joints).

        :meth:`joint_tensor` converts and checks them.
        """

    def retract(self, joints: Tensor) -> Tensor:
        """Bring (..., n_joints) back onto the joint manifold after a linear step: identity."""
        return joints

    def joint_tensor(self, joints: Any) -> Tensor:
        """Convert joint vectors to the robot's dtype and device.

        Parameters
        ----------
        joints : array-like of shape (..., n_joints), or mapping of str to array-like
            By name, each of shape (...); joints that the robot does not have are left out, as
            a robot's driver reports wheels, too.

        Raises
        ------
        ShapeError
            If the last dimension is not ``n_joints``, or named joints differ in shape.
        UnknownNameError
            If one of the robot's joints is not among those named.
        DataError
            If a value is not finite.
        """
        if isinstance(joints, Mapping):
            for name in self.joint_names:
                if name not in joints:
                    raise UnknownNameError("joint", name, "the joints given", joints)
            columns = [as_tensor(joints[name], f"joint {name!r}") for name in self.joint_names]
            if len(shapes := {tuple(column.shape) for column in columns}) > 1:
                raise ShapeError(f"joints given by name have one shape, got {sorted(shapes)}")
            joints = torch.stack([column.to(self.lower) for column in columns], -1)
        tensor = as_tensor(joints, "joints").to(self.lower.device, self.lower.dtype)
        if tensor.ndim == 0 or tensor.shape[-1] != self.n_joints:
            raise ShapeError(
                f"joints has shape (..., {self.n_joints}) for the joints "
                f"{list(self.joint_names)}, got {tuple(tensor.shape)}"
            )
        return tensor

    def to(
        self, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Self:
        """Convert to another dtype or device; itself if none changes."""
        other = copy.copy(self)
        for name in {*vars(self), "lower", "upper", "velocity"}:
            value = getattr(self, name)
            if isinstance(value, Tensor):
                wanted = dtype if value.is_floating_point() else None
                setattr(other, name, value.to(device=device, dtype=wanted))
        return other

    def __sklearn_clone__(self) -> Self:
        return self


class Described(Kinematics):
    """Kinematics that a dict for JSON, ``_config``, defines but for their device."""

    _config: dict[str, Any]

    def config(self) -> dict[str, Any]:
        """Return arguments of ``from_config``, ready for JSON."""
        return copy.deepcopy(self._config)

    @classmethod
    def _check_keys(cls, config: Mapping[str, Any], *keys: str) -> None:
        if set(config) != set(keys):
            name = cls.__name__
            raise DataError(
                f"a {name}'s configuration has {sorted(keys)}, got {sorted(config)}"
            )

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and other._config == self._config

    def __hash__(self) -> int:
        return hash((type(self), json.dumps(self._config, sort_keys=True)))


class JointSpace(Described):
    """Joints of those ``joint_names`` and nothing else: enough for :class:`Canonical` alone.

    ``dtype`` and ``device`` are those of its states.
    """

    def __init__(
        self,
        joint_names: Sequence[str],
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        self.joint_names = tuple(joint_names)
        self._config = {"joint_names": list(self.joint_names)}
        self.links = ()
        unbounded = torch.full((len(self.joint_names),), torch.inf, dtype=dtype, device=device)
        self.lower, self.upper, self.velocity = -unbounded, unbounded, unbounded

    def state(self, joints: Any) -> RobotState:
        """Return the state with no link in it; see :meth:`Kinematics.state`."""
        joints = self.joint_tensor(joints)
        shapes = (0, 3), (0, 4), (0, 6, self.n_joints)
        p, o, jacobians = (joints.new_zeros(*joints.shape[:-1], *shape) for shape in shapes)
        return RobotState(joints, (), p, o, jacobians, (), self.joint_names)

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Invert ``config``."""
        return cls(config["joint_names"])

    def __repr__(self) -> str:
        return f"JointSpace({len(self.joint_names)} joints)"

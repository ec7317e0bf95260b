"""What every operator is: one linear map in task space."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass

import torch
from torch import Tensor

from tpgmm_torch import gaussians, quaternions
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.notebook import Tabular
from tpgmm_torch.robots.held_objects import held_objects
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = [
    "Linearization",
    "Operator",
    "Reference",
    "carried_objects",
    "check_pair",
    "frame_names",
]


@dataclass(frozen=True, eq=False)
class Linearization:
    """The displacement that a local Gaussian asks for: ``J (q - q_{t-1}) = M mu + c``.

    Parameters
    ----------
    jacobian : Tensor of shape (..., m, n_joints), optional
        ``J``; None stands for the identity.
    matrix : Tensor of shape (..., m, D), optional
        ``M``; None stands for the identity.
    displacement : Tensor of shape (..., m)
        ``c``.
    present : Tensor of shape (..., D), optional
        The present quaternions where the local coordinates hold some, zero elsewhere; None
        leaves it to :meth:`Operator.coordinates`.
    noise : Tensor of shape (..., m), optional
        A variance that is added to each row's: 1 in rows that say nothing (``0 = 0``), which
        without it would be certain; None stands for zero.
    """

    jacobian: Tensor | None
    matrix: Tensor | None
    displacement: Tensor
    present: Tensor | None = None
    noise: Tensor | None = None

    def silent(self, rigid: bool | Tensor) -> Linearization:
        """The rows as ``0 = 0``, where the joints cannot change what the operator measures.

        Parameters
        ----------
        rigid : bool, or Tensor of bool, of shape (...)
            For which robots.
        """
        if rigid is False:
            return self
        assert self.jacobian is not None and self.matrix is not None
        speaks = ~torch.as_tensor(rigid, device=self.displacement.device)
        displacement = self.displacement * speaks[..., None]
        return Linearization(
            self.jacobian * speaks[..., None, None],
            self.matrix * speaks[..., None, None],
            displacement,
            self.present,
            (~speaks[..., None]).to(displacement.dtype).expand_as(displacement),
        )


@dataclass(frozen=True, eq=False)
class Reference:
    """Pose that operators refer to: a link of the robot, or an object, free or held.

    Parameters
    ----------
    frame : Frame
        Its pose at present.
    linear_jacobian, angular_jacobian : Tensor of shape (..., 3, n_joints), optional
        How the joints move it; None for what they do not move.
    carrier : int, or Tensor of int, of shape (...)
        The index of the robot's link that it is, or that carries it; -1 for what is free.
        What has one carrier is one rigid body: no joint moves the one against the other.
    """

    frame: Frame
    linear_jacobian: Tensor | None = None
    angular_jacobian: Tensor | None = None
    carrier: int | Tensor = -1

    @classmethod
    def of(
        cls, name: str, state: RobotState, frames: Mapping[str, Frame], held: bool = False
    ) -> Reference:
        """Look a name up, first among the links, then among the frames.

        Parameters
        ----------
        name : str
            Of a link of the robot, or of an object.
        state : RobotState
        frames : mapping of str to Frame
            Poses of the objects when they were last free.
        held : bool, default=False
            Whether an object is meant as the thing that a link may carry, rather than as the
            place where it was when it was last free.

        Raises
        ------
        UnknownNameError
            If it is neither.
        """
        if name in (state.links if held else state.robot_links):
            jacobians = state.linear_jacobian(name), state.angular_jacobian(name)
            return cls(state.pose(name), *jacobians, state.carrier(name))
        if name not in frames:
            known = [*frames, *state.links]
            raise UnknownNameError("frame", name, "the situation or the robot's links", known)
        return cls(frames[name])

    @classmethod
    def world(cls, state: RobotState) -> Reference:
        """The base frame, for a ``state``."""
        like = state.positions
        return cls(
            Frame._from(like.new_zeros(3), quaternions.identity(like.dtype, like.device))
        )

    def rigid_with(self, other: Reference) -> bool | Tensor:
        """Whether no joint moves the one against the other, for each robot."""
        return self.carrier == other.carrier


class Operator(Tabular, ABC):
    """A candidate projection operator: a row of the paper's Table I.

    Subclass it for an operator of your own: give :meth:`dimension`, :meth:`linearize` and
    :meth:`coordinates`; make it a frozen dataclass, and ``clone``, ``repr``, ``==``, ``pickle``
    and grid search work. An operator given by its ``A`` and ``b`` (Definition 1 of the
    paper) returns ``Linearization(None, A, b - state.joints)``; where ``A`` is singular it
    needs ``fusion="covariance"``. Where A and b come with the situation, as an
    :class:`Affine`, :class:`TaskParameters` does it.
    """

    @abstractmethod
    def dimension(self, kinematics: Kinematics | None) -> int:
        """D, the number of local coordinates."""

    @abstractmethod
    def linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        """``J``, ``M``, ``c`` at the state q_{t-1}; frames of shapes that broadcast with it."""

    @abstractmethod
    def coordinates(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """The local coordinates X_t of a state, shape (..., D)."""

    def _rows(self) -> dict[str, object]:
        rows: dict[str, object] = {"what": (type(self).__doc__ or "").partition("\n")[0]}
        if is_dataclass(self):
            rows |= {field.name: getattr(self, field.name) for field in fields(self)}
        return rows

    def quaternion_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """Where unit quaternions begin among the local coordinates; none by default."""
        return ()

    def rotation_vector_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """Where rotation vectors [rad] begin among the coordinates; none by default."""
        return ()

    def path_variances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Variances of the path that the coordinates follow, which theirs lack; zero if none.

        What says how far something moves in the skill, has to add them to the coordinates'.
        """
        return (0.0,) * self.dimension(kinematics)

    def at(self, time: Tensor) -> Operator:
        """The operator at ``time`` (...) [s]: itself, unless its coordinates follow a path."""
        return self

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Standard deviations below which agreement in a coordinate means nothing.

        Their squares are added to the diagonal of the local covariances; zero by default.
        """
        return (0.0,) * self.dimension(kinematics)

    def units(self, kinematics: Kinematics | None) -> tuple[str | None, ...]:
        """The unit of each coordinate; None, the default, if it is like no other.

        Few demonstrations say little of a variance: those of one unit are learned together.
        """
        return (None,) * self.dimension(kinematics)

    def links(self) -> tuple[str, ...]:
        """Links of the robot, and objects it may carry, whose pose is needed; default none."""
        return ()

    def references(self) -> tuple[str, ...]:
        """Places that the coordinates refer to, as frames or links; none by default."""
        return ()

    @property
    def determines_joints(self) -> bool:
        """Whether ``J`` has full column rank, so that this operator alone fixes every joint."""
        return False

    def linear(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``A_t = J^+ M`` of Table I, shape (..., n_joints, D)."""
        at = self.linearize(state, frames)
        matrix = at.matrix
        if matrix is None:
            size = at.displacement.shape[-1]
            matrix = torch.eye(size, dtype=state.joints.dtype, device=state.joints.device)
        linear = (
            matrix if at.jacobian is None else gaussians.pseudo_inverse(at.jacobian) @ matrix
        )
        batch = gaussians.common_shape(state.joints.shape[:-1], linear.shape[:-2])
        return linear.expand(*batch, *linear.shape[-2:])

    def offset(self, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
        """``b_t = J^+ c + q_{t-1}`` of Table I, shape (..., n_joints)."""
        at = self.linearize(state, frames)
        if at.jacobian is None:
            return at.displacement + state.joints
        inverse = gaussians.pseudo_inverse(at.jacobian)
        return (inverse @ at.displacement[..., None])[..., 0] + state.joints

    def local(
        self,
        demonstration: Demonstration,
        kinematics: Kinematics,
        holds: Sequence[Hold] = (),
    ) -> Tensor:
        """The local data set X^(j) of a demonstration, (T, D), its quaternions continuous.

        Parameters
        ----------
        demonstration : Demonstration
        kinematics : Kinematics
        holds : sequence of Hold, default=()
            Objects that were held: as places they are where they were last free.
        """
        demonstration = demonstration.reordered(kinematics.joint_names)
        state = kinematics.state(demonstration.joints)
        frames = {name: f.to(state.joints) for name, f in demonstration.frames.items()}
        if holds:
            time = demonstration.time.to(state.joints)
            state, frames = held_objects(state, time, frames, holds)
        at = self.at(demonstration.time.to(state.joints))
        local = at.coordinates(state, frames)
        if tuple(local.shape) != (len(demonstration), self.dimension(kinematics)):
            raise ShapeError(
                f"{self!r} has {self.dimension(kinematics)} coordinates, but its coordinates() "
                f"gave shape {tuple(local.shape)} for {len(demonstration)} time steps"
            )
        for start in self.quaternion_starts(kinematics):
            block = quaternions.continuous(local[:, start : start + 4])
            local = torch.cat((local[:, :start], block, local[:, start + 4 :]), dim=-1)
        return local

    def check(self, kinematics: Kinematics, frames: Collection[str]) -> None:
        """Check that the links and frames that are needed exist.

        Raises
        ------
        UnknownNameError
            If one does not exist, or is both a link and a frame.
        """
        for link in self.links():
            if link not in kinematics.links and link not in frames:
                known = [*kinematics.links, *frames]
                raise UnknownNameError("link", link, "the robot or the frames", known)
        for name in self.references():
            if name not in frames and name not in kinematics.links:
                raise UnknownNameError("frame", name, "the demonstration", frames)
        for name in (*self.links(), *self.references()):
            if name in frames and name in kinematics.links:
                raise UnknownNameError(
                    "frame",
                    name,
                    "the demonstration alone, it is a link of the robot too: rename the frame",
                    frames,
                )


def check_pair(link: str, frame: str, held: object) -> None:
    """Check what a relative operator is told.

    Parameters
    ----------
    link, frame : str
        What is seen, and from where.
    held : object
        Whether the frame is a thing.

    Raises
    ------
    DataError
        If something is seen from itself, or ``held`` is neither True nor False.
    """
    if link == frame:
        raise DataError(f"{link!r} seen from itself never changes: name another frame")
    if not isinstance(held, bool):
        raise DataError(f"held is True or False, got {held!r}")


def frame_names(operators: Sequence[Operator], kinematics: Kinematics) -> tuple[str, ...]:
    """Names of the frames that a situation must have, each once.

    Parameters
    ----------
    operators, kinematics : sequence of Operator, Kinematics
        What refers to frames, and whose links are none.
    """
    references = [name for operator in operators for name in operator.references()]
    names = (*references, *carried_objects(operators, kinematics))
    return tuple(dict.fromkeys(name for name in names if name not in kinematics.links))


def carried_objects(operators: Sequence[Operator], kinematics: Kinematics) -> tuple[str, ...]:
    """Names of the objects that operators refer to as things that the robot may carry.

    Parameters
    ----------
    operators, kinematics : sequence of Operator, Kinematics
        What refers to objects, and whose links are none.
    """
    links = (name for operator in operators for name in operator.links())
    return tuple(dict.fromkeys(name for name in links if name not in kinematics.links))

"""Operators: one linear map in task space each (Table I)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tpgmm_torch import gaussians, quaternions
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.exceptions import ShapeError, UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["Linearization", "Operator"]


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
        A variance that is added to each row's: 1 in rows ``0 = 0``, which without it would be
        certain; None stands for zero.
    """

    jacobian: Tensor | None
    matrix: Tensor | None
    displacement: Tensor
    present: Tensor | None = None
    noise: Tensor | None = None

    def dense(self) -> tuple[Tensor, Tensor]:
        """``J`` and ``M``, identities written out."""
        like = self.displacement
        eye = torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)
        jacobian, matrix = (eye if x is None else x for x in (self.jacobian, self.matrix))
        return jacobian, matrix

    def without(self, rigid: Tensor) -> Linearization:
        """Make rows ``0 = 0`` where the joints cannot change what the operator measures.

        Parameters
        ----------
        rigid : Tensor of bool, of shape (..., m)
        """
        assert self.jacobian is not None and self.matrix is not None
        active = ~rigid
        return replace(
            self,
            jacobian=self.jacobian * active[..., None],
            matrix=self.matrix * active[..., None],
            displacement=self.displacement * active,
            noise=rigid.to(self.displacement.dtype).expand_as(self.displacement),
        )


class Operator(ABC):
    """A candidate projection operator: a row of the paper's Table I.

    Subclass it for an operator of your own: give :meth:`dimension`, :meth:`linearize` and
    :meth:`coordinates`; make it a frozen dataclass, and ``clone``, ``repr``, ``==``, ``pickle``
    and grid search work. An operator given by its ``A`` and ``b`` (Definition 1 of the
    paper) returns ``Linearization(None, A, b - state.joints)``; where ``A`` is singular it
    needs the covariance form of the fusion.
    """

    @abstractmethod
    def dimension(self, kinematics: Kinematics | None) -> int:
        """Count the local coordinates, D."""

    @abstractmethod
    def linearize(self, state: RobotState, frames: Frames) -> Linearization:
        """Compute ``J``, ``M``, ``c`` at the state q_{t-1}; frames broadcast with it."""

    @abstractmethod
    def coordinates(self, state: RobotState, frames: Frames) -> Tensor:
        """Compute the local coordinates X_t of a state, shape (..., D)."""

    def quaternion_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """List where unit quaternions begin among the local coordinates; none by default."""
        return ()

    def rotation_vector_starts(self, kinematics: Kinematics | None) -> tuple[int, ...]:
        """List where rotation vectors [rad] begin among the coordinates; none by default."""
        return ()

    def path_variances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Variances of the mean path that the coordinates deviate from; zero by default.

        How far something moves in the skill is their variance and that of the path.
        """
        return (0.0,) * self.dimension(kinematics)

    def at(self, time: Tensor) -> Operator:
        """Bind it to ``time`` (...) [s]: itself, unless its coordinates follow a path."""
        return self

    def tolerances(self, kinematics: Kinematics | None) -> tuple[float, ...]:
        """Standard deviations below which agreement in a coordinate means nothing.

        Their squares are added to the diagonal of the local covariances; zero by default.
        """
        return (0.0,) * self.dimension(kinematics)

    def units(self, kinematics: Kinematics | None) -> tuple[str | None, ...]:
        """Return the unit of each coordinate; None, the default, if it is like no other.

        Variances of one unit are learned together from few demonstrations.
        """
        return (None,) * self.dimension(kinematics)

    def links(self) -> tuple[str, ...]:
        """Links of the robot, and objects it may carry, whose pose is needed; default none."""
        return ()

    def references(self) -> tuple[str, ...]:
        """Places that the coordinates refer to, as frames or links; none by default."""
        return ()

    @property
    def leaves(self) -> tuple[Operator, ...]:
        """The operator itself; of a stack, its members."""
        return (self,)

    def text(self) -> str | None:
        """Write it as a term of :mod:`tpgmm_torch.operators.text`; by default there is none."""
        return None

    @property
    def is_posture(self) -> bool:
        """True if its coordinates are joints themselves; not by default."""
        return False

    @property
    def constrains_joints(self) -> bool:
        """True if it has rows in joint space; those of forces have none."""
        return True

    @property
    def determines_joints(self) -> bool:
        """True if ``J`` has full column rank, so that this operator alone fixes every joint."""
        return False

    def linear(self, state: RobotState, frames: Frames) -> Tensor:
        """``A_t = J^+ M`` of Table I, shape (..., n_joints, D)."""
        at = self.linearize(state, frames)
        _, linear = at.dense()
        if at.jacobian is not None:
            linear = gaussians.pseudo_inverse(at.jacobian) @ linear
        batch = gaussians.common_shape(state.joints.shape[:-1], linear.shape[:-2])
        return linear.expand(*batch, *linear.shape[-2:])

    def offset(self, state: RobotState, frames: Frames) -> Tensor:
        """``b_t = J^+ c + q_{t-1}`` of Table I, shape (..., n_joints)."""
        at = self.linearize(state, frames)
        if at.jacobian is None:
            return at.displacement + state.joints
        inverse = gaussians.pseudo_inverse(at.jacobian)
        return (inverse @ at.displacement[..., None])[..., 0] + state.joints

    def along(
        self, time: Tensor, state: RobotState, frames: Frames, kinematics: Kinematics
    ) -> Tensor:
        """Local coordinates (T, D) of the states of a motion, its quaternions continuous.

        Parameters
        ----------
        time : Tensor of shape (T,)
        state : RobotState
            Of batch shape (T,).
        frames : mapping of str to Frame
        kinematics : Kinematics

        Raises
        ------
        ShapeError
            If ``coordinates`` gave another shape.
        """
        local, size = self.at(time).coordinates(state, frames), self.dimension(kinematics)
        if local.shape != (len(time), size):
            raise ShapeError(
                f"{self!r} has {size} coordinates, but its coordinates() gave shape "
                f"{tuple(local.shape)} for {len(time)} time steps"
            )
        starts = self.quaternion_starts(kinematics)
        return quaternions.continuous(local, starts=starts) if starts else local

    def check(self, kinematics: Kinematics, frames: Collection[str]) -> None:
        """Check that the links and frames that are needed exist.

        Raises
        ------
        UnknownNameError
            If one does not exist, or is both a link and a frame.
        """
        known = [*kinematics.links, *frames]
        for link in self.links():
            if link not in known:
                raise UnknownNameError("link", link, "the robot or the frames", known)
        for name in self.references():
            if name not in known:
                raise UnknownNameError("frame", name, "the demonstration", frames)
        for name in {*self.links(), *self.references()} & {*frames} & {*kinematics.links}:
            where = "the demonstration alone, it is a link of the robot too: rename the frame"
            raise UnknownNameError("frame", name, where, frames)


def of_joints(operators: Sequence[Operator]) -> tuple[Operator, ...]:
    """Select the ``operators`` that have rows in joint space: the first ones."""
    return tuple(operator for operator in operators if operator.constrains_joints)


def leaves(operators: Iterable[Operator]) -> tuple[Operator, ...]:
    """List the members of stacks, and other operators, of some ``operators`` in their order."""
    return tuple(leaf for operator in operators for leaf in operator.leaves)


def frame_names(operators: Sequence[Operator], kinematics: Kinematics) -> tuple[str, ...]:
    """List the frames that a situation must have, each once.

    Parameters
    ----------
    operators : sequence of Operator
    kinematics : Kinematics
        Its links are no frames.
    """
    references = [name for operator in operators for name in operator.references()]
    names = (*references, *carried_objects(operators, kinematics))
    return tuple(dict.fromkeys(name for name in names if name not in kinematics.links))


def carried_objects(operators: Sequence[Operator], kinematics: Kinematics) -> tuple[str, ...]:
    """List the objects that operators refer to as things that the robot may carry.

    Parameters
    ----------
    operators : sequence of Operator
    kinematics : Kinematics
        Its links are no objects.
    """
    links = (name for operator in operators for name in operator.links())
    return tuple(dict.fromkeys(name for name in links if name not in kinematics.links))

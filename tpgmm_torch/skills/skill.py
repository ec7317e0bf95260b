"""The protocol of a skill: what controllers, clocks and rollouts run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.posture import PostureSearch
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["CompositeSkill", "Observation", "Skill"]


@dataclass(frozen=True, eq=False)
class Observation:
    """Measurements of a batch of robots at one tick.

    Parameters
    ----------
    joints : Tensor of shape (..., n_joints), optional
        Measured joints [rad or m]; None if nothing was measured. NaN stands for a coordinate
        without a sensor.
    reference : Tensor of shape (..., n_joints)
        The last reference [rad or m].
    velocity : Tensor of shape (..., n_joints), optional
        Of the reference [rad/s or m/s].
    frames : mapping of str to Frame
        Present poses of the objects; of a held one, its pose when it was last free.
    estimate : Estimate, optional
        What the reference was made from.
    attach : callable, optional
        Adds the objects that robots hold to their state: :meth:`Holding.state`.
    pushed : Tensor of bool of shape (...), optional
        Robots that were displaced, faster than their references moved.
    """

    joints: Tensor | None
    reference: Tensor
    velocity: Tensor | None
    frames: Mapping[str, Frame]
    estimate: Estimate | None = None
    attach: Callable[[RobotState], RobotState] | None = None
    pushed: Tensor | None = None


class Skill(Protocol):
    """A motion that can be run: Gaussian estimates of the joints over time.

    A fitted mixture conditioned on time (:class:`Regression`) is a skill. So are wrappers that
    hold other skills and condition, chain or choose between their estimates. Skills are
    immutable; whatever one remembers from tick to tick is in the skill that :meth:`advance`
    returns. Those who subclass this protocol inherit what is not abstract.
    """

    @property
    def kinematics(self) -> Kinematics:
        """The robot."""
        ...

    @property
    def begin(self) -> float:
        """Start of the skill [s]."""
        ...

    @property
    def end(self) -> float:
        """End of the skill [s]."""
        ...

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Frames that :meth:`estimate` needs."""
        ...

    @property
    def carried_names(self) -> tuple[str, ...]:
        """Those frames that move with a link of the robot while it holds them."""
        return ()

    @property
    def holds(self) -> tuple[Hold, ...]:
        """Intervals in which a link holds an object."""
        return ()

    @property
    def motion_bounds(self) -> MotionBounds | None:
        """Bounds of position, speed, acceleration and jerk; None if there are none."""
        return None

    @property
    def time(self) -> Tensor:
        """Time grid of references (T,) [s]."""
        ...

    @property
    def peaks(self) -> tuple[Tensor, Tensor] | None:
        """Largest accelerations and jerks (n_joints,) of the demonstrations, or None."""
        return None

    @property
    def summary(self) -> TrainingSummary | None:
        """Distance of a situation from the demonstrations; None if that is not known."""
        return None

    def estimate(
        self,
        time: Tensor,
        state: Tensor | RobotState,
        frames: Mapping[str, Frame],
        bounds: tuple[Tensor, Tensor] | None = None,
    ) -> Estimate:
        """Gaussian of the joints at a time, given the state q_{t-1} and the objects' poses.

        Parameters
        ----------
        time : Tensor of shape () or (...)
            In the skill, for all robots or of each one [s].
        state : Tensor of shape (..., n_joints), or RobotState
            Joints [rad or m], or the state with the objects that robots hold.
        frames : mapping of str to Frame
            Of shapes that broadcast with the batch.
        bounds : tuple of two Tensor of shape (..., n_joints), optional
            The lowest and the highest joints allowed [rad or m].

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If frames are missing or do not fit the robots, or there is no finite estimate.
        """
        ...

    def log_likelihood(
        self,
        times: Tensor,
        state: RobotState,
        frames: Mapping[str, Frame],
        window: slice = slice(None),
    ) -> Tensor:
        """Log-density of observed robots at each time, up to a constant of each robot.

        Parameters
        ----------
        times : Tensor of shape (G,)
            An ascending grid from the beginning of the skill to its end [s].
        state : RobotState
            Of B robots, or of one without a batch.
        frames : mapping of str to Frame
            Of shapes () or (B,).
        window : slice, optional
            The part of the grid that is asked for.

        Returns
        -------
        Tensor of shape (B, G)
            Of the times in the window; zeros for robots with an observation that is not finite.
        """
        ...

    def observed(self, names: frozenset[str]) -> Skill | None:
        """The skill of those operators whose frames and links are observed.

        Parameters
        ----------
        names : frozenset of str
            The frames and links that are observed.

        Returns
        -------
        Skill or None
            None if no operator is left.
        """
        return self

    def posture_search(self) -> PostureSearch | None:
        """Search for the nearest posture where an estimate cannot be followed, or None."""
        return None

    def start(self, joints: Tensor, frames: Mapping[str, Frame]) -> Skill:
        """The skill for robots that begin with these postures and objects.

        Parameters
        ----------
        joints : Tensor of shape (..., n_joints)
        frames : mapping of str to Frame
        """
        return self

    def of_robots(self, robots: Tensor) -> Skill:
        """The skill for some robots of the batch.

        Parameters
        ----------
        robots : Tensor of bool of the batch shape
        """
        return self

    def advance(self, estimate: Estimate) -> Skill:
        """The skill for the next tick, with what it remembers of its last estimate.

        Parameters
        ----------
        estimate : Estimate
            What :meth:`estimate` returned at this tick.
        """
        return self


class CompositeSkill(Skill):
    """A skill made of several others of one robot.

    Attributes
    ----------
    skills : tuple of Skill
    """

    skills: tuple[Any, ...]

    @property
    def kinematics(self) -> Kinematics:
        """See :attr:`Skill.kinematics`."""
        kinematics: Kinematics = self.skills[0].kinematics
        return kinematics

    @property
    def begin(self) -> float:
        """See :attr:`Skill.begin`."""
        begin: float = self.skills[0].begin
        return begin

    @property
    def frame_names(self) -> tuple[str, ...]:
        """See :attr:`Skill.frame_names`."""
        return tuple(dict.fromkeys(name for one in self.skills for name in one.frame_names))

    @property
    def carried_names(self) -> tuple[str, ...]:
        """See :attr:`Skill.carried_names`."""
        return tuple(dict.fromkeys(name for one in self.skills for name in one.carried_names))

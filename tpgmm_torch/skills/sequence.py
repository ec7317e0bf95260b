"""One skill after the other, each with operators and components of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import pairwise

import torch
from torch import Tensor

from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.skills.skill import CompositeSkill, Skill

__all__ = ["Sequence"]


@dataclass(frozen=True, eq=False)
class Sequence(CompositeSkill):
    """Skills one after the other, mixed where one ends and the next begins.

    Parameters
    ----------
    skills : sequence of Skill
        Of one robot, each beginning where the one before ends [s].
    fade : float, default=0.2
        Seconds around a seam in which the estimates of both neighbours are mixed, by a
        minimum-jerk share.

    Raises
    ------
    DataError
        If there is none, they are of different robots, or leave gaps.
    """

    skills: tuple[Skill, ...]
    fade: float = 0.2

    def __post_init__(self) -> None:
        object.__setattr__(self, "skills", tuple(self.skills))
        if not self.skills or not self.fade > 0:
            raise DataError(f"a sequence has skills and a positive fade, got {self!r}")
        for one, other in pairwise(self.skills):
            if one.kinematics.joint_names != other.kinematics.joint_names:
                raise DataError("the skills of a sequence are of different robots")
            if abs(one.end - other.begin) > self.fade:
                raise DataError(
                    f"a skill that begins at {other.begin:.4g} s cannot follow one that ends "
                    f"at {one.end:.4g} s: each begins where the one before ends"
                )

    @property
    def end(self) -> float:
        """See :attr:`Skill.end`."""
        return self.skills[-1].end

    @cached_property
    def time(self) -> Tensor:
        """See :attr:`Skill.time`."""
        return torch.cat([one.time for one in self.skills]).unique()

    @property
    def holds(self) -> tuple[Hold, ...]:
        """See :attr:`Skill.holds`."""
        every = dict.fromkeys(hold for one in self.skills for hold in one.holds)
        return tuple(sorted(every, key=lambda hold: (hold.begin, hold.end)))

    @cached_property
    def peaks(self) -> tuple[Tensor, Tensor] | None:
        """The largest accelerations and jerks of any of the demonstrations."""
        known = [one.peaks for one in self.skills if one.peaks is not None]
        if not known:
            return None
        acceleration, jerk = (reduce(torch.maximum, each) for each in zip(*known, strict=True))
        return acceleration, jerk

    @cached_property
    def motion_bounds(self) -> MotionBounds | None:
        """See :attr:`Skill.motion_bounds`."""
        if all(one.motion_bounds is None for one in self.skills):
            return None
        return MotionBounds.of(self)

    @property
    def summary(self) -> TrainingSummary | None:
        """Of the first skill, with those objects that only later ones know."""
        first = self.skills[0].summary
        if first is None:
            return None
        frames = [one.summary.frames for one in self.skills[1:] if one.summary is not None]
        later = {
            name: replace(frame, link=None)  # where a link is at the start of that skill
            for own in reversed(frames)
            for name, frame in own.items()
        }
        return replace(first, frames=later | {**first.frames})

    def shares(self, time: Tensor) -> Tensor:
        """Shares (..., n_skills) of the skills at times (...); their sum is 1."""
        seams = time.new_tensor([one.end for one in self.skills[:-1]])
        passed = minimum_jerk((time.unsqueeze(-1) - seams) / self.fade + 0.5)
        one = passed.new_ones(*passed.shape[:-1], 1)
        return torch.cat((one, passed), -1) - torch.cat((passed, 0 * one), -1)

    def skill_at(self, time: float) -> Skill:
        """The skill that has the largest share at a time [s]."""
        return self.skills[int(self.shares(self.time.new_tensor(time)).argmax())]

    def observed(self, names: frozenset[str]) -> Skill | None:
        """See :meth:`Skill.observed`."""
        several = [one.observed(names) for one in self.skills]
        known = tuple(one for one in several if one is not None)
        return self.with_skills(known) if len(known) == len(several) else None

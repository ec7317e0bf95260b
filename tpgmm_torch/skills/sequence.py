"""One skill after the other, each with operators and components of its own."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import accumulate, pairwise
from pathlib import PurePath
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.skills.gate import CONDITIONS, CONTACT, SWITCH, Condition, Gate
from tpgmm_torch.skills.skill import CompositeSkill, Skill

__all__ = ["Sequence"]

#: Default of ``fade``: between parts of one demonstration, and between separate skills [s].
PARTS_FADE, SKILLS_FADE = 0.2, 1.0
PART = re.compile(r"(\S+)(?:\s+until\s+(\S+))?(?:\s+retry\s+(\d+)(?:\s+from\s+(\S+))?)?")


@dataclass(frozen=True, eq=False)
class Sequence(CompositeSkill):
    """Skills one after the other, mixed where one ends and the next begins.

    A skill that begins where the one before ends shares its clock, as parts of one
    demonstration do. Any other was learned separately: it begins ``fade`` seconds after the
    end of the one before, in which the robot goes to its beginning, with the objects where
    they are at that end.

    Parameters
    ----------
    skills : sequence of Skill
        Of one robot.
    fade : float, default=0.0
        Seconds around a seam of parts in which the estimates of both are mixed, by a
        minimum-jerk share, and between separate skills; 0 stands for 0.2, and for 1.0 if there
        are separate ones.
    until : str, callable, or sequence, default=()
        What has to be the case at the end of each skill for the next one to begin; one for
        all, or one of each: None, a condition, or several (in text joined by ``+``).
        ``"arrived"``: the joints are where the reference is, at rest; ``"held"``: each object
        that the skill ends holding has moved along with its hand; ``"free"``: each object that
        it let go has not; ``"contact:LINK"``; or a function of a
        :class:`~tpgmm_control.loop.gates.Moment` that gives a bool, or one of each robot.
    retry : int or sequence, default=0
        How often it is tried again if that is not the case in time, one number for all skills,
        or one of each; a pair ``(number, skill)`` says from the beginning of which skill, by
        name or index, by default the one that failed. Then the robot holds.
    timeout : float, default=2.0
        How long each is waited for [s].
    names : sequence of str, default=()
        Of the skills; by default their numbers.

    Raises
    ------
    DataError, UnknownNameError
        If there is no skill, they are of different robots, or conditions do not fit them.

    Examples
    --------
    >>> Sequence([pick, place], until=["held", "arrived"], retry=[2, 0])  # doctest: +SKIP
    """

    skills: tuple[Skill, ...]
    fade: float = 0.0
    until: tuple[tuple[Any, ...], ...] = ()
    retry: tuple[tuple[int, int], ...] = ()
    timeout: float = 2.0
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        skills, count, names = tuple(self.skills), len(self.skills), self._checked_names()
        parts = _are_parts(skills, self.fade or PARTS_FADE)
        untils = _of_each("until", self.until or None, count)
        retries = _of_each("retry", self.retry or 0, count)
        vars(self).update(
            skills=skills,
            names=names,
            fade=self.fade or (PARTS_FADE if parts else SKILLS_FADE),
            until=tuple(map(_conditions, skills, untils)),
            retry=tuple(_retry(names, *each) for each in enumerate(retries)),
        )

    def _checked_names(self) -> tuple[str, ...]:
        """Names of the skills, of which there is at least one; all settings are numbers."""
        count = len(self.skills)
        if not count or not 0 < self.timeout < math.inf or not 0 <= self.fade < math.inf:
            raise DataError(f"a sequence has skills, a positive fade and timeout, got {self!r}")
        names = tuple(self.names) or tuple(map(str, range(count)))
        if len(set(names)) < count or len(names) > count:
            raise DataError(f"{count} skills need a name each, got {list(names)}")
        return names

    @classmethod
    def parse(
        cls, text: str, skills: Mapping[str, Skill] | Callable[[str], Skill], **options: Any
    ) -> Self:
        """Return a sequence from one line of text.

        Parameters
        ----------
        text : str
            Skills, separated by commas, each ``NAME [until CONDITION[+CONDITION]] [retry NUMBER
            [from NAME]]``.
        skills : mapping of str to Skill, or callable
            What the names stand for. Of a path the last part is the name.
        **options
            ``fade`` and ``timeout``.

        Raises
        ------
        DataError, UnknownNameError
            If a part is not of this form, a name is not known, or as of the sequence.
        """
        found, untils, retries, names = [], [], [], []
        for number, part in enumerate(text.split(",")):
            match = PART.fullmatch(part.strip())
            if match is None:
                raise DataError(
                    f"{part.strip()!r} in {text!r} is not of the form NAME [until CONDITION] "
                    "[retry NUMBER [from NAME]]"
                )
            name, until, times, back = match.groups()
            if isinstance(skills, Mapping) and name not in skills:
                raise UnknownNameError("skill", name, "the sequence", skills)
            found.append(skills[name] if isinstance(skills, Mapping) else skills(name))
            names.append(PurePath(name).name)
            untils.append(until)
            retries.append((int(times or 0), back or number))
        several: Any = {"until": untils, "retry": retries, "names": names}
        return cls(tuple(found), **several, **options)

    @cached_property
    def _separate(self) -> tuple[bool, ...]:
        """Those of the skills but the first that do not share the clock of the one before."""
        pairs = pairwise(self.skills)
        return tuple(not _shares_clock(one, other, self.fade) for one, other in pairs)

    @cached_property
    def _shifts(self) -> tuple[float, ...]:
        """Seconds added to the time of each skill."""
        pairs = zip(self._separate, pairwise(self.skills), strict=True)
        gaps = (own * (one.end + self.fade - other.begin) for own, (one, other) in pairs)
        return tuple(accumulate(gaps, initial=0.0))

    @cached_property
    def _stretches(self) -> tuple[tuple[float, float], ...]:
        """When each skill is alone [s]."""
        edges = [self.begin]
        for one, by, separate in zip(self.skills, self._shifts, self._separate, strict=False):
            stop = one.end + by - (0.0 if separate else self.fade / 2)
            edges += [stop, stop + self.fade]
        return tuple(zip(edges[::2], [*edges[1::2], self.end], strict=True))

    @property
    def end(self) -> float:
        """See :attr:`Skill.end`."""
        return self.skills[-1].end + self._shifts[-1]

    @cached_property
    def time(self) -> Tensor:
        """See :attr:`Skill.time`."""
        grids = [one.time + by for one, by in zip(self.skills, self._shifts, strict=True)]
        seams = zip(self.skills, self._separate, self._stretches, strict=False)
        for one, separate, (_, stop) in seams:
            if separate:
                step = (one.end - one.begin) / max(len(one.time) - 1, 1)
                count = max(round(self.fade / step), 1) + 1
                grids.append(torch.linspace(stop, stop + self.fade, count)[1:-1].to(one.time))
        return torch.cat(grids).unique()

    def time_of(self, index: int, time: Tensor) -> Tensor:
        """Return a time of the sequence, on the clock of one of its skills."""
        one, by = self.skills[index], self._shifts[index]
        before, after = (False, *self._separate, False)[index : index + 2]
        if not (before or after):
            return time - by
        return (time - by).clamp(one.begin if before else None, one.end if after else None)

    @cached_property
    def holds(self) -> tuple[Hold, ...]:
        """See :attr:`Skill.holds`; what a skill ends holding is held until another lets go."""
        if not any(self._separate):
            every = dict.fromkeys(hold for one in self.skills for hold in one.holds)
            return tuple(sorted(every, key=lambda hold: (hold.begin, hold.end)))
        found: list[Hold] = []
        spans = zip(self.skills, self._shifts, self._stretches, strict=True)
        for one, by, (begin, stop) in spans:
            for hold in sorted(one.holds, key=lambda hold: hold.begin):
                late = hold.end + by
                late = late if late < stop else math.inf
                if late > (early := max(hold.begin + by, begin)):
                    found = _held_on(found, replace(hold, begin=early, end=late))
        return tuple(sorted(found, key=lambda hold: hold.begin))

    @cached_property
    def gates(self) -> tuple[Gate, ...]:
        """See :attr:`Skill.gates`: ends of skills at which something is waited for."""
        gates, separate = list[Gate](), (*self._separate, False)
        for k, (one, by, until) in enumerate(
            zip(self.skills, self._shifts, self.until, strict=True)
        ):
            gates += [replace(g, time=g.time + by, back=g.back + by) for g in one.gates]
            times, back = self.retry[k]
            if until or separate[k]:
                holds = tuple(pair for pair in _ends(one) if pair[0] in until)
                times_of = self._stretches[k][1], until, self.timeout, times
                begin, fade = self._stretches[back][0], separate[k] * self.fade
                gates.append(Gate(*times_of, begin, fade, holds, self.names[k]))
        return tuple(gates)

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
        """Summary of the first skill, with those objects that only later ones know."""
        first = self.skills[0].summary
        if first is None:
            return None
        later = {
            name: replace(frame, link=None)  # where a link is at the start of that skill
            for one in reversed(self.skills[1:])
            for name, frame in (one.summary.frames if one.summary else {}).items()
        }
        return replace(first, frames=later | {**first.frames})

    def shares(self, time: Tensor) -> Tensor:
        """Shares (..., n_skills) of the skills at times (...); their sum is 1."""
        seams = zip(self.skills, self._shifts, self._separate, strict=False)
        # separate skills begin at once, and the difference fades as it is then
        widths = [self.fade * (SWITCH if own else 1.0) for own in self._separate]
        middles = [
            one.end + by + own * width / 2
            for (one, by, own), width in zip(seams, widths, strict=True)
        ]
        passed = (time.unsqueeze(-1) - time.new_tensor(middles)) / time.new_tensor(widths)
        passed = minimum_jerk(passed + 0.5)
        one = passed.new_ones(*passed.shape[:-1], 1)
        return torch.cat((one, passed), -1) - torch.cat((passed, 0 * one), -1)

    def restrict_to(self, names: frozenset[str]) -> Skill | None:
        """See :meth:`Skill.restrict_to`."""
        several = [one.restrict_to(names) for one in self.skills]
        known = tuple(one for one in several if one is not None)
        return self.with_skills(known) if len(known) == len(several) else None


def _shares_clock(one: Skill, other: Skill, fade: float) -> bool:
    """Check that a skill begins where the other ends, and not where that begins."""
    return abs(other.begin - one.end) <= min(fade, (one.end - one.begin) / 2)


def _ends(skill: Skill) -> tuple[tuple[str, Hold], ...]:
    """Objects that a skill holds when it ends, ``held``, and that it has let go, ``free``."""
    free = {hold.frame: ("free", hold) for hold in skill.holds}
    held = [hold for hold in skill.holds if hold.begin < skill.end <= hold.end]
    return tuple((free | {hold.frame: ("held", hold) for hold in held}).values())


def _held_on(holds: list[Hold], new: Hold) -> list[Hold]:
    """Holds, and a later one; an object that is held by then stays so until it begins."""
    before = [hold for hold in holds if hold.frame == new.frame and hold.end > new.begin]
    kept = [hold for hold in holds if hold not in before]
    for hold in before:
        if hold.link == new.link:
            new = replace(new, begin=hold.begin)
        else:
            kept.append(replace(hold, end=new.begin))
    return [*kept, new]


def _are_parts(skills: tuple[Skill, ...], fade: float) -> bool:
    """Check that all skills share one clock, of one robot."""
    for one, other in pairwise(skills):
        if one.kinematics.joint_names != other.kinematics.joint_names:
            raise DataError("the skills of a sequence are of different robots")
        if fade < abs(other.begin - one.end) < abs(other.begin - one.begin):
            raise DataError(
                f"a skill that begins at {other.begin:.4g} s cannot follow one that ends at "
                f"{one.end:.4g} s: on one clock each begins where the one before ends, and "
                "those learned separately each begin at the beginning"
            )
    return all(_shares_clock(one, other, fade) for one, other in pairwise(skills))


def _of_each(what: str, value: Any, count: int) -> Any:
    """Return a value of each skill."""
    several = value if isinstance(value, tuple | list) else [value] * count
    if len(several) != count:
        raise DataError(f"{what} has {len(several)} entries for {count} skills: {value!r}")
    return several


def _conditions(skill: Skill, given: Any) -> tuple[Condition, ...]:
    """Conditions at the end of a skill, checked."""
    found = list[Condition]()
    for one in given if isinstance(given, tuple | list) else [given or ""]:
        found += filter(None, map(str.strip, one.split("+"))) if isinstance(one, str) else [one]
    for one in found:
        if not callable(one):
            _check_condition(one, skill)
    return tuple(found)


def _check_condition(one: Any, skill: Skill) -> None:
    """Refuse a condition that cannot be met."""
    known = [*CONDITIONS, *(CONTACT + link for link in skill.kinematics.links)]
    if one not in known:
        raise UnknownNameError("condition", one, "a sequence, which may have a function", known)
    if one in ("held", "free") and one not in dict(_ends(skill)):
        raise DataError(
            f"until {one!r}: no object is {one} by the end of this skill, of which the holds "
            f"are {[str(hold) for hold in skill.holds]}"
        )


def _retry(names: tuple[str, ...], number: int, given: Any) -> tuple[int, int]:
    """Read how often a skill is tried again, and from which one on."""
    times, back = given if isinstance(given, tuple | list) else (given, number)
    if isinstance(back, str):
        if back not in names:
            raise UnknownNameError("skill", back, "the sequence", names)
        back = names.index(back)
    if not (isinstance(times, int) and isinstance(back, int) and times >= 0 <= back <= number):
        raise DataError(
            f"{names[number]!r} is tried again a number of times, from itself or from a skill "
            f"before it: retry is that number, or a pair (number, skill), got {given!r}"
        )
    return times, back

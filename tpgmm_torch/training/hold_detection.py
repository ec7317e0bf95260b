"""Which link held which object, and when: found in demonstrations.

An object is held by a link while it moves and its pose in the link does not change. It must
move for that: of one that stands still beside a hand that stands still nothing can be said, and
poses that were recorded once, where an object was at first, are never held.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import median
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch.data.demonstrations import SMOOTHING, Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold, check_holds
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, UnknownNameError
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.base import frame_names
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["attach_holds", "find_holds"]

#: What moved by less than so many tolerances may as well have been jolted, or seen badly.
TRAVEL = 3.0
#: A grasp is steady to this share of the tolerance, at best.
FINEST = 0.1
#: How far poses are from others, in units of the tolerances: at least 0, at most 1 if alike.
Change = Callable[[Frame, Frame], Tensor]


def find_holds(
    demonstrations: Sequence[Demonstration],
    kinematics: Kinematics,
    *,
    frames: Sequence[str] | None = None,
    tolerance: float = 0.01,
    angle: float = 0.1,
    agreement: float = 0.5,
) -> tuple[Hold, ...]:
    """Find from when to when objects move rigidly with a link, alike in the demonstrations.

    A hold begins when the link touches the object: at the instant from which it stands as it
    does when the object starts to move. A hand that closes may shift the object by up to three
    tolerances. It ends midway between when the object is put down and when the link leaves it.
    Over demonstrations the median counts. Of two hands that carry an object, the one in which
    it is steadier in most demonstrations holds it. In a demonstration that says itself what is
    held, nothing is looked for.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        Aligned in time. Objects that were recorded once are never held.
    kinematics : Kinematics
        Whose links may hold.
    frames : sequence of str, optional
        Where to look; by default all frames.
    tolerance : float, default=0.01
        How much an object's position in the link may change while it is held [m].
    angle : float, default=0.1
        How much it may turn [rad].
    agreement : float, default=0.5
        The share of the demonstrations that must show the same holds in the same order.

    Returns
    -------
    tuple of Hold
        In the order of time.

    Raises
    ------
    UnknownNameError, DataError
        If there is no such frame, or a tolerance is not positive.

    Examples
    --------
    >>> import torch
    >>> from tpgmm_torch import Demonstration, Frame
    >>> from tpgmm_torch.robots import Poses
    >>> time = torch.linspace(0, 4, 81, dtype=torch.float64)
    >>> x = torch.stack((time - 2, 0 * time, 0 * time), dim=-1)  # of the hand
    >>> hand, cup = Frame(x), Frame(x.clamp(min=0))  # comes to the cup, and takes it along
    >>> shown = Demonstration(time, Poses.joints({"hand": hand}), {"cup": cup})
    >>> [hold] = find_holds([shown], Poses(["hand"]))
    >>> hold.frame, hold.link, round(hold.begin, 1), hold.end
    ('cup', 'hand', 2.0, inf)
    """
    for name, value in (("tolerance", tolerance), ("angle", angle)):
        if not 0 < value < math.inf:
            raise DataError(f"{name} must be positive and finite, got {value}")
    known = demonstrations[0].frames
    for frame in frames or ():
        if frame not in known:
            raise UnknownNameError("frame", frame, "the demonstration", known)

    def change(one: Frame, other: Frame) -> Tensor:
        return one.change(other, tolerance, angle)

    motions = [_Motion(one, kinematics, change) for one in demonstrations]
    holds: list[Hold] = []
    for name in known if frames is None else frames:
        holds += _most_common_holds([motion.holds(name) for motion in motions], agreement)
    return check_holds(holds, known, kinematics.links)


def attach_holds(
    demonstrations: Sequence[Demonstration], robot: Kinematics | None, **settings: Any
) -> list[Demonstration]:
    """Attach what the robot holds, :func:`find_holds`, to demonstrations.

    Call it on demonstrations that are aligned in time, as the next to last step before ``fit``.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        Of one skill, aligned in time.
    robot : Kinematics or None
        Without one nothing is held.
    **settings
        Of :func:`find_holds`.

    Returns
    -------
    list of Demonstration

    Raises
    ------
    UnknownNameError, DataError
        As of :func:`find_holds`.
    """
    holds = () if robot is None else find_holds(demonstrations, robot, **settings)
    return with_holds(demonstrations, holds)


def with_holds(
    demonstrations: Sequence[Demonstration], holds: Sequence[Hold]
) -> list[Demonstration]:
    """Attach given holds to demonstrations.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        Of one skill, aligned in time.
    holds : sequence of Hold
        Empty if it holds nothing.
    """
    return [replace(one, holds=tuple(holds)) for one in demonstrations]


def demonstrated_holds(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    kinematics: Kinematics,
) -> tuple[Hold, ...]:
    """Agree on holds of the objects that operators refer to.

    Where the first says nothing and objects move with a link, there is a warning.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        Of one skill, aligned in time.
    operators : sequence of Operator
        Which refer to objects.
    kinematics : Kinematics
        Whose links may hold.

    Returns
    -------
    tuple of Hold

    Raises
    ------
    UnknownNameError
        If a link is not the robot's.
    """
    names = frame_names(operators, kinematics)
    found = find_holds(demonstrations, kinematics, frames=names)
    if demonstrations[0].holds is not None:
        return found
    if found:
        warnings.warn(
            f"objects move as if links held them ({', '.join(map(str, found))}, in seconds), "
            "and the demonstrations do not say so: they are taken for objects that move by "
            "themselves. Call attach_holds(demonstrations, robot) before fit, or give "
            "Demonstration(..., holds=()) where nothing is held",
            PlausibilityWarning,
            stacklevel=4,
        )
    return ()


@dataclass(frozen=True, eq=False)
class _Motion:
    """Where the links of a robot were in one demonstration, and its objects."""

    demonstration: Demonstration
    kinematics: Kinematics
    change: Change

    @cached_property
    def links(self) -> dict[str, Frame]:
        """Poses (T,) of the links."""
        ordered = self.demonstration.reorder(self.kinematics.joint_names)
        state = self.kinematics.state(ordered.joints)
        return {link: state.pose(link) for link in self.kinematics.links}

    @cached_property
    def time(self) -> Tensor:
        """Instants (T,)."""
        return self.demonstration.time.to(self.kinematics.lower)

    def holds(self, name: str) -> list[Hold]:
        """Find the holds of an object, in the order of time."""
        if self.demonstration.holds is not None:
            return [hold for hold in self.demonstration.holds if hold.frame == name]
        pose, change = self.demonstration.frames[name], self.change
        if not pose.batch_shape or float(change(pose[:1], pose).max()) <= TRAVEL:
            return []
        pose = pose.to(self.time)
        sooner, later = self._window()
        speed = change(pose[sooner], pose[later])
        found: list[tuple[int, int, Hold]] = []
        while float(speed.max()) > FINEST:
            seed = int(speed.argmax())  # the faster it moves, the surer is who holds it
            first, last = int(sooner[seed]), int(later[seed])
            span = self._span(name, pose, seed)
            if span is not None:
                found.append(span)
                first, last = span[:2]
            speed[first : last + 1] = 0
        return _in_order([hold for *_, hold in sorted(found, key=lambda span: span[:2])])

    def _window(self) -> tuple[Tensor, Tensor]:
        """Find, for each instant, those between which its motion is measured."""
        later = torch.searchsorted(self.time, self.time + SMOOTHING / 2)
        later = later.clamp(max=len(self.time) - 1)
        return torch.searchsorted(self.time, self.time - SMOOTHING / 2), later

    def _span(self, name: str, pose: Frame, seed: int) -> tuple[int, int, Hold] | None:
        """Find who held the object around a moment in motion, if anyone, and for how long."""
        carried, change = list[tuple[str, int, int, Tensor]](), self.change
        for link, hand in self.links.items():
            grasp = pose.seen_from(hand)
            slip = change(grasp[seed : seed + 1], grasp)
            first, last = _run(slip <= 1, seed)
            if float(change(pose[first : first + 1], pose[first : last + 1]).max()) > TRAVEL:
                carried.append((link, first, last, slip))
        if not carried:
            return None
        # of several that hold it, the longest and steadiest; the first of those alike
        scores = [float((1 - slip[first : last + 1]).sum()) for _, first, last, slip in carried]
        steady = next(i for i, one in enumerate(scores) if one >= (1 - FINEST) * max(scores))
        link, first, last, slip = carried[steady]
        finest = 2 * float(slip[first : last + 1].quantile(0.9))
        finest = min(max(finest, FINEST), 1.0)
        # steady in the hand from `first` to `last`, in motion from `lifted` to `put`
        first, last = _run(slip <= finest, seed)
        at_rest = change(pose[first : first + 1], pose) <= finest
        lifted = first + max(int((~at_rest[first : seed + 1]).int().argmax()) - 1, 0)
        at_rest = change(pose[last : last + 1], pose) <= finest
        put = last - int((~at_rest[seed : last + 1]).flip(0).int().argmax()) + 1
        begin = float(self.time[self._find_touch(link, pose, first, lifted, finest)])
        end = float(self.time[last] + self.time[min(put, last)]) / 2
        end = math.inf if last == len(self.time) - 1 else end
        return (first, last, Hold(name, link, begin, end)) if begin < end else None

    def _find_touch(
        self, link: str, pose: Frame, first: int, lifted: int, finest: float
    ) -> int:
        """Find the instant since which a link stands as it does before it lifts an object."""
        hand, change = self.links[link], self.change
        sooner, later = self._window()
        close, _ = _run(change(hand[lifted : lifted + 1], hand) <= TRAVEL, lifted)
        speed = change(hand[sooner], hand[later])[close : lifted + 1]
        # the last of the slowest: commanded links are ahead of what they lift
        rests = lifted - int(speed.flip(0).argmin())
        still = change(hand[rests : rests + 1], hand) <= finest
        stood, _ = _run(still, rests)
        # a hand that closes shifts an object a little; what comes further, somebody else brings
        near = change(pose[lifted : lifted + 1], pose[stood : lifted + 1]) <= TRAVEL
        return min(stood, first) if bool(near.all()) else first


def _in_order(found: Sequence[Hold]) -> list[Hold]:
    """Put holds of an object in order, one at a time."""
    holds: list[Hold] = []
    for hold in found:
        before = holds[-1] if holds else None
        if before is None or before.end < hold.begin - SMOOTHING:
            holds.append(hold)
        elif before.link == hold.link:  # it slipped
            holds[-1] = replace(before, end=max(before.end, hold.end))
        elif before.begin < hold.begin < hold.end:  # from hand to hand
            holds[-1:] = [replace(before, end=hold.begin), hold]
    return holds


def _run(true: Tensor, seed: int) -> tuple[int, int]:
    """Find first and last index of the stretch around ``seed`` in which all are true."""
    false = torch.nonzero(~true)[:, 0]
    before, after = false[false < seed], false[false > seed]
    first = int(before[-1]) + 1 if len(before) else 0
    return first, int(after[0]) - 1 if len(after) else len(true) - 1


def _most_common_holds(shown: Sequence[list[Hold]], agreement: float) -> list[Hold]:
    """Find the holds of an object that most demonstrations show."""
    orders = [tuple(hold.link for hold in holds) for holds in shown]
    [(order, count)] = Counter(filter(None, orders)).most_common(1) or [((), 0)]
    if count < max(agreement * len(shown), 1):
        return []
    alike = [holds for holds, links in zip(shown, orders, strict=True) if links == order]
    typical = []
    for holds in zip(*alike, strict=True):
        begin, end = median(hold.begin for hold in holds), median(hold.end for hold in holds)
        typical.append(replace(holds[0], begin=begin, end=end))
    return _in_order(typical)

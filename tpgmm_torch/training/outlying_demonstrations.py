"""Which demonstrations are unlike the others, as the operators see them.

A frame that was seen in a wrong place, or at a wrong time, is plain where all others agree: the
hand is at the object then, and in this demonstration alone it is far away. One such
demonstration widens the covariances of exactly those instants that the skill is about.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import torch
from torch import Tensor

from tpgmm_torch.checks.report import Finding, Report, shorten_list
from tpgmm_torch.checks.summary import ALIKE
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.base import leaves
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.hold_detection import attach_holds
from tpgmm_torch.training.local_data import at_phases
from tpgmm_torch.training.mixture_settings import check_operators, kinematics_for
from tpgmm_torch.training.shares import Share
from tpgmm_torch.training.training_rows import TrainingRows, read_rows

__all__ = ["drop_outliers"]

#: Fewer demonstrations do not show how far they differ.
FEWEST = 5
#: Distance from the median that is usual: a share of the range of coordinates.
NEAR = 0.005
#: Demonstrations of more numbers than this (512 MB) are compared at fewer instants.
LARGEST_TABLE = 2**26


@dataclass(frozen=True)
class Outlying:
    """One demonstration that is unlike the others.

    Parameters
    ----------
    episode : int
        Which one, counted from 0.
    operator : Operator
        That sees it most.
    time : float
        When it is seen most [s].
    ratio : float
        How far the demonstration is from the median there, in robust standard deviations of
        all.
    """

    episode: int
    operator: Operator
    time: float
    ratio: float


def outlying_demonstrations(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    **settings: float,
) -> tuple[Outlying, ...]:
    """Find demonstrations far from the median, at instants at which others agree.

    In local coordinates, operator by operator and instant by instant: by Hampel's identifier,
    more than ``threshold`` times 1.4826 times the median distance from the median. Where the
    others agree to less than 0.5 % of the range of an operator's coordinates, or 0.05 rad, that
    counts as their distance.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        Aligned; what has other time grids is compared at equal phase. Fewer than five have
        none that are unlike the others, and where it would be more than a third of them, they
        show several ways rather than mistakes.
    operators : sequence of Operator
        In whose local coordinates it is seen.
    kinematics : Kinematics
        On which the operators act.
    **settings
        Of :func:`outlying_rows`.

    Returns
    -------
    tuple of Outlying
        In the order of the demonstrations.
    """
    if len(demonstrations) < FEWEST:  # nothing is read
        return ()
    rows = read_rows(Share(demonstrations), operators, kinematics)
    return outlying_rows(rows, kinematics, **settings)


def outlying_rows(
    rows: TrainingRows, kinematics: Kinematics, *, threshold: float = 8.0, duration: float = 0.5
) -> tuple[Outlying, ...]:
    """Find outlying demonstrations in rows that are read.

    Parameters
    ----------
    rows : TrainingRows
        Of all demonstrations.
    kinematics : Kinematics
        On which the operators act.
    threshold : float, default=8.0
        So many robust standard deviations from the median are unlike the others. On real
        recordings those who are not reach 6.1, those whose frame was taken at a wrong instant,
        5 to 15 cm beside the right one, at least 11.6.
    duration : float, default=0.5
        For how long in all [s].
    """
    number = rows.n_demonstrations
    if number < FEWEST:
        return ()
    lasts = float(rows.time[-1] - rows.time[0])
    most = LARGEST_TABLE // (number * rows.rows.shape[1])
    most = max(most, math.ceil(2 * lasts / duration) + 1)
    time = at_phases(rows.time, min(len(rows.time), most))
    data = rows.at_phases(len(time))
    step = lasts / max(len(time) - 1, 1)
    count = min(max(round(duration / step), 1), len(time)) if step > 0 else 1
    found: dict[int, Outlying] = {}
    for operator, local, near in comparable_coordinates(data, rows.operators, kinematics):
        distance = torch.linalg.vector_norm(local - local.median(0).values, dim=-1)  # (M, T)
        usual = distance.median(0).values.clamp(min=near) / NormalDist().inv_cdf(0.75)
        ratios, instants = (distance / usual).topk(count, dim=1)
        for episode in (ratios[:, -1] > threshold).nonzero()[:, 0].tolist():
            ratio, instant = float(ratios[episode, -1]), int(instants[episode, -1])
            if episode not in found or ratio > found[episode].ratio:
                found[episode] = Outlying(episode, operator, float(time[instant]), ratio)
    if len(found) > number // 3:
        return ()
    return tuple(found[episode] for episode in sorted(found))


def comparable_coordinates(
    data: Tensor, operators: Sequence[Operator], kinematics: Kinematics, least: float = 0.0
) -> Iterator[tuple[Operator, Tensor, float]]:
    """Yield coordinates that have one unit, by operator, and what is near in it.

    Parameters
    ----------
    data : Tensor of shape (M, T, sum_j (1 + D_j))
        Local data of M demonstrations, at equal phase.
    operators : sequence of Operator
        Members of a :class:`Stack` come one by one.
    kinematics : Kinematics
        On which the operators act.
    least : float, default=0
        Joints are compared in units of their ranges, of at least that [rad or m].

    Yields
    ------
    operator : Operator
    coordinates : Tensor of shape (M, T, D)
    near : float
        Distance at which two points mean the same.
    """
    column = 0
    for operator in operators:
        column += 1  # time
        for leaf in leaves([operator]):
            width = leaf.dimension(kinematics)
            local = data[..., column : column + width]
            column += width
            others = torch.ones(width, dtype=torch.bool)
            for start in leaf.quaternion_starts(kinematics):
                others[start : start + 4] = False
                yield leaf, 2 * local[..., start : start + 4], ALIKE["turn"]
            for start in leaf.rotation_vector_starts(kinematics):
                others[start : start + 3] = False
                yield leaf, local[..., start : start + 3], ALIKE["turn"]
            local = local[..., others]
            spread = local.flatten(0, 1).amax(0) - local.flatten(0, 1).amin(0)
            if not bool((spread > 0).any()):
                continue
            # of joints, each has a unit of its own
            if leaf.determines_joints or leaf.is_posture:
                local = local[..., spread > 0] / spread[spread > 0].clamp(min=least)
                yield leaf, local, NEAR * local.shape[-1] ** 0.5
            else:
                yield leaf, local, NEAR * float(torch.linalg.vector_norm(spread))


def drop_outliers(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    robot: Kinematics | None = None,
    *,
    threshold: float = 8.0,
    duration: float = 0.5,
) -> list[Demonstration]:
    """Drop demonstrations unlike the others, with a warning.

    Of five or more, up to a third are left out.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        Aligned in time. Where they do not say what is held, it is found.
    operators : sequence of Operator
        In whose coordinates they are compared.
    robot : Kinematics, optional
        As of the estimator.
    threshold : float, default=8.0
        Robust standard deviations from the median beyond which one is unlike the others.
    duration : float, default=0.5
        How long in all it has to be so [s].

    Returns
    -------
    list of Demonstration

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        If the demonstrations do not fit together, or with the robot and the operators.
    """
    known, operators = check_demonstrations(demonstrations), check_operators(operators)
    kinematics = kinematics_for(known, operators, robot, "float64", "cpu")
    known = attach_holds(known, kinematics)
    settings = {"threshold": threshold, "duration": duration}
    outlying = outlying_demonstrations(known, operators, kinematics, **settings)
    if outlying:
        finding = replace(unlike_the_others(outlying, len(known)), remedy="They are left out")
        Report.of([finding], f"{len(known)} demonstrations").act()
    dropped = {one.episode for one in outlying}
    return [one for number, one in enumerate(demonstrations) if number not in dropped]


def unlike_the_others(outlying: Sequence[Outlying], count: int) -> Finding:
    """Describe demonstrations unlike the others, the worst first.

    Parameters
    ----------
    outlying : sequence of Outlying
        At least one.
    count : int
        Of all demonstrations.
    """
    worst = max(outlying, key=lambda one: one.ratio)
    places = [
        f"demonstration {one.episode} ({format_operator(one.operator)} at {one.time:.2f} s, "
        f"{one.ratio:.0f} robust standard deviations from the median)"
        for one in sorted(outlying, key=lambda one: -one.ratio)
    ]
    return Finding(
        "outliers",
        f"{len(outlying)} of {count} are unlike the others: {shorten_list(places)}",
        "Is the frame right, and the event's time? drop_outliers(demonstrations, operators, "
        "robot) leaves them out",
        (format_operator(worst.operator),),
        tuple(one.episode for one in outlying),
        worst.ratio,
    )

"""Which operators matter, and when: found among candidates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, permutations
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.checks.report import in_columns
from tpgmm_torch.constraints import DemonstrationEstimator, Interval, check_parameters
from tpgmm_torch.data.demonstrations import FEWEST, Demonstration, check_demonstrations
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    Operator,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.structure.evidence import Evidence, gather_evidence
from tpgmm_torch.training.hold_detection import demonstrated_holds, with_holds
from tpgmm_torch.training.mixture_settings import check_operators, kinematics_for
from tpgmm_torch.training.outlying_demonstrations import outlying_demonstrations

__all__ = ["SelectOperators"]


@dataclass(frozen=True)
class Judgement:
    """Why a candidate was kept or dropped.

    Parameters
    ----------
    operator : Operator
    kept : bool
    gain : float
        By how much demonstrations left out are more likely with it than without, given the
        others that were kept: mean over instants [nats].
    alone : float
        The same, given the joints' operators alone [nats].
    time : float
        When it gains most [s].
    error, error_of_others : float
        How far a demonstration left out is then from what the operator expects in its own
        coordinates, and from what the others that were kept expect there: root mean square, in
        ``unit``.
    unit : str
        ``"mm"`` or ``"deg"``; ``""`` where coordinates are of several kinds.
    """

    operator: Operator
    kept: bool
    gain: float
    alone: float
    time: float
    error: float
    error_of_others: float
    unit: str


class SelectOperators(DemonstrationEstimator):
    """Find the operators that matter among candidates, as the demonstrations tell.

    A candidate matters if a demonstration that was left out is more likely with it than
    without. For that the smallest model will do, one Gaussian per operator and instant, and
    its likelihood is that of the joints given where the frames are, so that operators of
    every kind compare. From the joints' operators, the candidate that gains most is added
    until none gains ``threshold``; then what gains less, given all others, is dropped. Several
    that say the same leave one; an operator of all joints stays, as it decides what the others
    leave free. Demonstrations unlike the others as a candidate sees them do not count, and
    objects are held as the demonstrations' ``holds`` say.

    Parameters
    ----------
    candidates : sequence of Operator, optional
        By default :func:`candidate_operators`: the joints; positions and orientations of all
        links in the base frame, seen from all frames, and of one link seen from another; of
        what is held, seen from the other frames, and from one another as they are held.
    robot : Kinematics, optional
        What the candidates act on, as in :class:`TaskParameterizedGMM`.
    tolerance : float, default=0.005
        Agreement of the joints below it means nothing [rad or m].
    threshold : float, default=0.25
        The least mean gain that matters [nats per instant]. Where an operator holds D
        coordinates r times more exactly than the others do, for a share s of the duration, it
        gains about ``s D log r``: three coordinates ten times more exactly, for 4 % of it.
    n_instants : int, default=50
        At how many instants the demonstrations are looked at.
    n_left_out : int, default=20
        How many demonstrations are left out in turn, chosen evenly where there are more.

    Attributes
    ----------
    candidates_ : tuple of Operator
    support_ : array of bool, of shape (C,)
        Which candidates matter.
    operators_ : tuple of Operator
        Those that matter, for ``TaskParameterizedGMM``: what refers to one frame is a
        :class:`Stack`, joints come last.
    relevance_ : array of shape (T, C)
        Gains at each instant, given the others that were kept [nats].
    time_ : array of shape (T,)
        The instants [s].
    judgements_ : tuple of Judgement
        One per candidate: why.

    References
    ----------
    Alizadeh, Malekzadeh: Identifying the relevant frames of reference in programming by
    demonstration using task-parameterized Gaussian mixture regression, SII 2016, poses the
    question; likelihood of what was left out answers it here.

    Examples
    --------
    >>> from tpgmm_torch import Demonstration, Frame, SelectOperators
    >>> from tpgmm_torch.robots import Poses
    >>> time, rng = np.linspace(0, 1, 30), np.random.default_rng(0)
    >>> shown = []
    >>> for _ in range(5):
    ...     cup, lamp = rng.uniform(-0.3, 0.3, (2, 3))
    ...     path = time[:, None] * cup + 0.002 * rng.normal(size=(30, 3))
    ...     shown.append(Demonstration(time, path, {"cup": Frame(cup), "lamp": Frame(lamp)}))
    >>> found = SelectOperators(robot=Poses(["hand"], orientation=False)).fit(shown)
    >>> [one.frame for one in found.operators_[:-1]]
    ['cup']
    """

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012
        "candidates": ["array-like", None],
        "robot": [Kinematics, None],
        "tolerance": [Interval(Real, 0, None, closed="neither")],
        "threshold": [Interval(Real, 0, None, closed="left")],
        "n_instants": [Interval(Integral, 2, None, closed="left")],
        "n_left_out": [Interval(Integral, 1, None, closed="left")],
    }

    def __init__(
        self,
        candidates: Sequence[Operator] | None = None,
        robot: Kinematics | None = None,
        *,
        tolerance: float = 0.005,
        threshold: float = 0.25,
        n_instants: int = 50,
        n_left_out: int = 20,
    ) -> None:
        self.candidates = candidates
        self.robot = robot
        self.tolerance = tolerance
        self.threshold = threshold
        self.n_instants = n_instants
        self.n_left_out = n_left_out

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Find which candidates matter.

        Parameters
        ----------
        X : sequence of Demonstration
            At least three, aligned in time.
        y : ignored
            Here for scikit-learn.

        Returns
        -------
        self

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If there are fewer, or they do not fit the candidates and the robot.
        """
        check_parameters(self)
        demonstrations = check_demonstrations(X)
        if len(demonstrations) <= FEWEST:
            raise DataError(
                "which operators matter is seen from demonstrations that differ: it takes at "
                f"least {FEWEST + 1}, got {len(demonstrations)}; name the operators instead"
            )
        candidates = self.candidates
        if candidates is None:
            candidates = candidate_operators(self.robot, demonstrations[0])
        operators = check_operators(candidates)
        kinematics = kinematics_for(demonstrations, operators, self.robot, "float64", "cpu")
        holds = demonstrated_holds(demonstrations, operators, kinematics)
        # one frame in a wrong place hides that it matters
        demonstrations = with_holds(demonstrations, holds)
        outlying = outlying_demonstrations(demonstrations, operators, kinematics)
        unlike = {one.episode for one in outlying}
        demonstrations = [d for i, d in enumerate(demonstrations) if i not in unlike]
        evidence = gather_evidence(
            demonstrations, operators, kinematics,
            tolerance=self.tolerance, n_instants=self.n_instants, n_left_out=self.n_left_out,
            holds=holds,
        )  # fmt: skip
        chosen = self._choose(evidence, operators)
        self.candidates_, self.time_ = operators, evidence.time.cpu().numpy()
        self.support_ = np.isin(np.arange(len(operators)), chosen)
        self.operators_ = arrange([operators[j] for j in chosen])
        judged = [self._judge(evidence, j, chosen, kinematics) for j in range(len(operators))]
        self.judgements_ = tuple(judgement for judgement, _ in judged)
        self.relevance_ = torch.stack([gains for _, gains in judged], -1).cpu().numpy()
        return self

    def report(self) -> str:
        """Tabulate the candidates, those that gain most first: which were kept, and why."""
        self._check_fitted("support_")
        order = sorted(self.judgements_, key=lambda one: (not one.kept, -one.gain, -one.alone))
        lines: list[tuple[str, ...]] = [
            ("", "operator", "gain", "alone", "at", "left out is off by", "others by", "why")
        ]
        for one in order:
            gains = one.gain, one.alone
            numbers = *(f"{gain:.2f}" for gain in gains), f"{one.time:.2f} s"
            errors = (f"{e:.3g} {one.unit}".rstrip() for e in (one.error, one.error_of_others))
            kept, name = "kept" * one.kept, format_operator(one.operator)
            lines.append((kept, name, *numbers, *errors, self._why(one)))
        return in_columns(lines)

    def _why(self, one: Judgement) -> str:
        matters = (one.gain if one.kept else one.alone) >= self.threshold
        if one.kept:
            return "decides there" if matters else "decides what the others leave free"
        return "says what those kept say" if matters else "tells nothing of what was left out"

    def _choose(self, evidence: Evidence, operators: Sequence[Operator]) -> list[int]:
        """Add to the joints' operators those that gain most; drop what then gains little."""

        @cache
        def mean(*operators: int) -> float:
            return float(evidence.log_likelihood(operators).mean())

        chosen = _joints_of(operators)
        rest = [j for j, one in enumerate(operators) if not one.is_posture]
        while rest:
            best = max(rest, key=lambda j: mean(*chosen, j))
            if chosen and mean(*chosen, best) - mean(*chosen) <= self.threshold:
                break
            chosen, rest = [*chosen, best], _without(rest, best)
        return sorted(self._drop(chosen, operators, mean))

    def _drop(
        self, chosen: list[int], operators: Sequence[Operator], mean: Callable[..., float]
    ) -> list[int]:
        """Drop operators, but for those of all joints, that gain little beside the others."""
        free = [j for j in chosen if not operators[j].determines_joints]
        while len(chosen) > 1 and free:
            least = max(free, key=lambda j: mean(*_without(chosen, j)))
            if mean(*chosen) - mean(*_without(chosen, least)) > self.threshold:
                break
            chosen, free = _without(chosen, least), _without(free, least)
        return chosen

    def _judge(
        self, evidence: Evidence, j: int, chosen: Sequence[int], kinematics: Kinematics
    ) -> tuple[Judgement, Tensor]:
        """Judge candidate j; also return its gains (T,)."""
        operator, others = self.candidates_[j], _without(chosen, j)
        joints = _joints_of(self.candidates_)
        base = [] if j in joints else joints

        def gain(beside: Sequence[int]) -> Tensor:
            with_it = evidence.log_likelihood([*beside, j])
            return (with_it - evidence.log_likelihood(beside)).mean(0)

        gains = gain(others)
        peak = int(gains.argmax())
        factor, unit = _unit(operator, evidence.jacobians[j].shape[-2], kinematics)
        error, of_others = (float(each[peak]) * factor for each in evidence.errors(j, others))
        numbers = float(gains.mean()), float(gain(base).mean()), float(evidence.time[peak])
        judgement = Judgement(operator, j in chosen, *numbers, error, of_others, unit)
        return judgement, gains


def candidate_operators(
    kinematics: Kinematics | None, demonstration: Demonstration
) -> list[Operator]:
    """List the operators that :class:`SelectOperators` chooses from where nothing is named.

    Parameters
    ----------
    kinematics : Kinematics or None
        Whose links are seen: in the base frame, from every frame, and from one another.
    demonstration : Demonstration
        Whose frames there are. Those of objects that its ``holds`` name are seen from the other
        frames, too, and from one another as they are held.

    Examples
    --------
    >>> from tpgmm_torch import Frame
    >>> from tpgmm_torch.robots import Poses
    >>> shown = Demonstration([0.0], [[0.0, 0, 0]], {"cup": Frame([0.4, 0, 0])})
    >>> for one in candidate_operators(Poses(["hand"], orientation=False), shown):
    ...     print(format_operator(one))
    canonical
    position:hand
    position:hand@cup
    """
    links = () if kinematics is None else kinematics.links
    turns = getattr(kinematics, "orientation", True)  # tracked points have none
    # what is held is a thing of its own, to be brought to a place
    held = list(dict.fromkeys(hold.frame for hold in demonstration.holds or ()))
    poses: list[Operator] = []
    for link in links:
        poses += AbsolutePosition(link), AbsoluteOrientation(link)
    for pair in _pairs(demonstration, links, held):
        poses += RelativePosition(*pair), RelativeOrientation(*pair)
    for pair in permutations(held, 2):  # each in a hand of its own
        poses += RelativePosition(*pair, held=True), RelativeOrientation(*pair, held=True)
    return [Canonical(), *(poses if turns else poses[::2])]


def _pairs(
    demonstration: Demonstration, links: Sequence[str], held: Sequence[str]
) -> list[tuple[str, str]]:
    """List what is seen from where: links from frames and links, held objects from frames."""
    frames = demonstration.frames
    pairs = [(link, frame) for frame in frames for link in links]
    pairs += [(link, other) for other, link in combinations(links, 2)]
    return pairs + [(thing, frame) for thing in held for frame in frames if frame != thing]


def _joints_of(operators: Sequence[Operator]) -> list[int]:
    """List the operators of joints, by number."""
    return [j for j, one in enumerate(operators) if one.is_posture]


def _without(chosen: Sequence[int], dropped: int) -> list[int]:
    return [j for j in chosen if j != dropped]


def arrange(operators: Sequence[Operator]) -> tuple[Operator, ...]:
    """Stack those ``operators`` that refer to one place, and put joints behind them."""
    groups: dict[Any, list[Operator]] = {}
    joints = []
    for operator in operators:
        if operator.is_posture:
            joints.append(operator)
        else:
            place = operator.references(), operator.links()[1:]
            groups.setdefault(place, []).append(operator)
    tasks = [group[0] if len(group) == 1 else Stack(*group) for group in groups.values()]
    return (*tasks, *joints)


def _unit(operator: Operator, rows: int, kinematics: Kinematics) -> tuple[float, str]:
    """Return factor and unit for the rows of an operator's Jacobian."""
    units = {*operator.units(kinematics)}
    if units == {"m"}:
        return 1e3, "mm"
    if operator.quaternion_starts(kinematics) == (0,) and len(operator.units(kinematics)) == 4:
        return (2.0 if rows == 4 else 1.0) * 180 / np.pi, "deg"
    if "rad" in units and "m" not in units:
        return 180 / np.pi, "deg"
    return 1.0, ""

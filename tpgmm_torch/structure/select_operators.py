"""Which operators matter, and when: found among candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, combinations, permutations
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from tpgmm_torch.constraints import Interval, check_parameters
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.exceptions import DataError, NotFittedError
from tpgmm_torch.notebook import in_columns
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
from tpgmm_torch.training.hold_detection import demonstrated_holds
from tpgmm_torch.training.mixture_settings import check_operators, kinematics_for
from tpgmm_torch.training.outlying_demonstrations import outlying_demonstrations

__all__ = ["Judgement", "SelectOperators", "arranged", "candidate_operators"]

#: Of two, one is left to learn from, and has no variance.
FEWEST = 3
#: What demonstrations show together is worth one more that a variance is learned from: with
#: three, of which two are left, their chance agreement else decides.
PRIOR_DEGREES = 1.0
POSITIONS = AbsolutePosition, RelativePosition
ORIENTATIONS = AbsoluteOrientation, RelativeOrientation


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


class SelectOperators(BaseEstimator):  # type: ignore[misc]
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
    frame_relevance_ : dict of str to array of shape (T,)
        The same for each frame that matters: what all operators gain together that were kept
        and see from it, of which one may say what another says [nats].
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
    }

    def __init__(
        self,
        candidates: Sequence[Operator] | None = None,
        robot: Kinematics | None = None,
        *,
        tolerance: float = 0.005,
        threshold: float = 0.25,
        n_instants: int = 50,
    ) -> None:
        self.candidates = candidates
        self.robot = robot
        self.tolerance = tolerance
        self.threshold = threshold
        self.n_instants = n_instants

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
        if len(demonstrations) < FEWEST:
            raise DataError(
                "which operators matter is seen from demonstrations that differ: it takes at "
                f"least {FEWEST}, got {len(demonstrations)}; name the operators instead"
            )
        given = self.candidates
        if given is None:
            # what is held is a thing of its own, to be brought to a place
            carried = list(dict.fromkeys(one.frame for one in demonstrations[0].holds or ()))
            given = candidate_operators(self.robot, demonstrations[0], carried)
        operators = check_operators(given)
        kinematics = kinematics_for(demonstrations, operators, self.robot, "float64", "cpu")
        holds = demonstrated_holds(demonstrations, operators, kinematics)
        # one frame in a wrong place hides that it matters
        outlying = outlying_demonstrations(demonstrations, operators, kinematics, holds)
        unlike = {one.episode for one in outlying}
        demonstrations = [d for i, d in enumerate(demonstrations) if i not in unlike]
        evidence = gather_evidence(
            demonstrations,
            operators,
            kinematics,
            tolerance=self.tolerance,
            n_instants=self.n_instants,
            holds=holds,
            prior_degrees=PRIOR_DEGREES,
        )
        joints = [j for j, one in enumerate(operators) if isinstance(one, Canonical)]
        free = [j for j, one in enumerate(operators) if not one.determines_joints]
        chosen = self._select(evidence, joints, free)
        self.candidates_, self.time_ = operators, evidence.time.cpu().numpy()
        self.support_ = np.isin(np.arange(len(operators)), chosen)
        self.operators_ = arranged([operators[j] for j in chosen])
        self._judge(evidence, chosen, joints, kinematics)
        return self

    def get_support(self, indices: bool = False) -> NDArray[Any]:
        """Which candidates matter, as scikit-learn's selectors say it.

        Parameters
        ----------
        indices : bool, default=False
            Whether to return their numbers rather than a mask.
        """
        self._check_fitted()
        return np.flatnonzero(self.support_) if indices else self.support_

    def report(self) -> str:
        """A table of the candidates, those that gain most first: which were kept, and why."""
        self._check_fitted()
        order = sorted(self.judgements_, key=lambda one: (not one.kept, -one.gain, -one.alone))
        lines = [
            ("", "operator", "gain", "alone", "at", "left out is off by", "others by", "why")
        ]
        for one in order:
            if one.kept and one.gain < self.threshold:
                why = "decides what the others leave free"
            elif one.kept:
                why = "decides there"
            elif one.alone >= self.threshold:
                why = "says what those kept say"
            else:
                why = "tells nothing of what was left out"
            lines.append(
                (
                    "kept" if one.kept else "",
                    format_operator(one.operator),
                    f"{one.gain:.2f}",
                    f"{one.alone:.2f}",
                    f"{one.time:.2f} s",
                    f"{one.error:.3g} {one.unit}".rstrip(),
                    f"{one.error_of_others:.3g} {one.unit}".rstrip(),
                    why,
                )
            )
        return in_columns(lines)

    def _select(
        self, evidence: Evidence, joints: Sequence[int], free: Sequence[int]
    ) -> list[int]:
        """Add what gains most, then drop of those ``free`` to go what gains too little."""
        chosen = list(joints)
        everyone = range(len(evidence.jacobians))
        fused = evidence.of(chosen)
        likely = evidence.log_likelihood(fused).mean()
        while rest := [j for j in everyone if j not in chosen]:
            gains = [
                float(evidence.log_likelihood(evidence.added(fused, j)).mean() - likely)
                for j in rest
            ]
            best = int(np.argmax(gains))
            if chosen and gains[best] <= self.threshold:
                break
            chosen.append(rest[best])
            fused, likely = evidence.added(fused, rest[best]), likely + gains[best]
        while len(chosen) > 1 and (spare := [j for j in chosen if j in free]):
            losses = [
                float(likely - evidence.log_likelihood(evidence.of(_without(chosen, j))).mean())
                for j in spare
            ]
            least = int(np.argmin(losses))
            if losses[least] > self.threshold:
                break
            likely = likely - losses[least]
            chosen = _without(chosen, spare[least])
        return sorted(chosen)

    def _judge(
        self,
        evidence: Evidence,
        chosen: Sequence[int],
        joints: Sequence[int],
        kinematics: Kinematics,
    ) -> None:
        """Say of each candidate what it gains, when, and in its own units."""
        whole, base = evidence.of(chosen), evidence.of(joints)
        likely, before = evidence.log_likelihood(whole), evidence.log_likelihood(base)
        relevance, judgements = [], []
        for j, operator in enumerate(self.candidates_):
            others = evidence.of(_without(chosen, j)) if j in chosen else whole
            if j in chosen:
                gains = (likely - evidence.log_likelihood(others)).mean(0)
            else:
                gains = (evidence.log_likelihood(evidence.added(whole, j)) - likely).mean(0)
            if j in joints:
                alone = evidence.log_likelihood(evidence.of([j])) - evidence.log_likelihood(
                    evidence.nothing
                )
            else:
                alone = evidence.log_likelihood(evidence.added(base, j)) - before
            peak = int(gains.argmax())
            factor, unit = _unit(operator, evidence.jacobians[j].shape[-2], kinematics)
            error, of_others = (
                float(each[peak]) * factor for each in evidence.errors(j, others)
            )
            relevance.append(gains)
            judgements.append(
                Judgement(
                    operator,
                    bool(self.support_[j]),
                    float(gains.mean()),
                    float(alone.mean()),
                    float(evidence.time[peak]),
                    error,
                    of_others,
                    unit,
                )
            )
        self.relevance_ = torch.stack(relevance, -1).cpu().numpy()
        self.frame_relevance_ = {}
        for name in dict.fromkeys(chain(*(self.candidates_[j].references() for j in chosen))):
            if name not in kinematics.links:
                apart = [j for j in chosen if name not in self.candidates_[j].references()]
                without = evidence.log_likelihood(evidence.of(apart))
                self.frame_relevance_[name] = (likely - without).mean(0).cpu().numpy()
        self.judgements_ = tuple(judgements)

    def _check_fitted(self) -> None:
        if not hasattr(self, "support_"):
            raise NotFittedError(
                "this SelectOperators is not fitted yet: call fit(demonstrations)"
            )

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False  # X is a list of demonstrations
        return tags


def candidate_operators(
    kinematics: Kinematics | None, demonstration: Demonstration, held: Sequence[str] = ()
) -> list[Operator]:
    """What :class:`SelectOperators` chooses from where nothing is named.

    Parameters
    ----------
    kinematics : Kinematics or None
        Whose links are seen: in the base frame, from every frame, and from one another.
    demonstration : Demonstration
        Whose frames there are.
    held : sequence of str, default=()
        Frames of objects that links hold at times: they are seen from the other frames, too,
        and from one another as they are held.

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
    candidates: list[Operator] = [Canonical()]
    links = () if kinematics is None else kinematics.links
    turns = getattr(kinematics, "orientation", True)  # tracked points have none
    for link in links:
        candidates += [AbsolutePosition(link), AbsoluteOrientation(link)][: 1 + turns]
    frames = list(demonstration.frames)
    pairs = [(link, frame) for frame in frames for link in links]
    pairs += [(link, other) for other, link in combinations(links, 2)]
    pairs += [(thing, frame) for thing in held for frame in frames if frame != thing]
    for pair in pairs:
        candidates += [RelativePosition(*pair), RelativeOrientation(*pair)][: 1 + turns]
    for pair in permutations(held, 2):  # each in a hand of its own
        both = [RelativePosition(*pair, held=True), RelativeOrientation(*pair, held=True)]
        candidates += both[: 1 + turns]
    return candidates


def _without(chosen: Sequence[int], dropped: int) -> list[int]:
    return [j for j in chosen if j != dropped]


def arranged(operators: Sequence[Operator]) -> tuple[Operator, ...]:
    """Of some ``operators``, what refers to one place stacked, joints behind it."""
    groups: dict[Any, list[Operator]] = {}
    joints = []
    for operator in operators:
        if isinstance(operator, Canonical):
            joints.append(operator)
        else:
            place = operator.references(), operator.links()[1:]
            groups.setdefault(place, []).append(operator)
    tasks = [group[0] if len(group) == 1 else Stack(*group) for group in groups.values()]
    return (*tasks, *joints)


def _unit(operator: Operator, rows: int, kinematics: Kinematics) -> tuple[float, str]:
    """What turns numbers in the rows of an operator's Jacobian into the unit it has."""
    if isinstance(operator, POSITIONS):
        return 1e3, "mm"
    if isinstance(operator, ORIENTATIONS):  # a quaternion's four, or a rotation vector's three
        return (2.0 if rows == 4 else 1.0) * 180 / np.pi, "deg"
    if isinstance(operator, Canonical) and len(kinematics.lengths) == kinematics.n_joints:
        return 1e3, "mm"
    if isinstance(operator, Canonical) and not kinematics.lengths:
        return 180 / np.pi, "deg"
    return 1.0, ""

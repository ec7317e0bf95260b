"""Choices that the command line and policies leave to the demonstrations."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sklearn.pipeline import Pipeline, make_pipeline

from tpgmm_torch.alignment.base import Alignment
from tpgmm_torch.alignment.dynamic_time_warping import DynamicTimeWarping
from tpgmm_torch.alignment.piecewise_linear import EventAlignment, LinearTimeNormalization
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, PlausibilityWarning
from tpgmm_torch.mixture.processes import ALONE, Processes
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.base import frame_names
from tpgmm_torch.operators.text import default_operators
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.skills.skill import Skill
from tpgmm_torch.structure.fit_parts import fit_parts
from tpgmm_torch.structure.segmentation import Segmentation
from tpgmm_torch.structure.select_components import SelectComponents
from tpgmm_torch.structure.select_operators import SelectOperators
from tpgmm_torch.structure.select_ways import SelectWays
from tpgmm_torch.training.hold_detection import attach_holds, with_holds
from tpgmm_torch.training.outlying_demonstrations import drop_outliers

#: Names of alignments.
ALIGNMENTS = ("dtw", "barycenter", "linear", "events", "events+dtw", "parts", "none")


@dataclass(frozen=True)
class Choices:
    """Choices that are found in the demonstrations instead of being given.

    Parameters
    ----------
    operators, components : bool
        Whether they are found.
    parts : "auto", sequence of float or str, or None
        Where parts end.
    modes : "auto" or int
        In how many ways the skill is done.
    """

    operators: bool = False
    components: bool = False
    parts: str | Sequence[float | str] | None = None
    modes: str | int = 1

    def check(self, batch_episodes: int | None) -> None:
        """Refuse choices that do not go together.

        Raises
        ------
        DataError
            If there are choices and batches, or more than one of modes, parts and components.
        """
        chosen = sum([self.components, self.parts is not None, self.modes != 1])
        batched = batch_episodes is not None
        if chosen > 1 or (batched and (chosen or self.operators)):
            raise DataError(
                "--modes, --parts and --n-components auto go one at a time, and they and "
                "--operator auto without --batch-episodes: they compare all episodes"
            )


def aligner(
    method: str, robot: Kinematics | None = None, features: Sequence[str] | None = None
) -> Alignment | Pipeline | None:
    """Make the transformer of a name; None for ``"none"``.

    Parameters
    ----------
    method : str
        One of :data:`ALIGNMENTS`; ``"events+dtw"`` warps time between events, ``"parts"`` finds
        where parts end first.
    robot : Kinematics, optional
        Gives link positions, and where joints hold quaternions.
    features : sequence of str, optional
        Compared by time warping, as in :class:`DynamicTimeWarping`.

    Raises
    ------
    DataError
        If there is no such alignment.

    Examples
    --------
    >>> aligner("linear")
    LinearTimeNormalization()
    """
    reference = "barycenter" if method == "barycenter" else "medoid"
    warping = DynamicTimeWarping(reference, features=features, robot=robot)
    match method:
        case "none":
            return None
        case "linear":
            return LinearTimeNormalization(robot=robot)
        case "events":
            return EventAlignment(robot=robot)
        case "events+dtw":
            return EventAlignment(within=warping, robot=robot)
        case "dtw" | "barycenter":
            return warping
        case "parts":
            return make_pipeline(Segmentation(robot), EventAlignment(["part *"], robot=robot))
    raise DataError(f"an alignment is one of {list(ALIGNMENTS)}, got {method!r}")


def operators_or_default(
    given: Sequence[Operator], robot: Kinematics | None, frames: Sequence[str]
) -> list[Operator]:
    """Return the operators that are given, or all links seen from all frames, and the joints.

    Parameters
    ----------
    given : sequence of Operator
        Empty for the default.
    robot : Kinematics or None
    frames : sequence of str
        Objects in the demonstrations.

    Raises
    ------
    DataError
        If there are objects and no links, so that the objects would be forgotten.

    Warns
    -----
    PlausibilityWarning
        If links are seen from no object, though there are objects.
    """
    if given:
        _warn_of_unseen(given, robot, frames)
        return list(given)
    links = () if robot is None else robot.links
    if frames and not links:
        model = getattr(robot, "model", None)
        what = f"of {list(model.links)}" if model else "with --robot (--policy.robot)"
        raise DataError(
            f"the objects {list(frames)} would be forgotten: no links are seen from them. "
            f"Name the hands, --link (--policy.links) {what}; or ask for the joints alone, "
            """--operator canonical (--policy.operators='["canonical"]')"""
        )
    return default_operators(links, frames)


def _warn_of_unseen(
    operators: Sequence[Operator], robot: Kinematics | None, frames: Sequence[str]
) -> None:
    """Warn if links are seen from no object, though there are objects."""
    moving = any(one.links() for one in operators)
    if frames and robot is not None and moving and not frame_names(operators, robot):
        warnings.warn(
            f"none of the operators refers to the objects {list(frames)}: LINK@FRAME does",
            PlausibilityWarning,
            stacklevel=3,
        )


def prepare_demonstrations(
    aligned: Sequence[Demonstration],
    operators: Sequence[Operator],
    robot: Kinematics | None,
    robust: bool = True,
    holds: tuple[Hold, ...] | None = None,
) -> list[Demonstration]:
    """Demonstrations without outliers, and with what the robot holds.

    Parameters
    ----------
    aligned : sequence of Demonstration
    operators : sequence of Operator
        In whose coordinates outliers are found.
    robot : Kinematics or None
    robust : bool
        Whether to leave out outliers.
    holds : tuple of Hold, optional
        By default they are found.
    """
    shown = list(aligned) if holds is None else with_holds(aligned, holds)
    shown = drop_outliers(shown, operators, robot) if robust else shown
    return attach_holds(shown, robot) if holds is None else shown


def learn(
    model: TaskParameterizedGMM, source: Any, choices: Choices, processes: Processes = ALONE
) -> tuple[TaskParameterizedGMM | Skill, list[str]]:
    """Fit a model, with what is to be found first.

    Parameters
    ----------
    model : TaskParameterizedGMM
        Unfitted.
    source : sequence of Demonstration, or iterable of batches
        As :func:`prepare_demonstrations` gives them.
    choices : Choices
    processes : Processes

    Returns
    -------
    TaskParameterizedGMM or Skill
    list of str
        Reports of what was found, and why.
    """
    reports: list[str] = []
    if choices.parts is not None:
        cuts = choices.parts
        if isinstance(cuts, str):
            segmentation = Segmentation(model.robot).fit(source)
            reports.append(segmentation.report())
            cuts = segmentation.times()
        select = SelectOperators(robot=model.robot) if choices.operators else None
        return fit_parts(model, source, cuts, select), reports
    if choices.operators:
        selection = SelectOperators(robot=model.robot).fit(source)
        reports.append(selection.report())
        model.set_params(operators=selection.operators_)
    if choices.components:
        return SelectComponents(model).fit(source).best_model_, reports
    if choices.modes != 1:
        ways = SelectWays(model, choices.modes).fit(source)
        reports.append(ways.report())
        return ways.best_model_, reports
    return model.fit(source, processes=processes), reports


def parse_parts(text: str | None) -> str | list[float | str] | None:
    """Read where parts end from ``--parts``: "auto", or seconds and events.

    Parameters
    ----------
    text : str or None

    Examples
    --------
    >>> parse_parts("4.2, grasp")
    [4.2, 'grasp']
    """
    if text is None or text == "auto":
        return text
    cuts: list[float | str] = []
    for word in map(str.strip, text.split(",")):
        try:
            cuts.append(float(word))
        except ValueError:
            cuts.append(word)
    return cuts

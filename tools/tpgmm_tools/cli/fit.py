"""``tpgmm fit``: learn a model from a data set."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer

from tpgmm_datasets.conversion.poses import LinkPose
from tpgmm_datasets.episode_batches import EpisodeBatches
from tpgmm_datasets.lerobot.columns import EVENT
from tpgmm_datasets.lerobot.event_flags import event_features
from tpgmm_datasets.reader import Recording
from tpgmm_datasets.signals import Signals
from tpgmm_datasets.units import Scale
from tpgmm_tools.arguments import options
from tpgmm_tools.arguments.plugins import OWN, model_format
from tpgmm_torch.constraints import check_parameters
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.mixture.processes import joined_processes
from tpgmm_torch.operators.text import format_operator, parse_operator
from tpgmm_torch.persistence import save
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, InformationFusion
from tpgmm_torch.structure.choices import (
    Choices,
    aligner,
    learn,
    operators_or_default,
    parse_parts,
    prepare_demonstrations,
)  # fmt: skip
from tpgmm_torch.training.hold_detection import with_holds

__all__ = ["app"]

app = typer.Typer()

EXAMPLE = (
    "tpgmm fit out/demo/dataset --robot upper_body --link l_hand --link r_hand --frame bottle "
    "--n-components 30 --out out/model"
)
#: Parameters of the model that have an option below, or none.
OTHERS = (
    "n_components", "operators", "robot", "fusion", "random_state",
)  # fmt: skip
SETTINGS = options.options_of(TaskParameterizedGMM, "Learning", OTHERS)


@options.command(app, EXAMPLE, SETTINGS)
def fit(
    dataset: str,
    *,
    out: Path,
    described: options.RobotOptions,
    data: options.DataOptions,
    format_: str = OWN,
    plausibility: Literal["warn", "error", "ignore"] = "warn",
    alignment: options.Alignments = "dtw",
    batch_episodes: int | None = None,
    operator: list[str] | None = None,
    hold: list[str] | None = None,
    n_components: Any = 10,
    parts: str | None = None,
    modes: Any = 1,
    random_state: int = 0,
    fusion: Literal["information", "covariance"] = "information",
    epsilon: float = 1e-4,
    robust: bool = True,
    **settings: Any,
) -> None:
    """Learn a skill from a LeRobot data set.

    Episodes are aligned in time, described by operators (links seen from frames, and joints),
    and learned as one Gaussian mixture over all of them. The model is a folder of JSON and
    safetensors that 'tpgmm reproduce' and 'tpgmm plot' take. Several processes learn together
    under torchrun.

    Parameters
    ----------
    dataset : str
        A LeRobot data set: its folder, or hf://datasets/OWNER/NAME.
    out : ``DIR``
        Where the model goes.
    format_ : ``tpgmm | lerobot``
        'tpgmm' for Python and the other commands here; 'lerobot' for a policy that lerobot-eval
        and lerobot-rollout take, if lerobot_policy_tpgmm is installed.
    plausibility : str
        What is done about recordings that are unlikely to be what they are taken for: units,
        order, clock, outliers.
    alignment : str
        Bring episodes onto one clock: by time warping onto the most typical one, onto their
        average, by stretching time, by stretching it between events, by warping it between
        events, by stretching each of the parts that are found, or not at all.
    batch_episodes : int >= 1
        For sets larger than memory: read this number of episodes at a time. The first decide on
        the common clock. Default: all at once.
    operator : str
        What is learned together, repeatable: 'canonical' (the joints), 'position:LINK@FRAME',
        'orientation:LINK@FRAME', 'pose:LINK@FRAME' (both), without @FRAME in the base frame;
        FRAME may be another link, or held:FRAME an object as it is carried, which LINK may be
        too; 'canonical:left_*' some joints; '+' stacks. 'auto' finds what matters and says why.
        Default: the poses of all links in all frames, stacked, and canonical; objects are
        forgotten only if canonical is asked for.
    hold : str
        When a link holds an object, repeatable: FRAME@LINK:BEGIN-END in seconds, as in
        'bottle@l_hand:4.3-' to the end; or 'none'. Default: found in episodes whose frames were
        recorded over time.
    n_components : ``auto | INTEGER``
        K, the number of Gaussians; 'auto' finds it by the likelihood of episodes that are left
        out.
    parts : ``auto | 4.2,8.1 | grasp,rest``
        Where the skill has parts that are learned one by one, each with its share of
        --n-components and, with --operator auto, what matters in it: 'auto' finds and explains
        them; or when they end, as seconds and events joined by commas. See --alignment parts.
    modes : ``auto | INTEGER``
        In how many ways the skill is done, each a skill of its own; 'auto' finds it. The
        situation decides which is gone.
    random_state : int
        Seed of what is random.
    fusion : str
        Form of the product of Gaussians; 'covariance' is the paper's, as printed.
    epsilon : float >= 0
        Regulariser of --fusion covariance, rad^2.
    robust : bool
        Leave out episodes that are unlike the others where these agree, with a warning.
    """
    write = model_format(format_)
    choices = Choices(operator == ["auto"], n_components == "auto", parse_parts(parts), modes)
    choices.check(batch_episodes)
    options.filter_plausibility(plausibility)
    robot = described.read()
    given = None if hold == ["none"] else [Hold.parse(text) for text in hold or ()]
    holds = tuple(given or ()) if hold else None
    operators = [parse_operator(text) for text in operator or () if text != "auto"]
    model = TaskParameterizedGMM(
        10 if choices.components else n_components,
        operators,
        robot,
        fusion=CovarianceFusion(epsilon) if fusion == "covariance" else InformationFusion(),
        random_state=random_state,
        **settings,
    )
    check_parameters(model)
    recording = data.opened(dataset, robot)
    model.robot = robot = recording.assembly.robot
    about = data.arguments(robot)
    with joined_processes() as processes:
        episodes: Any
        if batch_episodes is None:
            read = list(recording.demonstrations())
            first, fitted = options.align(read, alignment, robot), None
        else:
            read, first = [], next(iter(EpisodeBatches(dataset, batch_episodes, **about)))
            fitted = aligner(alignment, robot)
            fitted = fitted and fitted.fit(first)
            first = fitted.transform(first) if fitted else first
        model.operators = operators_or_default(operators, robot, list(first[0].frames))
        kept = prepare_demonstrations(first, model.operators, robot, robust, holds)
        if processes.rank == 0:
            _echo(_recording_summary(recording, read, kept, described.link, not operator))
        episodes = processes.share(kept)
        if batch_episodes is not None:
            batches = EpisodeBatches(dataset, batch_episodes, processes=processes, **about)
            episodes = Aligned(batches, fitted, kept[0].holds or ())
        learned, reports = learn(model, episodes, choices, processes)
        if processes.rank > 0:
            return
    if write is None:
        save(learned, out)
    else:
        write(learned, out, Signals.of(dataset, **about))
    _report(learned, read, kept)
    for text in reports:
        typer.echo(f"\n{text}\n")
    if processes.count > 1:
        typer.echo(f"processes        {processes.count}")
    typer.echo(f"saved            {out}")
    typer.echo(f"next             tpgmm report {out} --dataset {dataset}")


class Aligned:
    """Batches of episodes, aligned as they are read.

    Parameters
    ----------
    batches : EpisodeBatches
        To read.
    alignment : Alignment, Pipeline or None
        Fitted to the first of all batches.
    holds : tuple of Hold
        Found in that batch.
    """

    def __init__(self, batches: EpisodeBatches, alignment: Any, holds: Any) -> None:
        self.batches, self.alignment, self.holds = batches, alignment, holds

    def __iter__(self) -> Iterator[Any]:
        """Read and align each."""
        for batch in self.batches:
            aligned = self.alignment.transform(batch) if self.alignment else batch
            yield with_holds(aligned, self.holds)


def _recording_summary(
    recording: Recording, read: Any, kept: Any, named: list[str] | None, default: bool
) -> dict[str, object]:
    """Summary of the data set and the robot, before anything is learned."""
    assembly, joints = recording.assembly, recording.assembly.joints
    names = assembly.robot.joint_names if assembly.robot is not None else joints.names or ()
    lines: dict[str, object] = {}
    if read:
        seconds, steps = [one.duration for one in read], sum(map(len, kept))
        lost = len(recording.episodes) - len(kept)
        lines["demonstrations"] = (
            f"{len(read)} of {min(seconds):.2f} to {max(seconds):.2f} s, {steps} steps after "
            f"alignment; {lost or 'none'} left out"
        )
    lines["joints"] = f"{kept[0].n_joints} of {joints.feature.key}: {', '.join(names)}"
    units: dict[str, list[str]] = {}
    for name, unit in zip(joints.names or ("all",), joints.units, strict=False):
        if name in names or not names:
            units.setdefault(_unit(unit), []).append(name)
    lines["units"] = "; ".join(
        f"{unit}: {', '.join(of)}" if len(units) > 1 else unit for unit, of in units.items()
    )
    links = ", ".join(assembly.robot.links) if assembly.robot is not None else ""
    lines["links"] = links + " (its hands; --link names others)" * bool(links and not named)
    places = {
        name: one.at if isinstance(one, LinkPose) else vars(one).get("feature")
        for name, one in assembly.frames.items()
    }
    lines["frames"] = ", ".join(f"{name} ({at or 'given'})" for name, at in places.items())
    stored = [one.key.removeprefix(EVENT) for one in event_features(assembly.layout)]
    found = [f"{name} (looked for)" for name in assembly.events]
    lines["events"] = ", ".join((*stored, *found))
    holds = [
        str(replace(one, begin=round(one.begin, 2), end=round(one.end, 2)))
        for one in kept[0].holds or ()
    ]
    counts = bool(holds) and default and len(kept[0].frames) > 1
    lines["held"] = ", ".join(holds) + " (put onto an object: --operator auto)" * counts
    return {name: text or "none" for name, text in lines.items()}


def _unit(unit: str | Scale) -> str:
    """A unit in words, or as the numbers that turn a stored value into it."""
    if isinstance(unit, Scale):
        return f"{unit.factor:.4g} x value {unit.offset:+.4g} rad or m"
    return "rad or m" if unit == "auto" else unit


def _echo(lines: dict[str, object]) -> None:
    for name, text in lines.items():
        typer.echo(f"{name:<16} {text}")


def _report(learned: Any, read: Any, aligned: Any) -> None:
    skill = getattr(learned, "skill", learned)
    lines: dict[str, object] = {}
    for number, one in enumerate(getattr(learned, "skills", ()), start=1):
        texts = ", ".join(map(format_operator, one.operators))
        lines[f"{'part' if one.begin > skill.begin or number == 1 else 'way'} {number}"] = (
            f"{one.begin:.2f} to {one.end:.2f} s, {len(one.log_weights)} components: {texts}"
        )
    if isinstance(learned, TaskParameterizedGMM):
        lines |= _learning(learned, read, aligned)
    _echo(lines)


def _learning(model: TaskParameterizedGMM, read: Any, aligned: Any) -> dict[str, object]:
    lines: dict[str, object] = {}
    for number, operator in enumerate(model.operators_, start=1):
        size = operator.dimension(model.kinematics_)
        lines[f"operator {number}"] = f"{format_operator(operator)} ({size} coordinates)"
    converged = "converged" if model.converged_ else "not converged: raise --max-iter or --tol"
    lines["components"] = f"{len(model.weights_)} ({model.covariance_type})"
    lines["iterations"] = f"{model.n_iter_}, {converged}"
    if read:
        rows = np.concatenate([one.numpy(force=True) for one in model.rows(aligned)])
        lines["log-likelihood"] = f"{model.score(aligned):.3f} per step"
        lines["BIC"] = f"{model.mixture_.bic(rows):.0f}"
    else:  # scoring would read all episodes once more
        lines["bound of EM"] = f"{model.lower_bound_:.3f} per step"
    return lines

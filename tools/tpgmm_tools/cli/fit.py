"""``tpgmm fit``: learn a model from a data set."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from tpgmm_tools.arguments import options
from tpgmm_tools.arguments.plugins import OWN, model_format

if TYPE_CHECKING:
    from tpgmm_datasets.reader import Recording
    from tpgmm_datasets.units import Scale
    from tpgmm_torch.data.demonstrations import Demonstration
    from tpgmm_torch.data.holds import Hold
    from tpgmm_torch.estimator import TaskParameterizedGMM
    from tpgmm_torch.operators import Operator
    from tpgmm_torch.robots.kinematics import Kinematics
    from tpgmm_torch.structure.choices import Choices


app = typer.Typer()

EXAMPLE = (
    "tpgmm fit out/demo/dataset --robot upper_body --link l_hand --link r_hand --frame bottle "
    "--n-components 30 --out out/model"
)


@dataclass(frozen=True)
class ModelOptions:
    """Learning.

    Parameters
    ----------
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
    covariance_type : ``NAME``
        Shape of the local covariances: full, diag, tied or spherical.
    reg_covar : float
        Added to the diagonal of the covariances, relative to the variance of each coordinate.
    covariance_shrinkage : ``auto | NUMBER``
        How far the full or tied covariances given time go towards their diagonals after EM,
        from 0 to 1; slopes over time stay as they are.
    responsibilities : ``NAME``
        Of which each point of each demonstration has its own ('point'), or all demonstrations
        at one instant the same ('instant'): 'auto' takes these where they share one clock.
    init_params : ``NAME``
        How EM starts: time (equal bins of the time axis), kmeans or random.
    n_init : int
        Number of starts; the most likely result is kept.
    max_iter : int
        Largest number of EM iterations.
    tol : float
        EM stops when the mean log-likelihood gains less.
    dtype : ``NAME``
        float64 or float32.
    device : str
        Where tensors live, as torch spells it.
    """

    n_components: Any = 10
    parts: str | None = None
    modes: Any = 1
    random_state: int = 0
    fusion: Literal["information", "covariance"] = "information"
    epsilon: float = 1e-4
    covariance_type: str = "full"
    reg_covar: float = 1e-5
    covariance_shrinkage: Any = "auto"
    responsibilities: str = "auto"
    init_params: str = "time"
    n_init: int = 1
    max_iter: int = 100
    tol: float = 1e-3
    dtype: str = "float64"
    device: str = "cpu"

    def choices(self, operators: bool) -> Choices:
        """Return what is to be found; with ``operators``, these too."""
        from tpgmm_torch.structure.choices import Choices, parse_parts

        automatic = self.n_components == "auto"
        return Choices(operators, automatic, parse_parts(self.parts), self.modes)

    def model(self, operators: Sequence[Any], robot: Kinematics | None) -> TaskParameterizedGMM:
        """Make the model, not yet fitted."""
        from tpgmm_torch.constraints import check_parameters
        from tpgmm_torch.estimator import TaskParameterizedGMM
        from tpgmm_torch.regression.fusion_forms import CovarianceFusion, InformationFusion

        printed = self.fusion == "covariance"
        known = signature(TaskParameterizedGMM).parameters
        settings = {name: given for name, given in asdict(self).items() if name in known}
        settings["fusion"] = CovarianceFusion(self.epsilon) if printed else InformationFusion()
        if self.n_components == "auto":
            settings["n_components"] = 10
        model = TaskParameterizedGMM(operators=operators, robot=robot, **settings)
        check_parameters(model)
        return model


@options.command(app, EXAMPLE)
def fit(
    dataset: str,
    *,
    out: Path,
    described: options.RobotOptions,
    data: options.DataOptions,
    settings: ModelOptions,
    format_: str = OWN,
    plausibility: Literal["warn", "error", "ignore"] = "warn",
    alignment: options.Alignments = "dtw",
    batch_episodes: int | None = None,
    operator: list[str] | None = None,
    hold: list[str] | None = None,
    robust: bool = True,
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
    robust : bool
        Leave out episodes that are unlike the others where these agree, with a warning.
    """
    from tpgmm_datasets.episode_batches import EpisodeBatches
    from tpgmm_datasets.signals import Signals
    from tpgmm_torch.exceptions import PlausibilityWarning
    from tpgmm_torch.mixture.processes import joined_processes
    from tpgmm_torch.persistence import save
    from tpgmm_torch.structure import choices as structure

    write = model_format(format_)
    choices = settings.choices(operator == ["auto"])
    choices.check(batch_episodes)
    action: Any = "always" if plausibility == "warn" else plausibility
    warnings.filterwarnings(action, "", PlausibilityWarning)
    robot, holds = described.read(), _parse_holds(hold)
    operators = _parse_operators(operator)
    model = settings.model(operators, robot)
    recording = data.open(dataset, robot)
    model.robot = robot = recording.assembly.robot
    about = data.arguments(robot)
    size = batch_episodes
    batched = None if size is None else partial(EpisodeBatches, dataset, size, **about)
    with joined_processes() as processes:
        read = list(recording.demonstrations()) if batched is None else []
        first, fitted = _align(read, batched, alignment, robot)
        frames = list(first[0].frames)
        model.operators = structure.operators_or_default(operators, robot, frames)
        kept = structure.prepare_demonstrations(first, model.operators, robot, robust, holds)
        if processes.rank == 0:
            _echo(_sum_up_episodes(recording, read, kept))
            _echo(_sum_up_recording(recording, kept, described.link, not operator))
        episodes: Any = processes.share(kept)
        if batched is not None:
            batches = batched(processes=processes)
            episodes = _Aligned(batches, fitted, kept[0].holds or ())
        learned, reports = structure.learn(model, episodes, choices, processes)
        if processes.rank > 0:
            return
    if write is None:
        save(learned, out)
    else:
        write(learned, out, Signals.of(dataset, **about))
    _report(learned, read, kept, reports)
    if processes.count > 1:
        typer.echo(f"processes        {processes.count}")
    typer.echo(f"saved            {out}")
    typer.echo(f"next             tpgmm report {out} --dataset {dataset}")


def _parse_operators(texts: list[str] | None) -> list[Operator]:
    """Parse the option --operator; empty if they are to be found, or the default."""
    from tpgmm_torch.operators.text import parse_operator

    return [parse_operator(text) for text in texts or () if text != "auto"]


def _parse_holds(texts: list[str] | None) -> tuple[Hold, ...] | None:
    """Parse the option --hold; None if holds are to be found."""
    from tpgmm_torch.data.holds import Hold

    if not texts:
        return None
    return () if texts == ["none"] else tuple(map(Hold.parse, texts))


class _Aligned:
    """Batches of episodes, aligned as they are read.

    Parameters
    ----------
    batches, alignment, holds : EpisodeBatches, Alignment or None, tuple of Hold
        What is read; and how, as the first of all batches decided.
    """

    def __init__(self, batches: Any, alignment: Any, holds: tuple[Hold, ...]) -> None:
        self.batches, self.alignment, self.holds = batches, alignment, holds

    def __iter__(self) -> Iterator[list[Demonstration]]:
        """Read and align each batch."""
        from tpgmm_torch.training.hold_detection import with_holds

        for batch in self.batches:
            aligned = self.alignment.transform(batch) if self.alignment else batch
            yield with_holds(aligned, self.holds)


def _align(
    read: list[Demonstration], batched: Any, method: str, robot: Kinematics | None
) -> tuple[list[Demonstration], Any]:
    """Align all that was read, or else the first batch; and return what aligns the others."""
    from tpgmm_torch.structure.choices import aligner

    if batched is None:
        return options.align(read, method, robot), None
    first, alignment = next(iter(batched())), aligner(method, robot)
    return alignment.fit(first).transform(first) if alignment else first, alignment


def _sum_up_episodes(recording: Recording, read: Any, kept: Any) -> dict[str, str]:
    """Sum up how many episodes there are; nothing of batches."""
    if not read:
        return {}
    seconds, steps = [one.duration for one in read], sum(map(len, kept))
    lost = len(recording.episodes) - len(kept) or "none"
    text = f"{len(read)} of {min(seconds):.2f} to {max(seconds):.2f} s, {steps} steps after"
    return {"demonstrations": f"{text} alignment; {lost} left out"}


def _sum_up_recording(
    recording: Recording, kept: Any, named: list[str] | None, default: bool
) -> dict[str, str]:
    """Sum up the data set and the robot, before anything is learned."""
    from tpgmm_datasets.lerobot.columns import EVENT
    from tpgmm_datasets.lerobot.stored_signals import event_features

    assembly, joints = recording.assembly, recording.assembly.joints
    robot = assembly.robot
    names = joints.names or () if robot is None else robot.joint_names
    links = "" if robot is None else ", ".join(robot.links)
    places = (f"{name} ({_place(one)})" for name, one in assembly.frames.items())
    stored = [one.key.removeprefix(EVENT) for one in event_features(assembly.layout)]
    found = [f"{name} (looked for)" for name in assembly.events]
    lines = {
        "joints": f"{kept[0].n_joints} of {joints.feature.key}: {', '.join(names)}",
        "units": _sum_up_units(joints, names),
        "links": links + " (its hands; --link names others)" * bool(links and not named),
        "frames": ", ".join(places),
        "events": ", ".join((*stored, *found)),
        "held": _sum_up_holds(kept[0], default),
    }
    return {name: text or "none" for name, text in lines.items()}


def _sum_up_holds(shown: Demonstration, default: bool) -> str:
    """Sum up what is held, and what may follow from it for the operators."""
    rounded = [
        replace(h, begin=round(h.begin, 2), end=round(h.end, 2)) for h in shown.holds or ()
    ]
    counts = bool(rounded) and default and len(shown.frames) > 1
    return ", ".join(map(str, rounded)) + " (put onto an object: --operator auto)" * counts


def _place(frame: Any) -> str:
    """Return where a frame's poses come from."""
    return getattr(frame, "at", None) or getattr(frame, "feature", None) or "given"


def _sum_up_units(joints: Any, names: Sequence[str]) -> str:
    """Sum up the units, with their joints where there are several."""
    units: dict[str, list[str]] = {}
    for name, unit in zip(joints.names or ("all",), joints.units, strict=False):
        if name in names or not names:
            units.setdefault(_describe_unit(unit), []).append(name)
    several = len(units) > 1
    return "; ".join(f"{u}: {', '.join(of)}" if several else u for u, of in units.items())


def _describe_unit(unit: str | Scale) -> str:
    """Describe a unit in words, or by the numbers that turn a stored value into it."""
    if not isinstance(unit, str):
        return f"{unit.factor:.4g} x value {unit.offset:+.4g} rad or m"
    return "rad or m" if unit == "auto" else unit


def _echo(lines: dict[str, str]) -> None:
    for name, text in lines.items():
        typer.echo(f"{name:<16} {text}")


def _report(learned: Any, read: Any, aligned: Any, reports: list[str]) -> None:
    from tpgmm_torch.estimator import TaskParameterizedGMM
    from tpgmm_torch.operators.text import format_operator

    skill = getattr(learned, "skill", learned)
    lines: dict[str, str] = {}
    for number, one in enumerate(getattr(learned, "skills", ()), start=1):
        texts = ", ".join(map(format_operator, one.operators))
        lines[f"{'part' if one.begin > skill.begin or number == 1 else 'way'} {number}"] = (
            f"{one.begin:.2f} to {one.end:.2f} s, {len(one.log_weights)} components: {texts}"
        )
    if isinstance(learned, TaskParameterizedGMM):
        lines |= _sum_up_model(learned, read, aligned)
    gaps, robot = getattr(skill, "gaps", None), skill.kinematics
    if gaps is not None:
        lines["servos"] = gaps.describe(robot.joint_names, robot.lengths)
    _echo(lines)
    for text in reports:
        typer.echo(f"\n{text}\n")


def _sum_up_model(model: TaskParameterizedGMM, read: Any, aligned: Any) -> dict[str, str]:
    import numpy as np

    from tpgmm_torch.operators.text import format_operator

    lines: dict[str, str] = {}
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

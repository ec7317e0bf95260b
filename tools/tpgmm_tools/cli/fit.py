"""``tpgmm fit``: learn a model from a data set."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import typer

from tpgmm_datasets.episode_batches import EpisodeBatches
from tpgmm_datasets.reader import load_lerobot
from tpgmm_datasets.signals import Signals
from tpgmm_tools.cli import options
from tpgmm_tools.cli.plugins import OWN, model_format
from tpgmm_torch.constraints import check_parameters
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.large_data.processes import joined_processes
from tpgmm_torch.multimodal import MultimodalTaskParameterizedGMM
from tpgmm_torch.operators.text import default_operators, format_operator, parse_operator
from tpgmm_torch.structure.parts import parse_parts

__all__ = ["app"]

app = typer.Typer()

EXAMPLE = (
    "tpgmm fit out/demo/dataset --robot upper_body --link l_hand --link r_hand --frame bottle "
    "--n-components 30 --out out/model"
)
#: Parameters of the model that have an option below, or none.
OTHERS = (
    "n_components", "operators", "robot", "parts", "holds", "operator_weights", "plausibility",
    "random_state", "warm_start", "verbose",
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
        For sets larger than memory: read so many episodes at a time. The first decide on the
        common clock. Default: all at once.
    operator : str
        What is learned together, repeatable: 'canonical' (the joints), 'position:LINK@FRAME',
        'orientation:LINK@FRAME', 'pose:LINK@FRAME' (both), without @FRAME in the base frame;
        FRAME may be another link, or held:FRAME an object as it is carried, which LINK may be
        too; 'canonical:left_*' some joints; '+' stacks. 'auto' finds what matters and says why.
        Default: the poses of all links in all frames, stacked, and canonical.
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
        In how many ways the skill is done, each a model of its own; 'auto' finds it. 'tpgmm
        reproduce' takes several as a whole, all else one of them, DIR/mode_0; a policy holds
        them all.
    random_state : int
        Seed of what is random.
    """
    write = model_format(format_)
    if modes != 1 and batch_episodes is not None:
        raise DataError("--modes compares all episodes: it goes without --batch-episodes")
    options.filter_plausibility(plausibility)
    robot = described.read()
    holds = None if hold == ["none"] else [Hold.parse(text) for text in hold or ()]
    model = TaskParameterizedGMM(
        n_components,
        "auto" if operator == ["auto"] else [parse_operator(text) for text in operator or ()],
        robot,
        parts=parse_parts(parts),
        holds=holds if hold else "auto",
        plausibility=plausibility,
        random_state=random_state,
        **settings,
    )
    check_parameters(model)
    given = data.arguments(robot)
    with joined_processes() as processes:
        episodes: Any
        if batch_episodes is None:
            read = load_lerobot(dataset, **given)
            aligned = options.align(read, alignment, robot)
            frames, episodes = read[0].frames, processes.share(aligned)
        else:
            first = next(iter(EpisodeBatches(dataset, batch_episodes, **given)))
            read, aligned, frames = [], [], first[0].frames
            batches = EpisodeBatches(dataset, batch_episodes, processes=processes, **given)
            episodes = Aligned(batches, options.aligner(alignment, robot), first)
        if not model.operators:
            links = robot.links if robot is not None else ()
            model.operators = default_operators(links, list(frames))
        if modes == 1:
            model.fit(episodes, processes=processes)
        elif processes.count > 1:
            raise DataError("--modes compares all episodes with each other, in one process")
        else:
            ways = MultimodalTaskParameterizedGMM(model, modes).fit(aligned)
            assert ways.mode_selection_ is not None
            typer.echo(f"{ways.mode_selection_.report()}\n")
            model = ways if ways.n_modes_ > 1 else ways.models_[0]
        if processes.rank > 0:
            return
    if write is None:
        model.save(out)
    else:
        write(model, out, Signals.of(dataset, **given))
    if isinstance(model, TaskParameterizedGMM):
        _report(model, read, aligned)
    if processes.count > 1:
        typer.echo(f"processes        {processes.count}")
    typer.echo(f"saved            {out}")


class Aligned:
    """Batches of episodes, aligned as they are read.

    Parameters
    ----------
    batches : EpisodeBatches
        To read.
    alignment : Alignment, Pipeline or None
        Fitted to the first of all batches.
    first : sequence of Demonstration
        That batch.
    """

    def __init__(self, batches: EpisodeBatches, alignment: Any, first: Any) -> None:
        self.batches, self.alignment = batches, alignment and alignment.fit(first)

    def __iter__(self) -> Iterator[Any]:
        """Read and align each."""
        for batch in self.batches:
            yield self.alignment.transform(batch) if self.alignment else batch


def _report(model: TaskParameterizedGMM, read: Any, aligned: Any) -> None:
    kinematics = model.kinematics_
    lines: dict[str, object] = {}
    if read:
        seconds = [one.duration for one in read]
        lines["demonstrations"] = (
            f"{len(read)} of {min(seconds):.2f} to {max(seconds):.2f} s, "
            f"{sum(map(len, aligned))} steps after alignment"
        )
    lines["joints"] = kinematics.n_joints
    lines["links"] = ", ".join(kinematics.links) or "none"
    lines["frames"] = ", ".join(model.frame_names_) or "none"
    for number, operator in enumerate(model.operators_, start=1):
        size = operator.dimension(kinematics)
        lines[f"operator {number}"] = f"{format_operator(operator)} ({size} coordinates)"
    for number, part in enumerate(model.parts_, start=1):
        texts = ", ".join(map(format_operator, part.operators))
        lines[f"part {number}"] = (
            f"{part.begin:.2f} to {part.end:.2f} s, {part.n_components} components: {texts}"
        )
    for hold in model.holds_:
        lines[f"{hold.frame} held"] = hold
    converged = "converged" if model.converged_ else "not converged: raise --max-iter or --tol"
    lines["components"] = f"{model.n_components_} ({model.covariance_type})"
    lines["iterations"] = f"{model.n_iter_}, {converged}"
    if read:
        lines["log-likelihood"] = f"{model.score(aligned):.3f} per step"
        lines["BIC"] = f"{model.bic(aligned):.0f}"
    else:  # scoring would read all episodes once more
        lines["bound of EM"] = f"{model.lower_bound_:.3f} per step"
    for name, text in lines.items():
        typer.echo(f"{name:<16} {text}")
    selections = model.operator_selection_ or ()
    found = [model.segmentation_] if model.segmentation_ is not None else []
    for selection in [*found, *(selections if isinstance(selections, tuple) else [selections])]:
        typer.echo(f"\n{selection.report()}\n")

"""``tpgmm fit``: learn a model from a data set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tpgmm_tools.cli import options
from tpgmm_tools.cli.plugins import OWN, model_format

if TYPE_CHECKING:
    from tpgmm_torch.data.demonstrations import Demonstration
    from tpgmm_torch.estimator import TaskParameterizedGMM

__all__ = ["app"]

app = typer.Typer()

EXAMPLE = (
    "Example: tpgmm fit out/demo/dataset --robot upper_body --link l_hand --link r_hand "
    "--frame bottle --n-components 30 --out out/model"
)
learning = options.in_panel("Learning")
reproducing = options.in_panel("Reproduction (saved with the model)")


@app.command(epilog=EXAMPLE)
def fit(
    dataset: options.Dataset,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the model goes.")],
    output_format: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="tpgmm | lerobot",
            help="'tpgmm' for Python and the other commands here; 'lerobot' for a policy that "
            "lerobot-eval and lerobot-rollout take, if lerobot_policy_tpgmm is installed.",
        ),
    ] = OWN,
    robot: options.RobotFile = None,
    link: options.Links = None,
    robot_joint: options.RobotJoints = None,
    coordinate: options.Coordinates = None,
    poses: Annotated[
        list[str] | None,
        options.of_robot(
            "Instead of a robot: a tracked body whose pose the data set holds, repeatable.",
            metavar="NAME",
        ),
    ] = None,
    frame: options.Frames = None,
    event: options.Events = None,
    episodes: options.Episodes = None,
    units: options.Units = None,
    joints: options.Joints = None,
    joint_name: options.JointNames = None,
    rate: options.Rate = None,
    plausibility: options.Plausibility = "warn",
    alignment: options.AlignmentMethod = "dtw",
    batch_episodes: Annotated[
        int | None,
        options.of_data(
            "For sets larger than memory: read so many episodes at a time. The first N "
            "decide on the common clock. Default: all at once.",
            min=1,
            metavar="N",
        ),
    ] = None,
    operator: Annotated[
        list[str] | None,
        learning(
            "What is learned together, repeatable: 'canonical' (the joints), "
            "'position:LINK@FRAME', 'orientation:LINK@FRAME', 'pose:LINK@FRAME' (both), "
            "without @FRAME in the base frame; FRAME may be another link, or held:FRAME an "
            "object as it is carried, which LINK may be too; 'canonical:left_*' some joints; "
            "'+' stacks. 'auto' finds what matters and says why. "
            "Default: the poses of all links in all frames, stacked, and canonical."
        ),
    ] = None,
    hold: Annotated[
        list[str] | None,
        learning(
            "When a link holds an object, repeatable: FRAME@LINK:BEGIN-END in seconds, as in "
            "'bottle@l_hand:4.3-' to the end; or 'none'. Default: found in episodes whose "
            "frames were recorded over time."
        ),
    ] = None,
    operator_weights: Annotated[
        Literal["equal", "held-out"],
        learning(
            "How much operators count: all alike, or as much as makes episodes that are left "
            "out most likely."
        ),
    ] = "equal",
    n_components: Annotated[
        Any,
        learning(
            "K, the number of Gaussians; 'auto' finds it by the likelihood of episodes that "
            "are left out.",
            parser=options.count_or_auto,
            metavar="auto | INTEGER",
        ),
    ] = 10,
    parts: Annotated[
        str | None,
        learning(
            "Where the skill has parts that are learned one by one, each with its share of "
            "--n-components and, with --operator auto, what matters in it: 'auto' finds and "
            "explains them; or when they end, as seconds and events joined by commas. "
            "See --alignment parts.",
            metavar="auto | 4.2,8.1 | grasp,rest",
        ),
    ] = None,
    covariance_type: Annotated[
        Literal["full", "diag", "tied", "spherical"], learning("Shape of the covariances.")
    ] = "full",
    reg_covar: Annotated[
        float,
        learning(
            "Added to the covariances' diagonal, relative to each coordinate's variance.", min=0
        ),
    ] = 1e-5,
    covariance_shrinkage: Annotated[
        str,
        learning(
            "How far full or tied covariances go towards their diagonals, 0 to 1; 'auto' "
            "follows the number of episodes.",
            metavar="auto | FLOAT",
        ),
    ] = "auto",
    tol: Annotated[
        float, learning("Stop when the mean log-likelihood gains less.", min=0)
    ] = 1e-3,
    max_iter: Annotated[int, learning("Largest number of iterations.", min=1)] = 100,
    n_init: Annotated[int, learning("Starts, of which the best counts.", min=1)] = 1,
    init_params: Annotated[
        Literal["time", "kmeans", "random"],
        learning("How to start; 'time' cuts equal bins."),
    ] = "time",
    responsibilities: Annotated[
        Literal["auto", "instant", "point"],
        learning(
            "Whether a component takes all demonstrations at an instant, or each point "
            "by itself; 'auto' is 'instant' after alignment."
        ),
    ] = "auto",
    robust: Annotated[
        bool,
        learning(
            "Leave out episodes that are unlike the others where these agree, with a warning."
        ),
    ] = True,
    keep_demonstrations: Annotated[
        bool,
        learning(
            "Save what 'tpgmm correct' needs of the episodes with the model, 8 bytes for each "
            "step and coordinate; not with --batch-episodes or --format lerobot."
        ),
    ] = False,
    modes: Annotated[
        Any,
        learning(
            "In how many ways the skill is done, each a model of its own; 'auto' finds it. "
            "'tpgmm reproduce' takes several as a whole, all else one of them, DIR/mode_0; a "
            "policy holds them all.",
            parser=options.count_or_auto,
            metavar="auto | INTEGER",
        ),
    ] = 1,
    random_state: Annotated[int, learning("Seed of what is random.")] = 0,
    checkpoint: Annotated[
        Path | None,
        learning(
            "Keep the state of EM there, and go on from it if it is of the same data and "
            "settings.",
            metavar="DIR",
        ),
    ] = None,
    checkpoint_every: Annotated[
        int, learning("Iterations from one state kept to the next.", min=1)
    ] = 10,
    fusion: Annotated[
        Literal["information", "covariance"],
        reproducing(
            "Form of the product of Gaussians; 'covariance' is the paper's, as printed."
        ),
    ] = "information",
    activation: Annotated[
        Literal["time", "product"], reproducing("Where mixing weights come from.")
    ] = "time",
    epsilon: Annotated[
        float, reproducing("Regulariser of --fusion covariance, rad^2.", min=0)
    ] = 1e-4,
    blend: Annotated[
        float,
        reproducing(
            "Seconds over which the start posture leads into the model's reference.", min=0
        ),
    ] = 1.0,
) -> None:
    """Learn a skill from a LeRobot data set.

    Episodes are aligned in time, described by operators (links seen from frames, and joints),
    and learned as one Gaussian mixture over all of them. The model is a folder of JSON and
    safetensors that 'tpgmm reproduce' and 'tpgmm plot' take. Several processes learn together
    under torchrun.
    """
    from tpgmm_tools.cli.training_data import read_training_data
    from tpgmm_torch.data.holds import Hold
    from tpgmm_torch.estimator import TaskParameterizedGMM
    from tpgmm_torch.exceptions import DataError
    from tpgmm_torch.large_data.checkpoints import Checkpoint
    from tpgmm_torch.large_data.processes import joined_processes
    from tpgmm_torch.multimodal import MultimodalTaskParameterizedGMM
    from tpgmm_torch.operators.text import default_operators, parse_operator
    from tpgmm_torch.structure.parts import parse_parts

    write = model_format(output_format)
    if keep_demonstrations and (write is not None or batch_episodes is not None):
        raise DataError(
            "--keep-demonstrations is for the format 'tpgmm', without --batch-episodes; 'tpgmm "
            "correct' makes the policy of it"
        )
    together = batch_episodes is None and checkpoint is None and not keep_demonstrations
    if modes != 1 and not together:
        raise DataError(
            "--modes compares all episodes with each other: it goes without --batch-episodes, "
            "--checkpoint and --keep-demonstrations"
        )
    operators: Any = "auto"
    if operator != ["auto"]:
        operators = [parse_operator(text) for text in operator or ()]
    given = None if hold == ["none"] else [Hold.parse(text) for text in hold or ()]
    kinematics = options.read_robot(robot, link, robot_joint, coordinate, poses)
    recordings = options.recordings(
        dataset,
        kinematics,
        frame,
        event,
        episodes,
        units,
        joints,
        joint_name,
        rate,
        plausibility,
    )
    links = kinematics.links if kinematics is not None else ()
    state = None if checkpoint is None else Checkpoint(checkpoint, checkpoint_every)
    kept = 0 if state is None else state.n_iter()
    with joined_processes() as processes:
        data = read_training_data(recordings, kinematics, alignment, batch_episodes, processes)
        model = TaskParameterizedGMM(
            n_components,
            operators or default_operators(links, list(data.frames)),
            kinematics,
            parts=parse_parts(parts),
            holds=given if hold else "auto",
            operator_weights=operator_weights,
            covariance_type=covariance_type,
            reg_covar=reg_covar,
            covariance_shrinkage=options.number_or_auto(covariance_shrinkage),
            tol=tol,
            max_iter=max_iter,
            n_init=n_init,
            init_params=init_params,
            responsibilities=responsibilities,
            robust=robust,
            random_state=random_state,
            fusion=fusion,
            activation=activation,
            epsilon=epsilon,
            blend=blend,
            plausibility=plausibility,
        )
        if modes == 1:
            model.fit(data.source, checkpoint=state, processes=processes)
        elif processes.count > 1:
            raise DataError("--modes compares all episodes with each other, in one process")
        else:
            ways = MultimodalTaskParameterizedGMM(model, modes).fit(data.aligned)
            assert ways.mode_selection_ is not None
            typer.echo(f"{ways.mode_selection_.report()}\n")
            if ways.n_modes_ > 1:
                folders = ""
                if write is None:
                    ways.save(out)
                    folders = f", with mode_0 to mode_{ways.n_modes_ - 1}"
                else:
                    write(ways, out, recordings.signals())
                typer.echo(f"saved            {out}{folders}")
                return
            [model] = ways.models_
        durations, steps = data.summary(processes)
        if processes.rank > 0:
            return
    if write is None:
        model.save(out, demonstrations=keep_demonstrations)
    else:
        write(model, out, recordings.signals())
    _report(model, durations, steps, data.aligned)
    if model.segmentation_ is not None:
        typer.echo(f"\n{model.segmentation_.report()}")
    selections = model.operator_selection_ or ()
    for selection in selections if isinstance(selections, tuple) else (selections,):
        typer.echo(f"\n{selection.report()}")
    if model.segmentation_ is not None or selections:
        typer.echo()
    if kept:
        typer.echo(f"resumed          {checkpoint}, after {kept} iterations")
    if processes.count > 1:
        typer.echo(f"processes        {processes.count}")
    typer.echo(f"saved            {out}")


def _report(
    model: TaskParameterizedGMM,
    durations: Sequence[float],
    steps: int,
    aligned: Sequence[Demonstration],
) -> None:
    from tpgmm_torch.operators.text import format_operator

    kinematics = model.kinematics_
    converged = "converged" if model.converged_ else "not converged: raise --max-iter or --tol"
    lines = {
        "demonstrations": f"{len(durations)} of {min(durations):.2f} to "
        f"{max(durations):.2f} s, {steps} steps after alignment",
        "joints": f"{kinematics.n_joints}",
        "links": ", ".join(kinematics.links) or "none",
        "frames": ", ".join(model.frame_names_) or "none",
    }
    for number, operator in enumerate(model.operators_, start=1):
        size = operator.dimension(kinematics)
        lines[f"operator {number}"] = f"{format_operator(operator)} ({size} coordinates)"
    for number, part in enumerate(model.parts_, start=1):
        texts = ", ".join(map(format_operator, part.operators))
        lines[f"part {number}"] = (
            f"{part.begin:.2f} to {part.end:.2f} s, {part.n_components} components: {texts}"
        )
    for hold in model.holds_:
        end = "the end" if math.isinf(hold.end) else f"{hold.end:.2f} s"
        shown = f"{max(hold.begin, 0.0):.2f} s to {end} (in {hold.share:.0%} of them)"
        lines[f"{hold.frame} held"] = f"by {hold.link} from {shown}"
    lines |= {
        "components": f"{model.n_components_} ({model.covariance_type})",
        "iterations": f"{model.n_iter_}, {converged}",
    }
    if aligned:
        lines["log-likelihood"] = f"{model.score(aligned):.3f} per step"
        lines["BIC"] = f"{model.bic(aligned):.0f}"
    else:  # they are on disk, and would have to be read once more
        lines["bound of EM"] = f"{model.lower_bound_:.3f} per step"
    for name, value in lines.items():
        typer.echo(f"{name:<16} {value}")

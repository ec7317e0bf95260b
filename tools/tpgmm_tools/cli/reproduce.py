"""``tpgmm reproduce``: the motions of a model in new situations."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tpgmm_tools.arguments import options

if TYPE_CHECKING:
    from tpgmm_control.obstacles import Scene
    from tpgmm_torch.data.demonstrations import Situation
    from tpgmm_torch.data.trajectories import Trajectory
    from tpgmm_torch.robots.kinematics import Kinematics


app = typer.Typer()

FORMATS = (".parquet", ".csv")
#: Exit code where something touches an obstacle; errors have 2.
COLLIDES = 3
EXAMPLE = (
    "tpgmm reproduce out/model --dataset out/demo/dataset --episodes 0:3 "
    "--out out/reproductions.csv"
    "\n\n"
    'A file of situations: [{"joints": {"elbow": 0.3, ...}, "frames": {"bottle": '
    '{"position": [0.3, 0, 0.1], "orientation": [1, 0, 0, 0]}}}, ...]; joints may also be a '
    "list in the model's order."
)


@options.command(app, EXAMPLE)
def reproduce(
    model: Path,
    *,
    out: Path,
    data: options.DataOptions,
    situations: Path | None = None,
    dataset: str | None = None,
    via: list[str] | None = None,
    fade: float = 1.0,
    blend: float = 1.0,
    obstacles: Path | None = None,
    visuals: bool = False,
) -> None:
    """Reproduce a skill in new situations.

    Writes joint references over time and their covariance: a table with one row per time step,
    as tpgmm_datasets.tables.demonstrations_from_frame reads it back. Prints a line per
    situation.

    Parameters
    ----------
    model : ``DIR``
        A model that 'tpgmm fit' saved.
    out : ``FILE``
        Where they go: .parquet or .csv.
    situations : ``FILE.json``
        Situations: start postures and frames.
    dataset : str
        Or a LeRobot data set: the situations of its episodes.
    via : ``VIA``
        A via-point, repeatable: TIME:OPERATOR=NUMBERS~TOLERANCE, as in
        3.2:position:l_hand@bottle=0,0,0.1 or 3.2:canonical=l_elbow:0.4.
    fade : float >= 0.001
        Seconds before and after a via-point that it changes.
    blend : float >= 0
        Seconds in which the start posture leads into the motion.
    obstacles : ``FILE.xml``
        An MJCF with what stands around: says what touches what, from when on and how deep, and
        ends with exit code 3 if anything does. Pairs that come near each other in the data set,
        or that an <exclude> names, are allowed, and listed.
    visuals : bool
        With --obstacles, take the robot's visual geometry where it has no collision geometry.
    """
    from tpgmm_control.loop.rollout import rollout
    from tpgmm_torch.exceptions import UnknownNameError
    from tpgmm_torch.persistence import load_skill
    from tpgmm_torch.skills.via_points import ViaPoints

    if out.suffix not in FORMATS:
        raise options.refuse(f"--out ends in one of {list(FORMATS)}, got {str(out)!r}")
    if (situations is None) == (dataset is None):
        raise options.refuse("give either --situations FILE.json or --dataset DATASET")
    skill = load_skill(model, device="cpu")
    kinematics = skill.kinematics
    wanted, shown = options.read_situations(situations, dataset, data, kinematics)
    if via:
        skill = ViaPoints(skill, via, fade)
    try:
        trajectories = rollout(skill, wanted, bounds="robot", blend=blend)
    except UnknownNameError as error:
        if error.kind != "frame" or dataset is None:
            raise
        raise options.refuse(
            f"{error}. Say where it is in the data set, as to 'tpgmm fit': --frame "
            f"{error.name}=FEATURE or --frame {error.name}=LINK@EVENT"
        ) from error
    _write(trajectories, wanted, out)
    descriptions = [_describe(one, kinematics) for one in trajectories]
    for number, text in [*enumerate(descriptions), *enumerate(_choose_ways(skill, wanted))]:
        typer.echo(f"{number:>4}  {text}")
    typer.echo(f"written to {out}")
    if obstacles is not None:
        scene = options.read_obstacles(obstacles, skill, visuals, shown)
        _report_contacts(scene, trajectories, wanted, skill.holds)


def _write(motions: list[Trajectory], situations: list[Situation], out: Path) -> None:
    from tpgmm_datasets.tables import trajectories_to_frame, write_table

    pairs = zip(motions, situations, strict=True)
    frames = [situation.frames_at(one.time.cpu()) for one, situation in pairs]
    write_table(trajectories_to_frame(motions, frames), out)


def _choose_ways(skill: Any, situations: list[Situation]) -> Iterator[object]:
    """Choose a way in each situation, if the skill has several."""
    from tpgmm_torch.skills.situations import at_first
    from tpgmm_torch.skills.ways import Ways

    for one in situations if isinstance(skill, Ways) else ():
        situation = one.reorder(skill.kinematics.joint_names)
        yield from skill.choose(situation.joints, at_first(situation))


def _report_contacts(scene: Scene, *motions: Any) -> None:
    """Print what touches obstacles; end with an exit code of its own if anything does."""
    from tpgmm_tools.report import contacts

    found = list(contacts(scene, *motions))
    for number, contact in found:
        typer.echo(f"{number:>4}  {contact}")
    if found:
        raise typer.Exit(COLLIDES)
    typer.echo("nothing touches")


def _describe(trajectory: Trajectory, kinematics: Kinematics) -> str:
    from tpgmm_torch.metrics import largest_acceleration, largest_speeds

    joints, tolerance = trajectory.joints, 1e-6
    speed = largest_speeds(trajectory)
    beyond = (kinematics.lower - joints).maximum(joints - kinematics.upper).amax(0)
    fast = speed > kinematics.velocity * (1 + tolerance)
    problems = []
    for name, by, too_fast in zip(trajectory.joint_names, beyond, fast, strict=True):
        if by > tolerance:
            problems.append(f"{name} beyond its limit by {float(by):.3g} rad")
        elif too_fast:
            problems.append(f"{name} faster than its limit")
    novelty = trajectory.novelty
    return (
        f"{float(trajectory.time[-1] - trajectory.time[0]):6.2f} s  "
        f"speed <= {float(speed.max()):.3g} rad/s  "
        f"acceleration <= {largest_acceleration(trajectory):.3g} rad/s^2  "
        f"{', '.join(problems) or 'within limits'}"
        f"{'' if novelty is None else f'  novelty {novelty:.2g}'}"
    )

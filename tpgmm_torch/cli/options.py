"""Options that several commands share, and what their texts mean."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tpgmm_torch.cli import plugins

if TYPE_CHECKING:
    from tpgmm_torch.alignment.base import Alignment
    from tpgmm_torch.data.demonstrations import Demonstration
    from tpgmm_torch.robots.kinematics import Kinematics

__all__ = [
    "align",
    "aligner",
    "read_robot",
    "recordings",
]

DATA, ROBOT = "Data set", "Robot"
ENVIRONMENT = "observation.environment_state"
Dataset = Annotated[str, typer.Argument(help="A LeRobot data set: its folder, or its hub id.")]
Model = Annotated[Path, typer.Argument(metavar="DIR", help="A model that 'tpgmm fit' saved.")]
Frames = Annotated[
    list[str] | None,
    typer.Option(
        "--frame",
        metavar="NAME[=SOURCE]",
        rich_help_panel=DATA,
        help="An object's pose, repeatable: NAME (found by the names in "
        f"{ENVIRONMENT}), NAME=FEATURE, NAME=FEATURE\\[7:14], or NAME=LINK@EVENT, where a "
        "link of the robot is at an event. Default: all poses that the set names.",
    ),
]
Episodes = Annotated[
    str | None,
    typer.Option(
        metavar="0:10 | 0,3,5 | TASK",
        rich_help_panel=DATA,
        help="Which episodes; default all.",
    ),
]
Units = Annotated[
    list[str] | None,
    typer.Option(
        metavar="[JOINT=]UNIT",
        rich_help_panel=DATA,
        help="Unit of the stored joints: rad, deg, m, mm or raw; with JOINT= of one of them, "
        "repeatable. Default: as the set declares.",
    ),
]
Joints = Annotated[
    str | None,
    typer.Option(
        metavar="FEATURE",
        rich_help_panel=DATA,
        help="The feature that holds the joints; default observation.state or the like.",
    ),
]
Rate = Annotated[
    float | None,
    typer.Option(min=1e-3, rich_help_panel=DATA, help="Resample to so many steps per second."),
]
RobotFile = Annotated[
    str | None,
    typer.Option(
        metavar="URDF",
        rich_help_panel=ROBOT,
        help="The robot's URDF file; 'upper_body' is the one that comes with the package. "
        "Without a robot, joints alone.",
    ),
]
Links = Annotated[
    list[str] | None,
    typer.Option(rich_help_panel=ROBOT, help="A link of interest (a hand), repeatable."),
]
RobotJoints = Annotated[
    list[str] | None,
    typer.Option(
        metavar="PATTERN",
        rich_help_panel=ROBOT,
        help="Joints that move, repeatable, like 'left_*'; the others stand still. "
        "Default: all.",
    ),
]
Coordinates = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        rich_help_panel=ROBOT,
        help="A value that is learned like a joint but moves no link (a gripper), repeatable.",
    ),
]
AlignmentMethod = Annotated[
    Literal["dtw", "barycenter", "linear", "none"],
    typer.Option(
        rich_help_panel=DATA,
        help="Bring episodes onto one clock: by time warping onto the most typical one, onto "
        "their average, by stretching time, or not at all.",
    ),
]


def recordings(
    dataset: str,
    robot: Kinematics | None,
    frames: Sequence[str] | None,
    episodes: str | None,
    units: Sequence[str] | None,
    joints: str | None,
    rate: float | None,
) -> plugins.Recordings:
    """A data set as the options say, not yet read.

    Parameters
    ----------
    dataset : str
        A folder or a hub id.
    robot : Kinematics or None
        Gives the order of the joints.
    frames, episodes, units, joints, rate
        The options.
    """
    reader = plugins.required(plugins.READERS, "lerobot")
    opened: plugins.Recordings = reader(dataset, robot, frames, episodes, units, joints, rate)
    return opened


def read_robot(
    robot: str | None,
    links: Sequence[str] | None = None,
    joints: Sequence[str] | None = None,
    coordinates: Sequence[str] | None = None,
    poses: Sequence[str] | None = None,
) -> Kinematics | None:
    """The robot that the options describe; None for joints alone.

    Parameters
    ----------
    robot : str or None
        Path of a URDF, or ``"upper_body"``.
    links : sequence of str, optional
    joints : sequence of str, optional
        Patterns with ``*`` for the joints that move; the others stand still. All by default.
    coordinates : sequence of str, optional
        Joints without kinematics.
    poses : sequence of str, optional
        Tracked bodies in place of a robot.

    Raises
    ------
    DataError
        If they do not go together.
    """
    from tpgmm_torch.exceptions import DataError, UnknownNameError

    if poses:
        if robot or links or joints or coordinates:
            raise DataError("--poses are instead of --robot and its links and joints")
        from tpgmm_torch.robots.tracked_poses import Poses

        return Poses(poses)
    if robot is None:
        if links or joints or coordinates:
            raise DataError("--link, --robot-joint and --coordinate need --robot URDF")
        return None
    from tpgmm_torch.robots.robot import Robot
    from tpgmm_torch.robots.urdf import read_urdf

    if robot in (named := plugins.found(plugins.ROBOTS)):
        robot = str(named[robot].load()())
    moving = None
    if joints:
        actuated = read_urdf(robot).actuated
        for pattern in joints:
            if not any(fnmatchcase(name, pattern) for name in actuated):
                raise UnknownNameError("joint", pattern, "the URDF", actuated)
        moving = [n for n in actuated if any(fnmatchcase(n, pattern) for pattern in joints)]
    return Robot.from_urdf(robot, links or (), joints=moving, coordinates=coordinates or ())


def align(
    demonstrations: Sequence[Demonstration], method: str, robot: Kinematics | None
) -> list[Demonstration]:
    """Bring demonstrations onto one clock.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    method : {"dtw", "barycenter", "linear", "none"}
    robot : Kinematics or None
    """
    chosen = aligner(method, robot)
    return list(demonstrations) if chosen is None else chosen.fit_transform(demonstrations)


def aligner(method: str, robot: Kinematics | None) -> Alignment | None:
    """The transformer that brings demonstrations onto one clock, None for none.

    Parameters
    ----------
    method : {"dtw", "barycenter", "linear", "none"}
    robot : Kinematics or None
    """
    from tpgmm_torch.alignment import DynamicTimeWarping, LinearTimeNormalization

    if method == "none":
        return None
    if method == "linear":
        return LinearTimeNormalization(robot=robot)
    return DynamicTimeWarping("medoid" if method == "dtw" else method, robot=robot)

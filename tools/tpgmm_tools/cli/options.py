"""Options that several commands share, and what their texts mean."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tpgmm_tools.cli import plugins

if TYPE_CHECKING:
    from sklearn.pipeline import Pipeline

    from tpgmm_torch.alignment.base import Alignment
    from tpgmm_torch.data.demonstrations import Demonstration
    from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["align", "aligner", "in_panel", "read_robot", "recordings"]


def in_panel(panel: str) -> Callable[..., Any]:
    """A ``typer.Option`` that is shown in a panel of the help; its text comes first.

    Parameters
    ----------
    panel : str
        The heading.
    """

    def option(text: str, *names: str, **settings: Any) -> Any:
        return typer.Option(*names, help=text, rich_help_panel=panel, **settings)

    return option


of_data, of_robot = in_panel("Data set"), in_panel("Robot")

Dataset = Annotated[
    str, typer.Argument(help="A LeRobot data set: its folder, or hf://datasets/OWNER/NAME.")
]
Model = Annotated[Path, typer.Argument(metavar="DIR", help="A model that 'tpgmm fit' saved.")]
Frames = Annotated[
    list[str] | None,
    of_data(
        "An object's pose, repeatable: NAME (found by the names in "
        "observation.environment_state), NAME=FEATURE, NAME=FEATURE\\[7:14], or "
        "NAME=LINK@EVENT, where a link of the robot is at an event: one of the set, of "
        "--event, 'close', 'open' or 'stop' of that link, 'start' or 'end'. Default: all poses "
        "that the set names.",
        "--frame",
        metavar="NAME[=SOURCE]",
    ),
]
Events = Annotated[
    list[str] | None,
    of_data(
        "How an event is found, repeatable: NAME=closing:SIGNALS or opening:SIGNALS (when a "
        "gripper's are low), contact: or release:SIGNALS (high), moving:FRAME, stop:LINK; "
        "SIGNALS are names or patterns of joints, joined by commas.",
        "--event",
        metavar="NAME=HOW",
    ),
]
Episodes = Annotated[
    str | None, of_data("Which episodes; default all.", metavar="0:10 | 0,3,5 | TASK")
]
Units = Annotated[
    list[str] | None,
    of_data(
        "Unit of the stored joints: rad, deg, m, mm or raw; with JOINT= of one of them, "
        "repeatable. FILE.json is LeRobot's calibration, with PREFIX= of one arm. Default: as "
        "the set declares.",
        metavar="[JOINT=]UNIT",
    ),
]
Joints = Annotated[
    str | None,
    of_data(
        "The feature that holds the joints, or 'measured' or 'commanded'; default "
        "observation.state or the like.",
        metavar="FEATURE",
    ),
]
JointNames = Annotated[
    list[str] | None,
    of_data(
        "What the robot calls a stored joint, repeatable, where the names do not tell.",
        "--joint-name",
        metavar="STORED=JOINT",
    ),
]
Rate = Annotated[float | None, of_data("Resample to so many steps per second.", min=1e-3)]
Plausibility = Annotated[
    Literal["warn", "error", "ignore"],
    of_data(
        "What is done about recordings that are unlikely to be what they are taken for: "
        "units, order, clock, outliers."
    ),
]
AlignmentMethod = Annotated[
    Literal["dtw", "barycenter", "linear", "events", "events+dtw", "parts", "none"],
    of_data(
        "Bring episodes onto one clock: by time warping onto the most typical one, onto "
        "their average, by stretching time, by stretching it between events, by warping it "
        "between events, by stretching each of the parts that are found, or not at all."
    ),
]
RobotFile = Annotated[
    str | None,
    of_robot(
        "The robot's URDF or MJCF file; 'upper_body' and 'so101' come with the package. "
        "Without a robot, joints alone.",
        metavar="FILE",
    ),
]
Links = Annotated[list[str] | None, of_robot("A link of interest (a hand), repeatable.")]
RobotJoints = Annotated[
    list[str] | None,
    of_robot(
        "Joints that move, repeatable, like 'left_*'; the others stand still. Default: all.",
        metavar="PATTERN",
    ),
]
Coordinates = Annotated[
    list[str] | None,
    of_robot(
        "A value that is learned like a joint but moves no link (a gripper), repeatable.",
        metavar="NAME",
    ),
]


def recordings(
    dataset: str,
    robot: Kinematics | None,
    frames: Sequence[str] | None,
    events: Sequence[str] | None,
    episodes: str | None,
    units: Sequence[str] | None,
    joints: str | None,
    joint_names: Sequence[str] | None,
    rate: float | None,
    plausibility: str = "warn",
) -> plugins.Recordings:
    """The ``dataset`` of which the options say the rest, not yet read.

    Parameters
    ----------
    dataset : str
        A folder, or a name on the hub, as for ``load_lerobot``.
    robot : Kinematics or None
        Gives the order of the joints.
    frames, events, episodes, units, joints, joint_names, rate, plausibility
        The options as they were given.
    """
    reader = plugins.required(plugins.READERS, "lerobot")
    given = frames, events, episodes, units, joints, joint_names, rate, plausibility
    opened: plugins.Recordings = reader(dataset, robot, *given)
    return opened


def read_robot(
    robot: str | None,
    links: Sequence[str] | None = None,
    joints: Sequence[str] | None = None,
    coordinates: Sequence[str] | None = None,
    poses: Sequence[str] | None = None,
) -> Kinematics | None:
    """The robot that the options describe, or tracked poses; None for joints alone.

    Parameters
    ----------
    robot : str or None
        Path of a URDF or an MJCF, or the name of one that is registered in ``tpgmm.robots``.
    links : sequence of str, optional
        Links of interest.
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
    from tpgmm_torch.exceptions import DataError

    if poses:
        if robot or links or joints or coordinates:
            raise DataError("--poses are instead of --robot and its links and joints")
        from tpgmm_torch.robots.tracked_poses import Poses

        return Poses(poses)
    if robot is None:
        if links or joints or coordinates:
            raise DataError("--link, --robot-joint and --coordinate need --robot FILE")
        return None
    from tpgmm_torch.robots.robot import Robot

    if robot in (named := plugins.registered(plugins.ROBOTS)):
        robot = str(named[robot].load()())
    return Robot.from_file(
        robot, links or (), joints=joints or None, coordinates=coordinates or ()
    )


def number_or_auto(text: str) -> float | str:
    """The number that an option's text is, or "auto".

    Raises
    ------
    typer.BadParameter
        If it is neither.
    """
    if text == "auto":
        return text
    try:
        return float(text)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is neither a number nor 'auto'") from error


def count_or_auto(text: str | int) -> int | str:
    """The positive integer that an option's text is, or "auto".

    Raises
    ------
    typer.BadParameter
        If it is neither.
    """
    if text == "auto" or (str(text).isdecimal() and int(text) > 0):
        return "auto" if text == "auto" else int(text)
    raise typer.BadParameter(f"{text!r} is neither a positive integer nor 'auto'")


def aligner(method: str, robot: Kinematics | None) -> Alignment | Pipeline | None:
    """The transformer that ``--alignment method`` names, given a ``robot``; None for none."""
    from tpgmm_torch.alignment.piecewise_linear import EventAlignment
    from tpgmm_torch.alignment.text import parse_alignment

    if method != "parts":
        return parse_alignment(method, robot)
    from sklearn.pipeline import make_pipeline

    from tpgmm_torch.structure.segmentation import Segmentation

    return make_pipeline(Segmentation(robot), EventAlignment(["part *"], robot=robot))


def align(
    demonstrations: list[Demonstration], method: str, robot: Kinematics | None
) -> list[Demonstration]:
    """Bring ``demonstrations`` onto one clock, as :func:`aligner` does by ``method, robot``."""
    chosen = aligner(method, robot)
    if chosen is None:
        return demonstrations
    aligned: list[Demonstration] = chosen.fit_transform(demonstrations)
    return aligned

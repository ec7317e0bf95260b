"""Options that several commands share, in groups, and options made from a signature."""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from inspect import Parameter, getdoc, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

if TYPE_CHECKING:
    from sklearn.pipeline import Pipeline

    from tpgmm_torch.alignment.base import Alignment
    from tpgmm_torch.data.demonstrations import Demonstration, Situation
    from tpgmm_torch.robots.kinematics import Kinematics

__all__ = [
    "DataOptions", "RobotOptions", "align", "aligner", "command", "in_panel", "load",
    "options_of", "wanted",
]  # fmt: skip


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

#: Those that come with the package.
ROBOTS = ("so101", "upper_body")

Dataset = Annotated[
    str, typer.Argument(help="A LeRobot data set: its folder, or hf://datasets/OWNER/NAME.")
]
Model = Annotated[Path, typer.Argument(metavar="DIR", help="A model that 'tpgmm fit' saved.")]
Situations = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.json",
        help="Situations, start postures and frames, instead of those of a data set.",
    ),
]
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


@dataclass(frozen=True)
class DataOptions:
    """Options that describe what is read of a LeRobot data set."""

    frame: Annotated[
        list[str] | None,
        of_data(
            "An object's pose, repeatable: NAME (found by the names in "
            "observation.environment_state), NAME=FEATURE, NAME=FEATURE\\[7:14], or "
            "NAME=LINK@EVENT, where a link of the robot is at an event: one of the set, of "
            "--event, 'close', 'open' or 'stop' of that link, 'start' or 'end'. Default: all "
            "poses that the set names.",
            metavar="NAME[=SOURCE]",
        ),
    ] = None
    event: Annotated[
        list[str] | None,
        of_data(
            "How an event is found, repeatable: NAME=closing:SIGNALS or opening:SIGNALS (when "
            "a gripper's are low), contact: or release:SIGNALS (high), moving:FRAME, "
            "stop:LINK; SIGNALS are names or patterns of joints, joined by commas.",
            metavar="NAME=HOW",
        ),
    ] = None
    episodes: Annotated[
        str | None, of_data("Which episodes; default all.", metavar="0:10 | 0,3,5 | TASK")
    ] = None
    units: Annotated[
        list[str] | None,
        of_data(
            "Unit of the stored joints: rad, deg, m, mm or raw; with JOINT= of one of them, "
            "repeatable. FILE.json is LeRobot's calibration, with PREFIX= of one arm. Default: "
            "as the set declares.",
            metavar="[JOINT=]UNIT",
        ),
    ] = None
    joints: Annotated[
        str | None,
        of_data(
            "The feature that holds the joints, or 'measured' or 'commanded'; default "
            "observation.state or the like.",
            metavar="FEATURE",
        ),
    ] = None
    joint_name: Annotated[
        list[str] | None,
        of_data(
            "The robot's name of a stored joint, repeatable, where the names differ.",
            metavar="STORED=JOINT",
        ),
    ] = None
    rate: Annotated[
        float | None, of_data("Resample to so many steps per second.", min=1e-3)
    ] = None

    def arguments(self, robot: Kinematics | None = None) -> dict[str, Any]:
        """Keyword arguments of :func:`tpgmm_datasets.load_lerobot`, ``robot`` among them.

        Raises
        ------
        DataError
            If a text cannot be understood.
        """
        from tpgmm_datasets import text

        return {
            "robot": robot,
            "frames": text.parse_frames(self.frame or ()),
            "events": text.parse_events(self.event or ()),
            "episodes": text.parse_episodes(self.episodes),
            **text.parse_units(self.units or ()),
            "joints": self.joints,
            "joint_names": text.parse_joint_names(self.joint_name or ()),
            "rate": self.rate,
        }

    def read(self, dataset: str, robot: Kinematics | None = None) -> list[Demonstration]:
        """The demonstrations in a ``dataset``, joints in the order of a ``robot``."""
        from tpgmm_datasets.reader import load_lerobot

        return load_lerobot(dataset, **self.arguments(robot))


@dataclass(frozen=True)
class RobotOptions:
    """Options that describe a robot."""

    robot: Annotated[
        str | None,
        of_robot(
            "The robot's URDF or MJCF file; 'upper_body' and 'so101' come with the package. "
            "Without a robot, joints alone.",
            metavar="FILE",
        ),
    ] = None
    link: Annotated[list[str] | None, of_robot("A link of interest (a hand), repeatable.")] = (
        None
    )
    robot_joint: Annotated[
        list[str] | None,
        of_robot(
            "Joints that move, repeatable, like 'left_*'; the others stand still. Default: "
            "all.",
            metavar="PATTERN",
        ),
    ] = None
    coordinate: Annotated[
        list[str] | None,
        of_robot(
            "A value that is learned like a joint but moves no link (a gripper), repeatable.",
            metavar="NAME",
        ),
    ] = None
    poses: Annotated[
        list[str] | None,
        of_robot(
            "Instead of a robot: a tracked body whose pose the data set holds, repeatable.",
            metavar="NAME",
        ),
    ] = None

    def read(self) -> Kinematics | None:
        """The robot, or tracked poses; None for joints alone.

        Raises
        ------
        DataError
            If the options do not go together.
        """
        from tpgmm_datasets import robots
        from tpgmm_torch.exceptions import DataError
        from tpgmm_torch.robots.robot import Robot
        from tpgmm_torch.robots.tracked_poses import Poses

        parts = self.link or self.robot_joint or self.coordinate
        if self.poses:
            if self.robot or parts:
                raise DataError("--poses are instead of --robot and its links and joints")
            return Poses(self.poses)
        if self.robot is None:
            if parts:
                raise DataError("--link, --robot-joint and --coordinate need --robot FILE")
            return None
        given = self.robot
        return Robot.from_file(
            getattr(robots, f"{given}_urdf")() if given in ROBOTS else given,
            self.link or (),
            joints=self.robot_joint or None,
            coordinates=self.coordinate or (),
        )


def filter_plausibility(action: str) -> None:
    """Show, make an error of, or ignore what is unlikely about recordings."""
    from tpgmm_torch.exceptions import PlausibilityWarning

    actions: dict[str, Literal["always", "error", "ignore"]] = {
        "warn": "always",
        "error": "error",
        "ignore": "ignore",
    }
    warnings.simplefilter(actions[action], PlausibilityWarning)


def command(
    app: typer.Typer, example: str, generated: Collection[Parameter] = ()
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator that adds a function to an app as a command.

    A parameter whose type is a group of options (:class:`DataOptions`, ...) stands for all
    options of the group, and ``**settings`` for the ``generated`` ones.

    Parameters
    ----------
    app : typer.Typer
        Where it is added.
    example : str
        Shown below the help, after "Example: ".
    generated : collection of inspect.Parameter
        As :func:`options_of` makes them.
    """

    def add(function: Callable[..., Any]) -> Callable[..., Any]:
        parameters, groups = list[Parameter](), dict[str, Any]()
        for one in signature(function, eval_str=True).parameters.values():
            if one.kind is Parameter.VAR_KEYWORD:
                parameters += generated
            elif is_dataclass(one.annotation):
                groups[one.name] = one.annotation
                hints = get_type_hints(one.annotation, include_extras=True)
                parameters += [
                    Parameter(
                        f.name, one.KEYWORD_ONLY, default=f.default, annotation=hints[f.name]
                    )
                    for f in fields(one.annotation)
                ]
            else:
                parameters.append(one.replace(kind=one.KEYWORD_ONLY))

        @wraps(function)
        def run(**given: Any) -> Any:
            for name, group in groups.items():
                given[name] = group(**{f.name: given.pop(f.name) for f in fields(group)})
            return function(**given)

        run.__signature__ = signature(function).replace(parameters=parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        app.command(epilog=f"Example: {example}")(run)
        return function

    return add


def options_of(made: type, panel: str, without: Collection[str]) -> list[Parameter]:
    """Options for the parameters of a class, explained as in its docstring.

    Parameters
    ----------
    made : type
        Its constructor has defaults, its docstring is numpydoc.
    panel : str
        Heading of the options in the help.
    without : collection of str
        Parameters that get none.
    """
    entries = re.findall(
        r"^([\w, ]+) : .*\n((?: .+\n|\n(?= ))+)", getdoc(made) or "", re.MULTILINE
    )
    texts = {name: text for names, text in entries for name in names.split(", ")}
    options, found = in_panel(panel), []
    for one in signature(made).parameters.values():
        if one.name not in without:
            sentence = re.split(r"(?<=\.)\s", " ".join(texts.get(one.name, "").split()))[0]
            text = re.sub(r"(?::\w+:)?`+~?([^`]+)`+", r"\1", sentence).replace("[", "\\[")
            flag = isinstance(one.default, bool)
            settings: dict[str, Any] = {} if flag else {"parser": value, "metavar": "VALUE"}
            kind: Any = Annotated[bool if flag else Any, options(text, **settings)]
            found.append(one.replace(kind=one.KEYWORD_ONLY, annotation=kind))
    return found


def value(text: Any) -> Any:
    """The number that an option's ``text`` is, None for "None"; any other text is itself."""
    try:
        return ast.literal_eval(text)
    except (SyntaxError, ValueError):
        return text


def load(model: Path) -> Any:
    """The model in a folder ``model``, of one way or of several."""
    from tpgmm_torch.estimator import TaskParameterizedGMM
    from tpgmm_torch.multimodal import MultimodalTaskParameterizedGMM
    from tpgmm_torch.persistence import MODES

    several = (model / MODES).is_dir()
    return (MultimodalTaskParameterizedGMM if several else TaskParameterizedGMM).load(
        model, device="cpu"
    )


def wanted(
    situations: Path | None, dataset: str | None, data: DataOptions, robot: Kinematics
) -> tuple[list[Situation], list[Demonstration]]:
    """The situations in a file, or else those of a data set; and its demonstrations.

    Parameters
    ----------
    situations, dataset : Path, str, optional
        The file and the data set.
    data, robot : DataOptions, Kinematics
        Which demonstrations are read, and the order of their joints.
    """
    from tpgmm_datasets.situation_files import read_situations
    from tpgmm_torch.data.demonstrations import Situation

    shown = [] if dataset is None else data.read(dataset, robot)
    if situations is not None:
        return read_situations(situations, robot.joint_names), shown
    return [Situation.of(one) for one in shown], shown


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

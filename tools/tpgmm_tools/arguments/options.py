"""Options made from signatures and docstrings, in groups that several commands share."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, is_dataclass
from functools import wraps
from inspect import Parameter, getdoc, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer

from tpgmm_tools.arguments.help import HELP_ALL, Command

if TYPE_CHECKING:
    from tpgmm_control.obstacles import Scene
    from tpgmm_datasets.reader import Recording
    from tpgmm_torch.data.demonstrations import Demonstration, Situation
    from tpgmm_torch.estimator import TaskParameterizedGMM
    from tpgmm_torch.robots.kinematics import Kinematics
    from tpgmm_torch.skills.skill import Skill


Alignments = Literal["dtw", "barycenter", "linear", "events", "events+dtw", "parts", "none"]


@dataclass(frozen=True)
class DataOptions:
    """Data set.

    Parameters
    ----------
    frame : ``NAME[=SOURCE]``
        An object's pose, repeatable: NAME (found by the names in
        observation.environment_state), NAME=FEATURE, NAME=FEATURE[7:14], NAME=POSES.csv
        (columns episode, x, y, z, and yaw or qw, qx, qy, qz; time if it moves), or
        NAME=LINK@EVENT, where a link of the robot is at an event: one of the set, of --event,
        'close', 'open' or 'stop' of that link, 'start' or 'end'; +x,y,z behind it is the object
        in the link. Default: all poses that the set names.
    event : ``NAME=HOW``
        How an event is found, repeatable: NAME=closing:SIGNALS or opening:SIGNALS (when a
        gripper's are low), contact: or release:SIGNALS (high), moving:FRAME, stop:LINK;
        SIGNALS are names or patterns of joints, joined by commas.
    episodes : ``0:10 | 0,3,5 | TASK``
        Which episodes; default all.
    units : ``[JOINT=]UNIT``
        Unit of the stored joints: rad, deg, m, mm, raw, or lerobot (arms in degrees, grippers 0
        to 100); with JOINT= of one or, as '*gripper=', of some of them, repeatable. FILE.json
        is LeRobot's calibration, with PREFIX= of one arm. Default: as the set declares.
    joints : ``FEATURE``
        The feature that holds the joints; default observation.state or the like. What 'action'
        commands of them is learned beside them.
    joint_name : ``STORED=JOINT``
        The robot's name of a stored joint, repeatable, where the names differ; NAME,NAME,...
        names all values in order, 'robot' says that they are the robot's joints in its order.
    rate : float >= 0.001
        Resample to this number of steps per second.
    relax : ``CHECK``
        Leave out episodes that fail a check, repeatable: duplicates, events, gaps, missing,
        nan, poses or time; or metadata, and go on without it.
    """

    frame: list[str] | None = None
    event: list[str] | None = None
    episodes: str | None = None
    units: list[str] | None = None
    joints: str | None = None
    joint_name: list[str] | None = None
    rate: float | None = None
    relax: list[str] | None = None

    def arguments(self, robot: Kinematics | None = None) -> dict[str, Any]:
        """Return the arguments of :func:`tpgmm_datasets.load_lerobot`, with the ``robot``.

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
            "relax": self.relax or (),
        }

    def open(self, dataset: str, robot: Kinematics | None, **options: Any) -> Recording:
        """Open a ``dataset``, with a robot without limits for what is in a unit of its own."""
        from tpgmm_datasets.reader import open_recording

        return open_recording(dataset, **(self.arguments(robot) | options)).drop_raw_limits()

    def read(self, dataset: str, robot: Kinematics | None = None) -> list[Demonstration]:
        """Read the demonstrations in a ``dataset``, joints in the order of a ``robot``."""
        from tpgmm_datasets.reader import load_lerobot

        return load_lerobot(dataset, **self.arguments(robot))


@dataclass(frozen=True)
class RobotOptions:
    """Robot.

    Parameters
    ----------
    robot : ``FILE | NAME=FILE@X,Y,Z``
        The robot's URDF or MJCF file; 'upper_body', 'so101' and 'bi_so101' come with the
        package. Several, repeatable: the name of each, and where its base is [m], perhaps with
        ,YAW [rad] or ,QW,QX,QY,QZ behind it. Without a robot, joints alone.
    link : str
        A link of interest (a hand), repeatable. Default: what carries a gripper.
    robot_joint : ``PATTERN``
        Joints that move, repeatable, like 'left_*'; the others stand still. Default: all.
    coordinate : ``NAME``
        A value that is learned like a joint but moves no link (a gripper), repeatable.
    poses : ``NAME``
        Instead of a robot: a tracked body whose pose the data set holds, repeatable.
    """

    robot: list[str] | None = None
    link: list[str] | None = None
    robot_joint: list[str] | None = None
    coordinate: list[str] | None = None
    poses: list[str] | None = None

    def read(self) -> Kinematics | None:
        """Return the robot, or tracked poses; None for joints alone.

        Raises
        ------
        DataError
            If the options do not go together.
        """
        from tpgmm_datasets.robots import parse_robot
        from tpgmm_torch.robots.tracked_poses import Poses

        parts = any((self.link, self.robot_joint, self.coordinate))
        if self.poses and (self.robot or parts):
            raise refuse("--poses are instead of --robot and its links and joints")
        if self.poses:
            return Poses(self.poses)
        if self.robot:
            chosen = {"joints": self.robot_joint or None, "coordinates": self.coordinate or ()}
            return parse_robot(self.robot, self.link or (), **chosen)
        if parts:
            raise refuse("--link, --robot-joint and --coordinate need --robot FILE")
        return None


@dataclass(frozen=True)
class SceneOptions:
    """Scene.

    Parameters
    ----------
    object_ : ``FRAME=SHAPE``
        What an object looks like, repeatable: box:X,Y,Z, cylinder:RADIUS,LENGTH or
        sphere:RADIUS in metres, at the origin of its frame; else a small box.
    meshes : ``FOLDER``
        The robot's mesh files; without them, sticks stand for meshes.
    obstacles : ``FILE.xml``
        An MJCF with what stands around, as for 'tpgmm reproduce': it is drawn. A report lists
        what touches it, and 'tpgmm view --live' keeps clear of it.
    visuals : bool
        With --obstacles, take the robot's visual geometry where it has no collision geometry.
    """

    object_: list[str] | None = None
    meshes: Path | None = None
    obstacles: Path | None = None
    visuals: bool = False

    def read(self, skill: Skill, shown: list[Demonstration]) -> dict[str, Any]:
        """Return shapes of objects, the folder of meshes, and obstacles, as views take them."""
        from tpgmm_tools.viewing import parse_shape

        if self.meshes is not None and not self.meshes.is_dir():
            raise refuse(f"--meshes needs a folder, got {str(self.meshes)!r}")
        pairs = [text.partition("=") for text in self.object_ or ()]
        shapes = {name: parse_shape(shape) for name, _, shape in pairs}
        around = self.obstacles and read_obstacles(self.obstacles, skill, self.visuals, shown)
        return {"objects": shapes, "meshes": self.meshes, "obstacles": around}


def refuse(message: str) -> Exception:
    """Return the error of options that cannot be, for ``raise``."""
    from tpgmm_torch.exceptions import DataError

    return DataError(message)


def command(
    app: typer.Typer, example: str
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds a function to an app as a command.

    Positional parameters are arguments, others options, explained by the function's docstring.
    A parameter whose type is a group of options (:class:`DataOptions`, ...) stands for all of
    them.

    Parameters
    ----------
    app : typer.Typer
        Where it is added.
    example : str
        Shown below the help, after "Example: ".
    """

    def add(function: Callable[..., Any]) -> Callable[..., Any]:
        parameters, groups = list[Parameter](), dict[str, tuple[Any, list[Parameter]]]()
        entries = _entries(function)
        for one in signature(function, eval_str=True).parameters.values():
            if is_dataclass(one.annotation) and isinstance(one.annotation, type):
                groups[one.name] = one.annotation, _group_options(one.annotation)
                parameters += groups[one.name][1]
            else:
                parameters.append(_option(one, *entries[one.name]))

        @wraps(function)
        def run(**given: Any) -> Any:
            given.pop(HELP_ALL.name)
            for name, (group, members) in groups.items():
                given[name] = group(**{each.name: given.pop(each.name) for each in members})
            return function(**given)

        text = (getdoc(function) or "").partition("Parameters\n---")[0]
        run.__doc__ = re.sub(r"(?<!\n)\n(?!\n)", " ", text)
        parameters = [*parameters, HELP_ALL]
        run.__signature__ = signature(function).replace(parameters=parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        app.command(cls=Command, epilog=example)(run)
        return function

    return add


def _group_options(group: type) -> list[Parameter]:
    """Return options for the fields of a dataclass; its docstring begins with their heading."""
    entries, panel = _entries(group), (group.__doc__ or "").partition(".")[0]
    fields = signature(group, eval_str=True).parameters.values()
    keyword = Parameter.KEYWORD_ONLY
    return [_option(one.replace(kind=keyword), *entries[one.name], panel) for one in fields]


def _entries(documented: Any) -> dict[str, tuple[str, str]]:
    """Return type and text of each parameter in a numpydoc docstring."""
    pattern = r"^([\w, ]+) : (.*)\n((?: .+\n?|\n(?= ))*)"
    found = re.findall(pattern, getdoc(documented) or "", re.MULTILINE)
    return {
        name: (kind, " ".join(text.split()))
        for names, kind, text in found
        for name in names.split(", ")
    }


def _option(one: Parameter, kind: str, text: str, panel: str | None = None) -> Parameter:
    """Add what typer must know to a parameter: ``X`` in its type is shown as its value."""
    text = re.sub(r"(?::\w+:)?`+~?([^`]+)`+", r"\1", text)
    name = one.name.rstrip("_").replace("_", "-")
    settings: dict[str, Any] = {"help": text, "rich_help_panel": panel}
    if shown := re.search("``(.+)``", kind):
        settings["metavar"] = shown[1]
    elif one.kind is Parameter.KEYWORD_ONLY:
        settings["metavar"] = _value_name(one.annotation)
    else:
        settings["metavar"] = name.upper()
    if least := re.search(r">= (\S+)", kind):
        settings["min"] = type(one.default or 0.5)(float(least[1]))
    if one.annotation is Any:
        settings["parser"] = value
    negation = f"/--no-{name}" if one.default is True else ""
    if one.kind is Parameter.KEYWORD_ONLY:
        info = typer.Option(f"--{name}{negation}", **settings)
    else:
        info = typer.Argument(**settings)
    annotation: Any = Annotated[one.annotation, info]
    return one.replace(kind=Parameter.KEYWORD_ONLY, annotation=annotation)


def _value_name(kind: Any) -> str | None:
    """Return what stands for a value in the help; None where typer lists the values."""
    kinds = {int: "INTEGER", float: "NUMBER"}
    if get_origin(kind) is Literal:
        return None
    return next((kinds[one] for one in (kind, *get_args(kind)) if one in kinds), "TEXT")


def value(text: Any) -> Any:
    """Return the number that an option's ``text`` is, None for "None", or the text itself."""
    try:
        return ast.literal_eval(text)
    except (SyntaxError, ValueError):
        return text


def load_one_thread(model: Path) -> TaskParameterizedGMM:
    """Load a fitted ``model`` on the CPU, where one thread computes from now on."""
    import torch

    from tpgmm_torch.persistence import load_model

    # the matrices are small: a second thread on a busy machine only spins
    torch.set_num_threads(1)
    return load_model(model, device="cpu")


@contextmanager
def show_progress(text: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar behind a ``text`` on terminals: the number that is done, and of all."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(transient=True, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(text)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def read_situations(
    situations: Path | None, dataset: str | None, data: DataOptions, robot: Kinematics
) -> tuple[list[Situation], list[Demonstration]]:
    """Read the situations in a file, or else those of a data set; and its demonstrations.

    Parameters
    ----------
    situations, dataset : Path, str, optional
        The file and the data set.
    data, robot : DataOptions, Kinematics
        Which demonstrations are read, and the order of their joints.
    """
    from tpgmm_datasets import situation_files
    from tpgmm_torch.data.demonstrations import Situation

    shown = [] if dataset is None else data.read(dataset, robot)
    if situations is not None:
        return situation_files.read_situations(situations, robot.joint_names), shown
    return [Situation.of(one) for one in shown], shown


def align(
    demonstrations: list[Demonstration], method: str, robot: Kinematics | None
) -> list[Demonstration]:
    """Bring ``demonstrations`` onto one clock, by the ``method`` for a ``robot``."""
    from tpgmm_torch.structure.choices import aligner

    chosen = aligner(method, robot)
    return demonstrations if chosen is None else list(chosen.fit_transform(demonstrations))


def check_situation(number: int, count: int) -> None:
    """Refuse a ``number`` of --situation behind the last of ``count`` situations."""
    if number >= count:
        raise refuse(f"there are {count} situations, counted from 0; got --situation {number}")


def read_obstacles(
    file: Path, skill: Skill, visuals: bool, shown: list[Demonstration]
) -> Scene:
    """Put the robot among the obstacles of a ``file``; what is allowed is listed."""
    from tpgmm_control.obstacles import Scene

    if not file.is_file():
        raise refuse(f"--obstacles is an MJCF file, got {str(file)!r}")
    scene = Scene(skill.kinematics, file, visuals=visuals).allowing(shown).allowing_skill(skill)
    for (one, other), reason in scene.allowed.items():
        typer.echo(f"allowed: {one} and {other} ({reason})")
    return scene

"""The page in the browser: learn recordings, move objects, look at the motion."""

from __future__ import annotations

import html
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tpgmm_datasets.checks.check import check
from tpgmm_datasets.robots import ROBOTS
from tpgmm_datasets.tables import trajectories_to_frame, write_table
from tpgmm_tools.app.sources import Recorded, generate_bottle, read_uploads
from tpgmm_tools.arguments.options import RobotOptions, align
from tpgmm_tools.cli.application import explain
from tpgmm_tools.viewing import write_motion
from tpgmm_torch import quaternions
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.operators.text import default_operators, format_operator
from tpgmm_torch.persistence import save
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.structure.choices import prepare_demonstrations

GENERATED, UPLOADED = "generated: shaking a bottle with two hands", "my files"
#: Of the choice of robots: joints alone, a file that is sent along.
NO_ROBOT, ROBOT_FILE = "none", "my URDF or MJCF"
#: Both buttons take turns: the machine has few cores, and warnings are collected one at a time.
TURNS: dict[str, Any] = {"concurrency_id": "work", "concurrency_limit": 1}
#: Pictures per second: enough to look smooth, few enough for a page of a megabyte.
FPS = 12.0
INTRODUCTION = """\
# A skill from demonstrations

Choose recordings, learn them, put the objects elsewhere, and look at the motion: the robot, its
paths, where the hands may be, and which operator decides when.
"""


@dataclass(frozen=True, eq=False)
class Skill:
    """A fitted ``model`` and its ``demonstrations``, as recorded."""

    model: TaskParameterizedGMM
    demonstrations: Sequence[Demonstration]

    def situation(self, number: int) -> Situation:
        """The situation of a demonstration, by its ``number`` from 1."""
        return Situation.of(self.demonstrations[number - 1])


@contextmanager
def _collect_remarks() -> Iterator[list[str]]:
    """Collect the texts of warnings, each once, as lines of Markdown."""
    lines: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", UserWarning)
        yield lines
    texts = dict.fromkeys(" ".join(str(one.message).split()) for one in caught)
    lines += ["\n**To be looked at:**", *(f"- {text}" for text in texts)] if texts else []


def _refuse(error: Exception) -> str:
    """Write the message of an error as Markdown; raise one that no user can mend."""
    message = explain(error)
    if message is None:
        raise error
    return f"**It does not work like this:** {' '.join(message.split())}"


def learn(
    source: str,
    files: Sequence[str] | None,
    robot: str,
    robot_file: str | None,
    links: str,
    frames: str,
    n_components: float,
    more: Mapping[str, Callable[[], Recorded]] | None = None,
) -> tuple[Skill | None, str]:
    """Read, align and learn, as ``tpgmm fit`` with nothing but its defaults.

    Parameters
    ----------
    source : str
        ``GENERATED``, ``UPLOADED``, or a name among ``more``.
    files : sequence of str, optional
        The uploaded files.
    robot, robot_file : str
        One of ``ROBOTS``, "none", or ``ROBOT_FILE`` if the file describes it.
    links, frames : str
        Separated by commas; see :func:`tpgmm_tools.app.sources.read_uploads`.
    n_components : float
        K, the number of Gaussians.
    more : mapping of str to callable, optional
        Other sources by name.

    Returns
    -------
    skill : Skill or None
        None if it could not be learned.
    report : str
        What was learned, or why not, as Markdown.
    """
    try:
        with _collect_remarks() as remarks:
            if source == UPLOADED:
                described = {ROBOT_FILE: robot_file, NO_ROBOT: None}.get(robot, robot)
                given = None if described is None else [described]
                kinematics = RobotOptions(given, _names(links)).read()
                read = read_uploads(files or (), kinematics, _names(frames))
            else:
                known: dict[str, Callable[[], Recorded]] = {GENERATED: generate_bottle}
                read, kinematics = (known | dict(more or {}))[source]()
            model = _fit(read, kinematics, int(n_components))
    except Exception as error:
        return None, _refuse(error)
    seconds = [one.duration for one in read]
    lines = [
        f"Learned {len(read)} demonstrations of {min(seconds):.1f} to {max(seconds):.1f} s.",
        *(f"- `{format_operator(operator)}`" for operator in model.operators_),
    ]
    return Skill(model, read), "\n".join(lines + remarks)


def _fit(
    read: list[Demonstration], robot: Kinematics | None, n_components: int
) -> TaskParameterizedGMM:
    check(read, robot).act()
    operators = default_operators(() if robot is None else robot.links, list(read[0].frames))
    model = TaskParameterizedGMM(n_components, operators, robot, random_state=0)
    return model.fit(prepare_demonstrations(align(read, "dtw", robot), operators, robot))


def places_of(skill: Skill | None, number: int) -> list[list[Any]]:
    """Return rows of a table of the objects that stand still in a demonstration.

    Parameters
    ----------
    skill, number : Skill, int
        Of the demonstration, counted from 1; without a skill there are no rows.
    """
    frames = {} if skill is None else skill.situation(number).frames
    return [
        [name, *(round(float(value), 4) for value in frame.position), 0.0]
        for name, frame in frames.items()
        if not frame.batch_shape
    ]


def move_objects(situation: Situation, places: Sequence[Sequence[Any]]) -> Situation:
    """Return the situation with objects elsewhere.

    Parameters
    ----------
    situation : Situation
        Where they were.
    places : sequence of sequence
        Name of a frame that stands still, its new x, y, z [m], and by how much it is turned
        about the vertical through it [deg].

    Raises
    ------
    DataError, UnknownNameError
        If a place is not four finite numbers, or no such object stands still.
    """
    still = {name: one for name, one in situation.frames.items() if not one.batch_shape}
    frames = dict(situation.frames)
    for name, *place in places:
        if name not in still:
            raise UnknownNameError("object", name, "the situation", still)
        try:
            x, y, z, degrees = np.array(place, dtype=float)
            half = np.deg2rad(degrees) / 2
            turn = still[name].orientation.new_tensor([np.cos(half), 0.0, 0.0, np.sin(half)])
            frames[name] = Frame([x, y, z], quaternions.product(turn, still[name].orientation))
        except (TypeError, ValueError):
            raise DataError(
                f"{name}: a place is x, y, z in metres and a turn in degrees, got {place}"
            ) from None
    return replace(situation, frames=frames)


def show(
    skill: Skill | None, number: int, places: Sequence[Sequence[Any]]
) -> tuple[str, str, list[str]]:
    """Reproduce a skill, and write the page, the references and the model.

    Parameters
    ----------
    skill, number : Skill, int
        And of which demonstration start and objects are taken, counted from 1.
    places : sequence of sequence
        Rows as :func:`places_of` gives them.

    Returns
    -------
    picture : str
        The moving picture, as HTML.
    report : str
        How new the situation is, or what is wrong, as Markdown.
    files : list of str
        ``motion.html``, ``motion.csv`` with the references, and ``model.zip``.
    """
    if skill is None:
        return "", "Nothing is learned yet.", []
    folder = Path(_place().name)
    page = folder / "motion.html"
    try:
        situation = move_objects(skill.situation(number), places)
        with _collect_remarks() as remarks:
            trajectory = write_motion(
                page, skill.model, situation, skill.demonstrations, fps=FPS, title="motion"
            )
    except Exception as error:
        return "", _refuse(error), []
    frames = situation.frames_at(trajectory.time)
    write_table(trajectories_to_frame([trajectory], [frames]), folder / "motion.csv")
    save(skill.model, folder / "model")
    shutil.make_archive(str(folder / "model"), "zip", folder, "model")
    shutil.rmtree(folder / "model")
    line = f"{float(trajectory.time[-1] - trajectory.time[0]):.1f} s of motion."
    if trajectory.novelty is not None:
        line += (
            f" The situation is {float(trajectory.novelty):.2f} times as far from the "
            "demonstrations as the one of these that is furthest from the others."
        )
    # as the text of the frame itself, the page needs no address that serves it
    text = html.escape(page.read_text(encoding="utf-8"))
    picture = f'<iframe title="motion" style="width:100%;height:70vh;border:0" srcdoc="{text}">'
    return (
        f"{picture}</iframe>",
        "\n".join([line, *remarks]),
        sorted(map(str, folder.iterdir())),
    )


def page(more: Mapping[str, Callable[[], Recorded]] | None = None) -> Any:
    """Build the page, not yet served.

    Parameters
    ----------
    more : mapping of str to callable, optional
        Sources beside the generated skill and files, by name: the demonstrations, and their
        robot. The first of them is chosen.

    Returns
    -------
    gradio.Blocks
        ``launch()`` serves it.
    """
    import gradio as gr

    sources = [*(more or {}), GENERATED, UPLOADED]
    with gr.Blocks(
        title="tpgmm: a skill from demonstrations",
        analytics_enabled=False,
        delete_cache=(3600, 86400),  # every hour what is older than a day, and all at the end
    ) as blocks:
        gr.Markdown(INTRODUCTION)
        skill = gr.State()
        with gr.Row():
            with gr.Column(scale=1):
                source = gr.Radio(sources, value=sources[0], label="recordings")
                with gr.Group(visible=sources[0] == UPLOADED) as own:
                    label = "a .zip of a LeRobot data set's folder, or .csv, .parquet"
                    kinds = [".zip", ".csv", ".parquet"]
                    files = gr.File(label=label, file_count="multiple", file_types=kinds)
                    robots = [NO_ROBOT, *ROBOTS, ROBOT_FILE]
                    robot = gr.Dropdown(robots, value=NO_ROBOT, label="robot")
                    robot_file = gr.File(label=ROBOT_FILE, file_types=[".urdf", ".xml"])
                    links = gr.Textbox(label="links of interest", placeholder="l_hand, r_hand")
                    frames = gr.Textbox(
                        label="frames of a LeRobot data set", placeholder="bottle=FEATURE[7:14]"
                    )
                n_components = gr.Slider(2, 40, 15, step=1, label="K, the number of Gaussians")
                begin = gr.Button("Learn", variant="primary")
                report = gr.Markdown()
            with gr.Column(scale=2):
                number = gr.Dropdown([1], value=1, label="start as in demonstration")
                places = gr.Dataframe(
                    headers=["object", "x [m]", "y [m]", "z [m]", "turn [deg]"],
                    datatype=["str", *["number"] * 4],
                    type="array",
                    label="where the objects stand",
                )
                look = gr.Button("Show", variant="primary")
                picture = gr.HTML()
                remarked = gr.Markdown()
                taken = gr.File(label="to take away", file_count="multiple")

        def ready(*given: Any) -> tuple[Skill | None, str, Any, list[list[Any]]]:
            answer: Callable[..., tuple[Skill | None, str]] = learn
            new, text = answer(*given, more)
            numbers = list(range(1, len(new.demonstrations) + 1 if new is not None else 2))
            return new, text, gr.Dropdown(numbers, value=1), places_of(new, 1)

        asked = [source, files, robot, robot_file, links, frames, n_components]
        source.change(
            lambda name: gr.Group(visible=name == UPLOADED), source, own, api_name=False
        )
        begin.click(ready, asked, [skill, report, number, places], api_name="learn", **TURNS)
        number.input(places_of, [skill, number], places, api_name="places")
        given, answer = [skill, number, places], [picture, remarked, taken]
        look.click(show, given, answer, api_name="show", **TURNS)
    return blocks


@cache
def _place() -> tempfile.TemporaryDirectory[str]:
    """Make the folder of the last picture's files; it goes when Python ends."""
    return tempfile.TemporaryDirectory(prefix="tpgmm-")


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]

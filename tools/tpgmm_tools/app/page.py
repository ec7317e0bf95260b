"""The page: what is asked, and what the answers look like."""

from __future__ import annotations

import html
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tpgmm_tools.app.skill import Skill, learn, listed, moved, remarks, show
from tpgmm_tools.app.sources import Shown, generated_bottle, uploaded
from tpgmm_tools.cli.commands import explain
from tpgmm_tools.cli.options import read_robot
from tpgmm_tools.cli.plugins import ROBOTS, registered
from tpgmm_torch.exceptions import DependencyError

__all__ = ["GENERATED", "UPLOADED", "learned", "page", "places_of", "shown_motion"]

GENERATED, UPLOADED = "generated: shaking a bottle with two hands", "my files"
#: Of the choice of robots: joints alone, a file that is sent along.
NO_ROBOT, ROBOT_FILE = "none", "my URDF or MJCF"
#: Of the table of objects.
PLACE = ("object", "x [m]", "y [m]", "z [m]", "turn [deg]")
#: Both buttons take turns: the machine has few cores, and warnings are collected one at a time.
TURNS: dict[str, Any] = {"concurrency_id": "work", "concurrency_limit": 1}
TITLE = "tpgmm: a skill from demonstrations"
INTRODUCTION = """\
# A skill from demonstrations

Choose recordings, learn them, put the objects elsewhere, and look at the motion: the robot, its
paths, where the hands may be, and which operator decides when.
"""


def learned(
    source: str,
    files: Sequence[str] | None,
    robot: str,
    robot_file: str | None,
    links: str,
    frames: str,
    n_components: float,
    more: Mapping[str, Callable[[], Shown]] | None = None,
) -> tuple[Skill | None, str]:
    """Read and learn; whatever a user can mend is said, not raised.

    Parameters
    ----------
    source : str
        ``GENERATED``, ``UPLOADED``, or a name among ``more``.
    files : sequence of str, optional
        What was uploaded.
    robot, robot_file : str
        Name of a registered robot, "none", or that the file ``robot_file`` describes it.
    links, frames : str
        Separated by commas; see :func:`tpgmm_tools.app.sources.uploaded`.
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
        with remarks() as remarked:
            if source == UPLOADED:
                described = robot_file if robot == ROBOT_FILE else robot
                kinematics = read_robot(
                    None if described in (NO_ROBOT, None) else described, _names(links)
                )
                shown = uploaded(files or (), kinematics, _names(frames))
            else:
                known: dict[str, Callable[[], Shown]] = {GENERATED: generated_bottle}
                shown, kinematics = (known | dict(more or {}))[source]()
        skill = learn(shown, kinematics, int(n_components))
    except Exception as error:
        return None, _refusal(error)
    return skill, skill.report + listed(remarked)


def places_of(skill: Skill | None, number: int) -> list[list[Any]]:
    """Rows of the table of objects that stand still in a demonstration, to be changed.

    Parameters
    ----------
    skill : Skill, optional
        Without one there are no rows.
    number : int
        Of the demonstration, counted from 1.
    """
    if skill is None:
        return []
    frames = skill.situations[number - 1].frames
    return [
        [name, *(round(float(value), 4) for value in frame.position), 0.0]
        for name, frame in frames.items()
        if not frame.batch_shape
    ]


def shown_motion(
    skill: Skill | None, number: int, places: Sequence[Sequence[Any]]
) -> tuple[str, str, list[str]]:
    """Reproduce and write; whatever a user can mend is said, not raised.

    Parameters
    ----------
    skill : Skill, optional
        What was learned.
    number : int
        Of the demonstration whose start and objects are taken, counted from 1.
    places : sequence of sequence
        Rows as :func:`places_of` gives them.

    Returns
    -------
    picture : str
        The moving picture, as HTML.
    report : str
        How new the situation is, or what is wrong, as Markdown.
    files : list of str
        To take away: the page, the references, the model.
    """
    if skill is None:
        return "", "Nothing is learned yet.", []
    folder = Path(tempfile.mkdtemp(prefix="tpgmm-"))
    try:
        objects = {str(name): place for name, *place in places}
        situation = moved(skill.situations[number - 1], objects)
        _, report = show(skill, situation, folder)
    except Exception as error:
        return "", _refusal(error), []
    # as the text of the frame itself, the page needs no address that serves it
    text = html.escape((folder / "motion.html").read_text(encoding="utf-8"))
    picture = f'<iframe title="motion" style="width:100%;height:70vh;border:0" srcdoc="{text}">'
    return f"{picture}</iframe>", report, sorted(map(str, folder.iterdir()))


def page(more: Mapping[str, Callable[[], Shown]] | None = None) -> Any:
    """The page, not yet served.

    Parameters
    ----------
    more : mapping of str to callable, optional
        Sources beside the generated skill and files, by the name that is shown: the
        demonstrations, and their robot. The first of them is chosen.

    Returns
    -------
    gradio.Blocks
        ``launch()`` serves it.

    Raises
    ------
    DependencyError
        If gradio is not installed.
    """
    try:
        import gradio as gr
    except ImportError as error:
        raise DependencyError(
            "the page needs gradio: pip install 'tpgmm-torch[app]'"
        ) from error
    sources = [*(more or {}), GENERATED, UPLOADED]
    robots = [NO_ROBOT, *sorted(registered(ROBOTS)), ROBOT_FILE]
    with gr.Blocks(title=TITLE, analytics_enabled=False) as blocks:
        gr.Markdown(INTRODUCTION)
        skill = gr.State()
        with gr.Row():
            with gr.Column(scale=1):
                source = gr.Radio(sources, value=sources[0], label="recordings")
                with gr.Group(visible=sources[0] == UPLOADED) as own:
                    files = gr.File(
                        label="a .zip of a LeRobot data set's folder, or .csv, .parquet",
                        file_count="multiple",
                        file_types=[".zip", ".csv", ".parquet"],
                    )
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
                    headers=list(PLACE),
                    datatype=["str", *["number"] * 4],
                    type="array",
                    label="where the objects stand",
                )
                look = gr.Button("Show", variant="primary")
                picture = gr.HTML()
                remarked = gr.Markdown()
                taken = gr.File(label="to take away", file_count="multiple")

        def ready(*given: Any) -> tuple[Skill | None, str, Any, list[list[Any]]]:
            answer: Callable[..., tuple[Skill | None, str]] = learned
            new, text = answer(*given, more=more)
            count = len(new.demonstrations) if new is not None else 1
            return new, text, gr.Dropdown(list(range(1, count + 1)), value=1), places_of(new, 1)

        asked = [source, files, robot, robot_file, links, frames, n_components]
        source.change(
            lambda name: gr.Group(visible=name == UPLOADED), source, own, api_name=False
        )
        begin.click(ready, asked, [skill, report, number, places], api_name="learn", **TURNS)
        number.input(places_of, [skill, number], places, api_name="places")
        look.click(
            shown_motion, [skill, number, places], [picture, remarked, taken],
            api_name="show", **TURNS,
        )  # fmt: skip
    return blocks


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _refusal(error: Exception) -> str:
    """What to mend, as Markdown; an error that no user can mend goes on."""
    message = explain(error)
    if message is None:
        raise error
    return f"**It does not work like this:** {' '.join(message.split())}"

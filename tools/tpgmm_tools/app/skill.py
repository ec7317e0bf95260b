"""What the page's buttons do: learn a skill, and show it in a situation."""

from __future__ import annotations

import shutil
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tpgmm_tools.viewing import write_motion
from tpgmm_torch import quaternions
from tpgmm_torch.alignment.dynamic_time_warping import DynamicTimeWarping
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.tables import trajectories_to_frame, write_table
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.operators.text import default_operators, format_operator
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["Skill", "learn", "listed", "moved", "remarks", "show"]

#: Pictures per second: enough to look smooth, few enough for a page of a megabyte.
FPS = 12.0


@dataclass(frozen=True, eq=False)
class Skill:
    """A skill that was learned.

    Parameters
    ----------
    model : TaskParameterizedGMM
        Fitted.
    demonstrations : sequence of Demonstration
        What it was learned from, as recorded.
    report : str
        What was learned, and all that was remarked, as Markdown.
    """

    model: TaskParameterizedGMM
    demonstrations: Sequence[Demonstration]
    report: str

    @property
    def situations(self) -> list[Situation]:
        """Those of the demonstrations."""
        return [Situation.of(one) for one in self.demonstrations]


@contextmanager
def remarks() -> Iterator[list[str]]:
    """Collect the texts of warnings, each once, instead of printing them."""
    texts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", UserWarning)
        yield texts
    texts += dict.fromkeys(" ".join(str(one.message).split()) for one in caught)


def learn(
    demonstrations: Sequence[Demonstration], robot: Kinematics | None, n_components: int
) -> Skill:
    """Align and learn, as ``tpgmm fit`` does with nothing but its defaults.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        As recorded.
    robot : Kinematics or None
        With the links of interest; None for joints alone.
    n_components : int
        K, the number of Gaussians.

    Raises
    ------
    PlausibilityError, DataError
        If the recordings cannot be what they are said to be.
    """
    begin = time.monotonic()
    links = robot.links if robot is not None else ()
    with remarks() as remarked:
        aligned = DynamicTimeWarping(robot=robot).fit_transform(demonstrations)
        operators = default_operators(links, list(demonstrations[0].frames))
        model = TaskParameterizedGMM(n_components, operators, robot, random_state=0)
        model.fit(aligned)
    lasting = [one.duration for one in demonstrations]
    lines = [
        f"Learned {len(demonstrations)} demonstrations of {min(lasting):.1f} to "
        f"{max(lasting):.1f} s with {n_components} Gaussians, in "
        f"{time.monotonic() - begin:.1f} s.",
        *(f"- `{format_operator(operator)}`" for operator in model.operators_),
    ]
    return Skill(model, demonstrations, "\n".join(lines) + listed(remarked))


def moved(situation: Situation, places: Mapping[str, Sequence[float]]) -> Situation:
    """The situation with objects elsewhere.

    Parameters
    ----------
    situation : Situation
        Where they were.
    places : mapping of str to sequence of float
        By name of a frame that stands still: its new x, y, z [m], and by how much it is turned
        about the vertical through it, from how it stood [deg].

    Raises
    ------
    DataError, UnknownNameError
        If a place is not four finite numbers, or no such object stands still.
    """
    still = {name: one for name, one in situation.frames.items() if not one.batch_shape}
    frames = dict(situation.frames)
    for name, place in places.items():
        if name not in still:
            raise UnknownNameError("object", name, "the situation", still)
        try:
            x, y, z, degrees = map(float, place)
        except (TypeError, ValueError):
            x = y = z = degrees = np.nan
        if not np.isfinite([x, y, z, degrees]).all():
            raise DataError(
                f"{name}: a place is x, y, z in metres and a turn in degrees, got {list(place)}"
            )
        half = np.deg2rad(degrees) / 2
        turn = still[name].orientation.new_tensor([np.cos(half), 0.0, 0.0, np.sin(half)])
        frames[name] = Frame([x, y, z], quaternions.product(turn, still[name].orientation))
    return replace(situation, frames=frames)


def show(
    skill: Skill, situation: Situation, folder: Path, meshes: Path | None = None
) -> tuple[Trajectory, str]:
    """Reproduce the skill, and write what there is to look at and to take away.

    Parameters
    ----------
    skill : Skill
        What was learned.
    situation : Situation
        For what it is reproduced.
    folder : Path
        Gets ``motion.html``, which ``tpgmm view`` would write, ``motion.csv`` with the
        references, and ``model.zip``, which ``TaskParameterizedGMM.load`` takes unpacked.
    meshes : Path, optional
        Folder with the robot's meshes.

    Returns
    -------
    trajectory : Trajectory
        The reproduction.
    report : str
        How new the situation is, and all that was remarked, as Markdown.

    Raises
    ------
    DataError
        If the model knows joints alone, which have no place in space.
    """
    page = folder / "motion.html"
    with remarks() as remarked:
        trajectory = write_motion(
            page, skill.model, situation, skill.demonstrations, meshes=meshes, fps=FPS,
            title="motion",
        )  # fmt: skip
    table = trajectories_to_frame([trajectory], [situation.frames_at(trajectory.time)])
    write_table(table, folder / "motion.csv")
    skill.model.save(folder / "model")
    shutil.make_archive(str(folder / "model"), "zip", folder, "model")
    shutil.rmtree(folder / "model")
    line = f"{float(trajectory.time[-1] - trajectory.time[0]):.1f} s of motion."
    if trajectory.novelty is not None:
        line += (
            f" The situation is {float(trajectory.novelty):.2f} times as far from what was "
            "demonstrated as the demonstration that is furthest from the others."
        )
    return trajectory, line + listed(remarked)


def listed(remarked: Sequence[str]) -> str:
    """Remarks (``remarked``) as a Markdown list that follows other text; empty without any."""
    items = "".join(f"\n- {text}" for text in remarked)
    return f"\n\n**To be looked at:**{items}" if items else ""

"""``tpgmm plot``: pictures of a fitted model."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, Literal

import typer

from tpgmm_tools.arguments import options

if TYPE_CHECKING:
    from tpgmm_torch.operators import Operator
    from tpgmm_torch.robots.kinematics import Kinematics


app = typer.Typer()

EXAMPLE = "tpgmm plot out/model --dataset out/demo/dataset --joint l_elbow --out out/pictures"


@options.command(app, EXAMPLE)
def plot(
    model: Path,
    *,
    dataset: str,
    out: Path,
    data: options.DataOptions,
    joint: list[str] | None = None,
    format_: Literal["png", "pdf", "svg"] = "png",
    alignment: options.Alignments = "dtw",
) -> None:
    """Draw a fitted model.

    For every operator a picture of its coordinates over time: the demonstrations (black), the
    components (green), and the reproduction in the situation of the first episode (orange).

    Parameters
    ----------
    model : ``DIR``
        A model that 'tpgmm fit' saved.
    dataset : str
        A LeRobot data set: its folder, or hf://datasets/OWNER/NAME.
    out : ``FOLDER``
        Where the pictures go.
    joint : str
        Also draw each operator's estimate of this joint; repeatable.
    format_ : str
        Pixels, or vectors for print.
    alignment : str
        How episodes are brought onto one clock, as for 'tpgmm fit'.
    """
    from tpgmm_control.loop.rollout import rollout
    from tpgmm_tools.plotting import figure, legend, plot_candidates, plot_local, save
    from tpgmm_torch.data.demonstrations import Situation
    from tpgmm_torch.exceptions import UnknownNameError
    from tpgmm_torch.operators.text import format_operator
    from tpgmm_torch.persistence import load_model

    fitted = load_model(model, device="cpu")
    kinematics = fitted.kinematics_
    for name in joint or ():
        if name not in kinematics.joint_names:
            raise UnknownNameError("joint", name, "the model", kinematics.joint_names)
    demonstrations = options.align(data.read(dataset, kinematics), alignment, kinematics)
    situation = Situation.of(demonstrations[0])
    skill: Any = fitted.skill
    [trajectory] = rollout(skill, [situation], bounds="robot", blend=1.0, candidates=True)
    motion: Any = trajectory, situation.frames_at(trajectory.time.cpu()), {}
    drawings = {}
    labels = [fill(format_operator(operator), 60) for operator in fitted.operators_]
    for index, operator in enumerate(fitted.operators_):
        names = coordinate_names(operator, kinematics)
        drawings[f"operator_{index + 1}"] = drawing = figure(
            len(names), labels[index], height=1.3
        )
        for column, (axes, name) in enumerate(zip(drawing.axes, names, strict=True)):
            plot_local(axes, fitted, index, column, demonstrations, [motion])
            axes.set_ylabel(name, fontsize="small")
    for name in joint or ():
        title = f"{name}: each operator's estimate, and the result"
        drawings[f"joint_{name}"] = drawing = figure(1, title, height=3.2)
        plot_candidates(drawing.axes[0], trajectory, name, labels)
    out.mkdir(parents=True, exist_ok=True)
    for name, drawing in drawings.items():
        legend(drawing)
        typer.echo(save(drawing, out / f"{name}.{format_}"))


def coordinate_names(operator: Operator, kinematics: Kinematics) -> list[str]:
    """Return a label for each local coordinate of an operator.

    Parameters
    ----------
    operator, kinematics : Operator, Kinematics
        Whose coordinates, for which robot.
    """
    return [name for one in operator.leaves for name in _leaf_names(one, kinematics)]


def _leaf_names(operator: Any, kinematics: Kinematics) -> list[str]:
    """Label joints and forces, and leave all else to those of poses."""
    names, link = kinematics.joint_names, (*operator.links(), "")[0]
    if operator.is_posture:
        return [names[column] for column in operator.columns(names)]
    if operator.constrains_joints:
        return _pose_names(operator, kinematics, link)
    forces = [f"{link}\nforce {'xyz'[axis]} [N]" for axis in operator.axes or ()]
    return [*forces, f"{link}\ncontact"]


def _pose_names(operator: Operator, kinematics: Kinematics, link: str) -> list[str]:
    """Label metres, parts of rotation vectors and of quaternions, and number all else."""
    count = operator.dimension(kinematics)
    if operator.units(kinematics) == ("m",) * 3:
        return [f"{link}\n{axis} [m]" for axis in "xyz"]
    if count == 3 and operator.rotation_vector_starts(kinematics) == (0,):
        return [f"{link}\nrotation {axis} [rad]" for axis in "xyz"]
    if count == 4 and operator.quaternion_starts(kinematics) == (0,):
        return [f"{link}\nq{part}" for part in "wxyz"]
    return [f"coordinate {i + 1}" for i in range(count)]

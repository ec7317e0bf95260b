"""``tpgmm plot``: pictures of a fitted model."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import Any, Literal

import typer

from tpgmm_tools.arguments import options

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
    from tpgmm_tools import plotting
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
        names = plotting.coordinate_names(operator, kinematics)
        drawings[f"operator_{index + 1}"] = drawing = plotting.figure(
            len(names), labels[index], height=1.3
        )
        for column, (axes, name) in enumerate(zip(drawing.axes, names, strict=True)):
            plotting.plot_local(axes, fitted, index, column, demonstrations, [motion])
            axes.set_ylabel(name, fontsize="small")
    for name in joint or ():
        title = f"{name}: each operator's estimate, and the result"
        drawings[f"joint_{name}"] = drawing = plotting.figure(1, title, height=3.2)
        plotting.plot_candidates(drawing.axes[0], trajectory, name, labels)
    out.mkdir(parents=True, exist_ok=True)
    for name, drawing in drawings.items():
        plotting.legend(drawing)
        typer.echo(plotting.save(drawing, out / f"{name}.{format_}"))

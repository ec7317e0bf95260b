"""Figures 3 to 6 of the paper, drawn from a run of the experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tpgmm_tools.plotting import BLUE, figure, legend, plot_candidates, plot_local, save, shade
from tpgmm_torch import Demonstration, Situation, TaskParameterizedGMM, Trajectory


def draw_figures(
    out: Path,
    model: TaskParameterizedGMM,
    demonstrations: Sequence[Demonstration],
    reproduction: Trajectory,
    position_only: Trajectory,
    situation: Situation,
    spans: Mapping[str, tuple[float, float]],
    formats: Sequence[str] = ("png", "pdf"),
) -> list[Path]:
    """Write ``figure_3`` to ``figure_6``, for screens and, in vectors, for print.

    Parameters
    ----------
    out : Path
        Directory.
    model : TaskParameterizedGMM
        With the operators of eqs (16), (17).
    demonstrations : sequence of Demonstration
        Aligned.
    reproduction, position_only : Trajectory
        Of the model, with candidates, and of the one without orientation.
    situation : Situation
        In which both were made.
    spans : mapping of str to (float, float)
        Phases to shade [s].
    formats : sequence of str
        Suffixes: each figure is written in each.

    Returns
    -------
    list of Path
    """
    other = {"color": BLUE, "linestyle": "--", "label": "position only"}
    solid: tuple[Any, Any, Any] = (reproduction, situation.frames, {})
    dashed = (position_only, situation.frames, other)
    joints = reproduction.joint_names
    seen = "seen from the bottle's initial frame"
    shown_joints = ("waist_pitch", "waist_yaw", "l_shoulder_pitch")
    position = {f"$x_{i + 1}$ [m]": i for i in range(3)}
    orientation = {rf"$\epsilon_{i}$": 3 + i for i in range(4)}
    angles = {f"{name} [rad]": joints.index(name) for name in shown_joints}
    panels: dict[str, tuple[str, int, dict[str, int], list[Any]]] = {
        "figure_3": (f"Left hand's position {seen}", 0, position, [solid]),
        "figure_4": (f"Left hand's orientation {seen}", 0, orientation, [solid, dashed]),
        "figure_5": ("Waist and left shoulder", 1, angles, [solid]),
    }
    drawings = {}
    for name, (title, operator, columns, shown) in panels.items():
        drawing = figure(len(columns), title)
        for axes, (label, column) in zip(drawing.axes, columns.items(), strict=True):
            shade(axes, spans)
            plot_local(axes, model, operator, column, demonstrations, shown)
            axes.set_ylabel(label)
        drawings[name] = drawing
    drawings["figure_6"] = figure(
        1,
        "Left shoulder: what each operator asks for (bands: one standard deviation), "
        "and the result",
        height=3.2,
    )
    [axes] = drawings["figure_6"].axes
    shade(axes, spans)
    plot_candidates(axes, reproduction, "l_shoulder_pitch", ("bottle", "canonical"))
    for drawing in drawings.values():
        for axes in drawing.axes:
            axes.set_xlim(float(model.time_[0]), float(model.time_[-1]))
        legend(drawing)
    return [
        save(drawing, out / f"{name}.{form}")
        for name, drawing in drawings.items()
        for form in formats
    ]

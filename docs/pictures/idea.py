"""Pictures of the page "The idea"."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import planar
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from tpgmm_tools.plotting import OPERATORS, plot_candidates, shade
from tpgmm_torch import Demonstration, TaskParameterizedGMM, Trajectory

__all__ = ["draw"]

(TASK, _), (JOINTS, _), *_ = OPERATORS
RESULT, PAST = "black", "0.75"
PHASES = {"touch": (0.7, planar.TOUCH + 0.1), "wave": (planar.WAVE, planar.END)}
#: One instant of each phase [s].
INSTANTS = {"while it touches the object": planar.TOUCH, "while it waves": 3.1}


def draw(out: Path) -> None:
    """Write ``agreement.svg``, ``fusion.svg``, ``reproduction.svg``."""
    for picture in (agreement, fusion, reproduction):
        picture().savefig(out / f"{picture.__name__}.svg")


@cache
def learned() -> tuple[list[Demonstration], TaskParameterizedGMM, Trajectory]:
    """The demonstrations, the model, and its reproduction in a new situation."""
    skill = planar.demonstrations()
    model = planar.model(skill)
    [trajectory] = model.predict([planar.situation()])
    return skill, model, trajectory


def agreement() -> Figure:
    """Where demonstrations agree: seen from the object, and in the joints."""
    skill, _, _ = learned()
    drawing = Figure(figsize=(8.4, 3.9), layout="constrained")
    left, upper, lower = (drawing.add_subplot(2, 2, place) for place in ((1, 3), 2, 4))
    for demonstration in skill:
        place = demonstration.frame("object").position[:2]
        at = round(planar.TOUCH * planar.STEPS_PER_SECOND)
        arm(left, demonstration.joints[at], color="0.6", linewidth=1.5)
        left.plot(*place, "o", color=TASK, markersize=9, markerfacecolor="none")
        hands = planar.arm().state(demonstration.joints).position("hand")
        seen = torch.linalg.vector_norm(hands[:, :2] - place, dim=1)
        upper.plot(demonstration.time, 100 * seen, color=TASK, linewidth=1)
        lower.plot(demonstration.time, demonstration.joints[:, 0], color=JOINTS, linewidth=1)
    left.set(title="six demonstrations, at the touch", aspect="equal", xlabel="x [m]")
    left.set_ylabel("y [m]")
    upper.set(title="distance of hand and object", ylabel="[cm]")
    lower.set(title="angle of the shoulder", ylabel="[rad]", xlabel="time [s]")
    upper.sharex(lower)
    for axes in (upper, lower):
        axes.margins(x=0)
        for start, end in PHASES.values():
            axes.axvspan(start, end, color="0.92", zorder=0, linewidth=0)
    return drawing


def fusion() -> Figure:
    """The joint space at two instants: two candidates and their product."""
    _, model, trajectory = learned()
    drawing = Figure(figsize=(8.4, 3.9), layout="constrained")
    for axes, (title, instant) in zip(drawing.subplots(1, 2), INSTANTS.items(), strict=True):
        step = int(torch.searchsorted(trajectory.time, instant))
        before = trajectory.joints[step - 1]
        estimate = model.step(instant, before, planar.situation().frames, candidates=True)
        task, joints = estimate.candidates
        for name, color, mean, covariance in (
            ("what the object asks for", TASK, task.mean, task.covariance),
            ("what the joints ask for", JOINTS, joints.mean, joints.covariance),
            ("their product", RESULT, estimate.joints, estimate.covariance),
        ):
            ellipse(axes, mean.numpy(), covariance.numpy(), color, name)
        low, high = estimate.joints - 0.6, estimate.joints + 0.6
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set(title=title, xlabel="shoulder [rad]")
    drawing.axes[0].set_ylabel("elbow [rad]")
    drawing.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return drawing


def reproduction() -> Figure:
    """A new situation: the arm over time, and the candidates of its shoulder."""
    _, _, trajectory = learned()
    drawing = Figure(figsize=(8.4, 3.6), layout="constrained")
    left, right = drawing.subplots(1, 2, width_ratios=(1, 1.5))
    touch = round(planar.TOUCH * planar.STEPS_PER_SECOND)
    for step in range(0, touch, 7):
        arm(left, trajectory.joints[step], color=PAST, linewidth=1)
    arm(left, trajectory.joints[touch], color=RESULT, linewidth=2)
    place = planar.situation().frames["object"].position
    left.plot(*place[:2], "o", color=TASK, markersize=9, markerfacecolor="none", zorder=5)
    left.set(title="an object never seen", aspect="equal", xlabel="x [m]", ylabel="y [m]")
    shade(right, PHASES)
    plot_candidates(right, trajectory, "q1", ("object", "joints"))
    right.set(ylabel="shoulder [rad]", xlabel="time [s]", ylim=(-1.6, 1.8))
    right.margins(x=0)
    right.legend(fontsize="small", loc="lower right", handlelength=3.5)
    return drawing


def arm(axes: Axes, joints: torch.Tensor, **style: Any) -> None:
    """The arm as two lines."""
    axes.plot(*planar.chain(joints).T, marker="o", markersize=3, **style)


def ellipse(
    axes: Axes, mean: np.ndarray, covariance: np.ndarray, color: str, label: str
) -> None:
    """Contour of two standard deviations; of the result the line alone."""
    variances, directions = np.linalg.eigh(covariance)
    angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
    small, large = 4 * np.sqrt(variances)
    result = color == RESULT
    axes.add_patch(
        Ellipse(
            mean,
            large,
            small,
            angle=angle,
            label=label,
            edgecolor=color,
            facecolor="none" if result else to_rgba(color, 0.2),
            linestyle="--" if result else "-",
            linewidth=1.5,
        )
    )
    axes.plot(*mean, "+", color=color)

"""Curves over time beside a scene: stiffness, shares of the operators, holds; and marks."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

from tpgmm_control.impedance.stiffness import Impedance
from tpgmm_tools.plotting import operator_labels
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.operators.base import of_joints
from tpgmm_torch.robots.kinematics import Kinematics

#: Of stiffness: the ellipsoids' colour, as both show the covariance.
STIFFNESS = "#1f77b4"
#: Of the operators; none is the reproduced path's or the ellipsoids'.
OPERATORS = ("#ff7f0e", "#9467bd", "#17becf", "#bcbd22", "#e377c2")


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves over one time axis, which are not negative.

    Parameters
    ----------
    title : str
        What they show, with its unit.
    time : ndarray of shape (T,)
        Since the start of the motion [s].
    curves : sequence of (str, ndarray of shape (T,))
        In one unit, with their names; "" if the title says it all.
    top : float
        Where the vertical axis ends, which begins at 0.
    """

    title: str
    time: Array
    curves: Sequence[tuple[str, Array]]
    top: float


@dataclass(frozen=True)
class Mark:
    """An instant with a name.

    Parameters
    ----------
    time : float
        Since the start of the motion [s].
    label : str
        Name of the event.
    """

    time: float
    label: str


def motion_marks(model: TaskParameterizedGMM, trajectory: Trajectory) -> list[Mark]:
    """Return events of the demonstrations within a motion, by time.

    Parameters
    ----------
    model : TaskParameterizedGMM
        Fitted. The events are those that all of its demonstrations name.
    trajectory : Trajectory
        A reproduction by this model.
    """
    begin, end = float(model.time_[0]), float(model.time_[-1])
    summary = model.skill.summary
    shown = {} if summary is None else summary.events
    named = [(begin + share * (end - begin), name) for name, share in shown.items()]
    first, last = float(trajectory.time[0]), float(trajectory.time[-1])
    return [Mark(at - first, label) for at, label in sorted(named) if first <= at <= last]


def motion_panels(model: TaskParameterizedGMM, trajectory: Trajectory) -> list[Panel]:
    """Compute stiffness and the operators' shares, over time.

    Parameters
    ----------
    model : TaskParameterizedGMM
        Fitted.
    trajectory : Trajectory
        A reproduction by this model, with candidates.

    Returns
    -------
    list of Panel
        The stiffness that ``Impedance(robot)`` gives the joints that turn, their mean; left
        out where none does, as of tracked poses. The :attr:`Candidate.share` of each operator,
        the mean of all joints. Whether an object is held, where any is.
    """
    time = as_array(trajectory.time - trajectory.time[0])
    panels = []
    if turning := turning_joints(model.kinematics_):
        matrix = Impedance(model.kinematics_).joints.matrix(trajectory.covariance)
        stiffness = as_array(matrix.diagonal(dim1=-2, dim2=-1)[:, turning].mean(-1))
        title = "stiffness, mean of the joints [N m/rad]"
        panels.append(Panel(title, time, [("", stiffness)], float(stiffness.max())))
    labels = operator_labels(of_joints(model.operators_))
    shares = [as_array(100 * candidate.share.mean(-1)) for candidate in trajectory.candidates]
    title = "share of each operator, mean of the joints [%]"
    panels.append(Panel(title, time, [*zip(labels, shares, strict=True)], 100.0))
    if model.holds_:
        skill = as_array(trajectory.time)
        names = [f"{one.frame} by {one.link}" for one in model.holds_]
        held = [
            ((one.begin <= skill) & (skill <= one.end)).astype(float) for one in model.holds_
        ]
        panels.append(Panel("held", time, [*zip(names, held, strict=True)], 1.0))
    return panels


def turning_joints(kinematics: Kinematics) -> list[int]:
    """Return indices of joints of some ``kinematics`` in rad: no quaternions, no lengths."""
    others = {*kinematics.lengths}
    for start in kinematics.quaternion_starts:
        others.update(range(start, start + 4))
    return [joint for joint in range(kinematics.n_joints) if joint not in others]


def as_html(panels: Sequence[Panel], marks: Sequence[Mark] = ()) -> str:
    """Write panels as a part of a page, to be folded away; a marker follows the time line.

    Drawings have seconds and the curves' own units for coordinates, upwards.

    Parameters
    ----------
    panels : sequence of Panel
        One below the other.
    marks : sequence of Mark
        Dashed lines through all of them, named below.
    """
    end = panels[0].time[-1]
    follow = Path(__file__).with_name("follow.js").read_text(encoding="utf-8")
    drawn = "".join(_figure(panel, marks) for panel in panels)
    drawn += "".join(
        f'<div class="row"><span>&#9478; {html.escape(mark.label)}</span>'
        f"<span>{mark.time:.1f} s</span></div>"
        for mark in marks
    )
    return (
        '<details id="curves" open><summary>curves over time</summary>'
        f'{drawn}<div class="row"><span>0 s</span><span>{end:.1f} s</span></div></details>'
        f"<script>{follow.replace('END', f'{end:.6g}')}</script>"
    )


def _figure(panel: Panel, marks: Sequence[Mark]) -> str:
    end, top = max(float(panel.time[-1]), 1e-3), panel.top
    marked = "".join(
        f'<line class="mark" x1="{mark.time:.6g}" x2="{mark.time:.6g}" y2="{top:.6g}">'
        f"<title>{html.escape(mark.label)}</title></line>"
        for mark in marks
    )
    lines = names = ""
    for (label, values), color in zip(panel.curves, cycle(OPERATORS), strict=False):
        shown = color if label else STIFFNESS
        points = " ".join(
            f"{at:.6g},{value:.6g}" for at, value in zip(panel.time, values, strict=True)
        )
        lines += f'<polyline stroke="{shown}" points="{points}"/>'
        if label:
            text = html.escape(label)
            names += f'<div><span style="color:{shown}">&#9632;</span> {text}</div>'
    return (
        f'<div class="row"><span>{html.escape(panel.title)}</span><span>{top:.0f}</span></div>'
        f'<svg viewBox="0 0 {end:.6g} {top:.6g}" preserveAspectRatio="none">'
        f'<g transform="translate(0 {top:.6g}) scale(1 -1)">{lines}{marked}'
        f'<line class="now" y2="{top:.6g}" visibility="hidden"/></g></svg>{names}'
    )

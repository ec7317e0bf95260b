"""A page about a fitted model: how exact it is, who decides when, what is near its limits."""

from __future__ import annotations

import base64
import html
import io
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.base import clone

from tpgmm_tools.hub.model_card import describe
from tpgmm_tools.plotting import figure, legend, plot_candidates, save
from tpgmm_tools.viewing import write_motion
from tpgmm_torch.atomic import replacing
from tpgmm_torch.control.rollout import rollout
from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.data.demonstrations import FEWEST, Demonstration, Situation
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.metrics import joint_rmse, pose_errors
from tpgmm_torch.operators.text import format_operator

__all__ = ["LeftOut", "leave_one_out", "write_report"]

#: Joints whose candidates are drawn: those that move most.
DRAWN = 4
#: A joint is near its limit within this share of its range, or of its speed.
NEAR = 0.1
STYLE = """
:root{color-scheme:light dark}
body{font:16px/1.5 system-ui,sans-serif;max-width:60em;margin:auto;padding:1em}
table{border-collapse:collapse;display:block;overflow-x:auto}
td,th{padding:.2em .8em;text-align:left;border-bottom:1px solid #8884}
img,iframe{max-width:100%;width:100%;border:0;background:#fff}iframe{height:32em}
.near{color:#d55e00;font-weight:bold}
"""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A demonstration that the model was learned without, and its reproduction.

    Parameters
    ----------
    index : int
        Of the demonstration.
    novelty : float
        Of its situation to the others.
    errors : dict of (str, str) to (float, float)
        Distance [mm] and angle [deg] of a link at an event, by link and event.
    path : float
        Root mean square error of the joints along the path [rad].
    """

    index: int
    novelty: float
    errors: Mapping[tuple[str, str], tuple[float, float]]
    path: float


def leave_one_out(
    model: TaskParameterizedGMM,
    demonstrations: Sequence[Demonstration],
    most: int = 10,
    progress: Callable[[int, int], None] | None = None,
) -> list[LeftOut]:
    """Learn without one demonstration, reproduce it, and measure, for each of them.

    Parameters
    ----------
    model : TaskParameterizedGMM
        Its parameters count, whether it is fitted or not.
    demonstrations : sequence of Demonstration
        Aligned, with holds.
    most : int, default=10
        Of more demonstrations, this number of them, evenly chosen, are left out.
    progress : callable, optional
        Called with the number that is done and of all.

    Raises
    ------
    DataError
        If there are fewer than three.
    """
    count = len(demonstrations)
    if count <= FEWEST:
        raise DataError(
            f"to leave one out takes {FEWEST + 1} demonstrations, there are {count}"
        )
    chosen = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()
    found = []
    for done, index in enumerate(chosen):
        shown = demonstrations[index]
        rest = [one for number, one in enumerate(demonstrations) if number != index]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            fitted = clone(model).fit(rest)
            situation = Situation.of(shown, shown.time)
            [trajectory] = fitted.predict([situation], candidates=False)
        errors = {}
        for link in fitted.kinematics_.links:
            for event, time in _instants(shown).items():
                error = pose_errors(trajectory, shown, fitted.kinematics_, link, time)
                errors[link, event] = float(error.position), float(error.angle)
        novelty = np.nan if trajectory.novelty is None else float(trajectory.novelty)
        path = joint_rmse(trajectory, shown.reordered(fitted.kinematics_.joint_names))
        found.append(LeftOut(index, novelty, errors, path))
        if progress is not None:
            progress(done + 1, len(chosen))
    return found


def _instants(shown: Demonstration) -> dict[str, float]:
    """When a link's pose matters: events, and begin and end of holds."""
    ends = {"end": float(shown.time[-1])}
    holds = {
        f"{hold.frame} is {what}": at
        for hold in shown.holds or ()
        for what, at in (("taken", hold.begin), ("let go", hold.end))
        if shown.time[0] < at < shown.time[-1]
    }
    return {**shown.events, **holds, **ends}


def write_report(
    path: str | Path,
    model: TaskParameterizedGMM,
    demonstrations: Sequence[Demonstration],
    *,
    situation: int = 0,
    most: int = 10,
    title: str = "tpgmm",
    progress: Callable[[int, int], None] | None = None,
    **how: Any,
) -> list[LeftOut]:
    """Write what is to be known of a model as one HTML file that needs nothing else.

    Parameters
    ----------
    path : str or Path
        The file; replaced if it exists.
    model : TaskParameterizedGMM
        Fitted.
    demonstrations : sequence of Demonstration
        What it was learned from, aligned, with holds.
    situation : int, default=0
        The demonstration whose situation is shown.
    most, progress
        As for :func:`leave_one_out`.
    title : str, default="tpgmm"
        Of the page.
    **how
        ``objects`` and ``meshes``, as for :func:`~tpgmm_tools.viewing.write_motion`.

    Returns
    -------
    list of LeftOut
    """
    left_out = leave_one_out(model, demonstrations, most, progress)
    situations = [Situation.of(one) for one in demonstrations]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        motions = [
            rollout(model.skill, [one], bounds="robot", blend=1.0, candidates=True)[0]
            for one in situations
        ]
    joints, near = _joints(model, motions)
    sections = {
        "At a glance": _list(_glance(left_out, near)),
        "The motion": _moving(model, situations[situation], demonstrations, how),
        "How exact it is": _exactness(left_out),
        "Who decides, and when": _decides(model, motions[situation]),
        "Joints and their limits": joints,
        "Each demonstration": _demonstrations(left_out, demonstrations),
    }
    parts = [f"<h2>{html.escape(name)}</h2>{text}" for name, text in sections.items() if text]
    page = (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title>"
        f'<meta name=viewport content="width=device-width"><style>{STYLE}</style>'
        f"<h1>{html.escape(title)}</h1>{''.join(parts)}{_described(model)}</html>"
    )
    with replacing(path) as new:
        new.write_text(page, encoding="utf-8")
    return left_out


def _glance(left_out: Sequence[LeftOut], near: Sequence[str]) -> Iterator[str]:
    """The sentences that a reader needs first."""
    worst: dict[str, list[float]] = {}
    for one in left_out:
        for (_, event), (distance, _) in one.errors.items():
            worst.setdefault(event, []).append(distance)
    each = [
        f"{np.median(distances):.2g} mm at '{event}' (90 %: {np.quantile(distances, 0.9):.2g})"
        for event, distances in worst.items()
    ]
    if each:
        yield (
            "In situations that were not learned from, hands are off where they were shown by "
            f"{', '.join(each)}: medians."
        )
    new = [str(one.index) for one in left_out if one.novelty > 1.5]
    if new:
        yield f"Unlike the others: demonstrations {', '.join(new)}. Look at them."
    yield from near or ["No joint comes near its limits of position or speed."]


def _exactness(left_out: Sequence[LeftOut]) -> str:
    """Errors by link and event, over the demonstrations that were left out."""
    keys = dict.fromkeys(key for one in left_out for key in one.errors)
    rows = []
    for link, event in keys:
        pairs = [one.errors[link, event] for one in left_out if (link, event) in one.errors]
        (mm, deg), (mm_90, deg_90) = np.quantile(pairs, [0.5, 0.9], axis=0)
        rows.append(
            [link, event, f"{mm:.2g} / {mm_90:.2g}", f"{deg:.2g} / {deg_90:.2g}", len(pairs)]
        )
    paths = np.array([one.path for one in left_out])
    text = (
        f"<p>Each of {len(left_out)} demonstrations was left out once, the model learned from "
        "the others, and reproduced in its situation. Median / 90 %. Along the path the joints "
        f"are {np.median(paths):.3f} rad off (root mean square).</p>"
    )
    return text + _table(["link", "at", "mm", "deg", "of"], rows) if rows else text


def _decides(model: TaskParameterizedGMM, trajectory: Trajectory) -> str:
    """Figure 6 of the paper, for the joints that move most."""
    moves = np.ptp(as_array(trajectory.joints), axis=0)
    chosen = np.sort(np.argsort(moves)[-DRAWN:])
    drawing = figure(len(chosen), "", height=1.6)
    labels = [format_operator(one)[:60] for one in model.operators_]
    for axes, joint in zip(drawing.axes, chosen, strict=True):
        name = trajectory.joint_names[joint]
        plot_candidates(axes, trajectory, name, labels)
        axes.set_ylabel(name, fontsize="small")
    legend(drawing)
    return (
        "<p>Each operator's estimate of a joint, with one standard deviation, and the result "
        f"in black: the operator with the narrow band decides.</p>{_picture(drawing)}"
    )


def _joints(
    model: TaskParameterizedGMM, motions: Sequence[Trajectory]
) -> tuple[str, list[str]]:
    """Ranges and speeds of the joints, and sentences about those near their limits."""
    robot, rows, near = model.kinematics_, [], []
    joints = [as_array(one.joints) for one in motions]
    speeds = [
        np.abs(np.gradient(one, as_array(motion.time), axis=0)).max(0)
        for one, motion in zip(joints, motions, strict=True)
    ]
    low, high = (as_array(one) for one in (robot.lower, robot.upper))
    least, most = (
        np.min([one.min(0) for one in joints], 0),
        np.max([one.max(0) for one in joints], 0),
    )
    fastest, limit = np.max(speeds, axis=0), as_array(robot.velocity)
    for j, name in enumerate(robot.joint_names):
        room = min(least[j] - low[j], high[j] - most[j])
        close = np.isfinite(room) and room < NEAR * (high[j] - low[j])
        fast = fastest[j] > (1 - NEAR) * limit[j]
        if close:
            near.append(f"{name} comes within {room:.3f} of its limit of position.")
        if fast:
            near.append(
                f"{name} moves with {fastest[j]:.2f} of at most {limit[j]:.2f} per second."
            )
        rows.append([
            name, f"{least[j]:.2f} to {most[j]:.2f}", f"{low[j]:.2f} to {high[j]:.2f}",
            f"{fastest[j]:.2f}", f"{limit[j]:.2f}", "near" if close or fast else "",
        ])  # fmt: skip
    head = ["joint", "moves", "may", "fastest", "limit", ""]
    return "<p>rad or m, and per second, in all demonstrated situations.</p>" + _table(
        head, rows
    ), near


def _demonstrations(
    left_out: Sequence[LeftOut], demonstrations: Sequence[Demonstration]
) -> str:
    rows = [
        [
            one.index,
            f"{demonstrations[one.index].duration:.2f}",
            f"{one.novelty:.2f}",
            f"{one.path:.3f}",
            f"{max((mm for mm, _ in one.errors.values()), default=np.nan):.1f}",
        ]
        for one in left_out
    ]
    text = (
        "<p>Novelty is the distance of its situation from the others; about 1 is usual, above "
        "1.5 it is unlike them.</p>"
    )
    return text + _table(["", "s", "novelty", "path [rad]", "worst event [mm]"], rows)


def _moving(
    model: TaskParameterizedGMM,
    situation: Situation,
    demonstrations: Sequence[Demonstration],
    how: Mapping[str, Any],
) -> str:
    """The moving picture; nothing for a model without links."""
    if not model.kinematics_.links:
        return ""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "motion.html"
        write_motion(place, model, situation, demonstrations, **how)
        page = html.escape(place.read_text(encoding="utf-8"), quote=True)
    return f'<iframe title="the motion" loading=lazy srcdoc="{page}"></iframe>'


def _described(model: TaskParameterizedGMM) -> str:
    """What a card says of the model."""
    from markdown_it import MarkdownIt

    text = describe(model).replace("## Measured\n\nNothing was stated.\n\n", "")
    rendered: str = MarkdownIt("commonmark").enable("table").render(text)
    return rendered


def _picture(drawing: Any) -> str:
    buffer = io.BytesIO()
    save(drawing, buffer)  # type: ignore[arg-type]
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img alt="candidates of joints over time" src="data:image/png;base64,{data}">'


def _list(lines: Iterator[str]) -> str:
    return f"<ul>{''.join(f'<li>{html.escape(line)}' for line in lines)}</ul>"


def _table(head: Sequence[object], rows: Sequence[Sequence[object]]) -> str:
    lines = ["".join(f"<th>{html.escape(str(one))}" for one in head)]
    lines += ["".join(f"<td>{html.escape(str(one))}" for one in row) for row in rows]
    return f"<table><tr>{'<tr>'.join(lines)}</table>"

"""A page about a fitted model: how exact it is, who decides when, what is near its limits."""

from __future__ import annotations

import base64
import html
import io
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from textwrap import fill
from typing import Any

import numpy as np
from sklearn.base import clone

from tpgmm_control.loop.rollout import rollout
from tpgmm_control.obstacles import Contact, Scene, find_contacts
from tpgmm_tools.plotting import figure, legend, operator_labels, plot_candidates, save
from tpgmm_tools.viewing import write_motion
from tpgmm_tools.viewing.curves import motion_marks, turning_joints
from tpgmm_torch.atomic import replacing
from tpgmm_torch.checks.summary import UNLIKELY
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import FEWEST, Demonstration, Situation
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.hub.model_card import sections
from tpgmm_torch.metrics import joint_rmse, largest_speeds, pose_errors
from tpgmm_torch.operators.base import of_joints

#: Joints whose candidates are drawn: those that move most.
DRAWN = 4
#: A joint is near its limit within this share of its range, or of its speed.
NEAR = 0.1


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
        path = joint_rmse(trajectory, shown.reorder(fitted.kinematics_.joint_names))
        found.append(LeftOut(index, novelty, errors, path))
        if progress is not None:
            progress(done + 1, len(chosen))
    return found


def _instants(shown: Demonstration) -> dict[str, float]:
    """Return when a link's pose matters: events, and begin and end of holds."""
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
        ``objects``, ``meshes`` and ``obstacles``, as for
        :func:`~tpgmm_tools.viewing.write_motion`. What touches obstacles is listed.

    Returns
    -------
    list of LeftOut
    """
    from markdown_it import MarkdownIt

    left_out = leave_one_out(model, demonstrations, most, progress)
    situations = [Situation.of(one) for one in demonstrations]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        motions = [
            rollout(model.skill, [one], bounds="robot", blend=1.0, candidates=True)[0]
            for one in situations
        ]
    joints, near = _joints(model, motions)
    touching, touched = _obstacles(model, situations, motions, how.get("obstacles"))
    render = MarkdownIt("commonmark").enable("table").render
    understood, shares, limits, _, learning = map(render, sections(model).values())
    parts = {
        "At a glance": _list([*_glance(left_out), *near, *touching]),
        "What was understood": understood + _events(model, motions[situation]),
        "The motion": _moving(model, situations[situation], demonstrations, title, how),
        "How exact it is": _exactness(left_out),
        "Who decides, and when": _decides(model, motions[situation]) + shares,
        "Joints and their limits": joints,
        "Obstacles": touched,
        "Each demonstration": _demonstrations(left_out),
        "Where it fails": limits,
        "How it was learned": learning,
    }
    text = "".join(f"<h2>{name}</h2>{part}" for name, part in parts.items() if part)
    page = Template(Path(__file__).with_name("report.html").read_text(encoding="utf-8"))
    with replacing(path) as new:
        filled = page.substitute(title=html.escape(title), text=text)
        new.write_text(filled, encoding="utf-8")
    return left_out


def contacts(
    scene: Scene,
    motions: Iterable[Trajectory],
    situations: Iterable[Situation],
    holds: Sequence[Hold],
) -> Iterator[tuple[int, Contact]]:
    """Find contacts in motions, each in its situation, with the number of the motion.

    Parameters
    ----------
    scene : Scene
        With the obstacles.
    motions, situations : iterable of Trajectory, iterable of Situation
        As many of each.
    holds : sequence of Hold
        What the robot holds meanwhile.
    """
    for number, (one, situation) in enumerate(zip(motions, situations, strict=True)):
        frames = situation.frames_at(one.time.cpu())
        for contact in find_contacts(scene, one.time, one.joints, frames, holds):
            yield number, contact


def _quantiles(
    left_out: Sequence[LeftOut], first: int
) -> Iterator[tuple[tuple[str, ...], Array, int]]:
    """Compute medians and 90th percentiles of errors, by link and event or the event alone.

    Yields the place (from its ``first`` part on), mm and degrees of each, and their number.
    """
    at: dict[tuple[str, ...], list[tuple[float, float]]] = {}
    for one in left_out:
        for place, errors in one.errors.items():
            at.setdefault(place[first:], []).append(errors)
    for where, pairs in at.items():
        yield where, np.quantile(pairs, [0.5, 0.9], axis=0), len(pairs)


def _glance(left_out: Sequence[LeftOut]) -> Iterator[str]:
    """Say how large errors at events are, and which episodes are unlike the others."""
    for [event], ((mm, deg), (most, _)), _ in _quantiles(left_out, 1):
        yield (
            f"At '{event}' links are {mm:.2g} mm and {deg:.2g} deg from where an episode that "
            f"was left out has them (median; 90\u00a0% within {most:.2g} mm)."
        )
    path = np.median([one.path for one in left_out])
    yield f"Along the path its joints are {path:.3f} rad or m off (root mean square, median)."
    new = [str(one.index) for one in left_out if one.novelty > UNLIKELY]
    if new:
        yield f"Unlike the others, look at them: episodes {', '.join(new)}."


def _events(model: TaskParameterizedGMM, trajectory: Trajectory) -> str:
    marks = motion_marks(model, trajectory)
    text = ", ".join(f"{html.escape(one.label)} at {one.time:.2f} s" for one in marks)
    return f"<p>Events: {text or 'none'}.</p>"


def _exactness(left_out: Sequence[LeftOut]) -> str:
    """Show errors by link and event, over the demonstrations that were left out."""
    rows = [
        [*place, f"{mm:.2g} / {mm_90:.2g}", f"{deg:.2g} / {deg_90:.2g}", count]
        for place, ((mm, deg), (mm_90, deg_90)), count in _quantiles(left_out, 0)
    ]
    text = (
        f"<p>Each of {len(left_out)} episodes was left out once, the model learned from the "
        "others, and reproduced in its situation: median / 90th percentile.</p>"
    )
    return text + (_table(["link", "at", "mm", "deg", "episodes"], rows) if rows else "")


def _decides(model: TaskParameterizedGMM, trajectory: Trajectory) -> str:
    """Draw figure 6 of the paper, for the joints that move most."""
    moves = np.ptp(as_array(trajectory.joints), axis=0)
    chosen = np.sort(np.argsort(moves)[-DRAWN:])
    drawing = figure(len(chosen), "", height=1.6)
    labels = [fill(text, 40) for text in operator_labels(of_joints(model.operators_))]
    for axes, joint in zip(drawing.axes, chosen, strict=True):
        name = trajectory.joint_names[joint]
        plot_candidates(axes, trajectory, name, labels)
        axes.set_ylabel(f"{name}\n[{_unit(model, int(joint))}]", fontsize="small")
    legend(drawing)
    return (
        f"<p>The {len(chosen)} joints that move most: each operator's estimate, with a band of "
        "one standard deviation, and the result in black. The operator with the narrow band "
        f"decides.</p>{_picture(drawing)}"
    )


def _joints(
    model: TaskParameterizedGMM, motions: Sequence[Trajectory]
) -> tuple[str, list[str]]:
    """Show ranges and speeds of the joints, and say which are near their limits."""
    robot, rows, near = model.kinematics_, [], list[str]()
    every = np.concatenate([as_array(one.joints) for one in motions])
    fastest = np.max([as_array(largest_speeds(one)) for one in motions], axis=0)
    low, high, limit = map(as_array, (robot.lower, robot.upper, robot.velocity))
    for j, name in enumerate(robot.joint_names):
        unit, least, most = _unit(model, j), every[:, j].min(), every[:, j].max()
        said = [
            *_near_position(name, unit, least - low[j], high[j] - most, high[j] - low[j]),
            *_near_speed(name, unit, fastest[j], limit[j]),
        ]
        near += said
        texts = f"{low[j]:.2f} to {high[j]:.2f}", f"{fastest[j]:.2f}", f"{limit[j]:.2f}"
        known = (text.replace("inf", "\u221e") for text in texts)
        rows.append([name, unit, f"{least:.2f} to {most:.2f}", *known, "near" if said else ""])
    head = ["joint", "unit", "moves", "may", "fastest", "limit", "limits"]
    text = (
        "<p>In the situations of all episodes, within the robot's bounds; speeds per second. "
        f"Near is within {NEAR:.0%} of the range, or of the speed.</p>"
    )
    if (gaps := model.skill.gaps) is not None:
        text += f"<p>Servos: {gaps.describe(robot.joint_names, robot.lengths)}.</p>"
    none = "No joint comes near its limits of position or speed."
    if not np.isfinite([low, high, limit]).any():
        none = "Limits of the joints are not known: no robot was given."
    return text + _table(head, rows), near or [none]


def _near_position(name: str, unit: str, below: float, above: float, span: float) -> list[str]:
    room = float(min(below, above))
    if not np.isfinite(room) or room >= NEAR * span:
        return []
    if room < 0:
        return [f"{name} goes beyond its limit, by {-room:.3f} {unit}."]
    return [f"{name} comes within {room:.3f} {unit} of its limit."]


def _near_speed(name: str, unit: str, fastest: float, limit: float) -> list[str]:
    if fastest <= (1 - NEAR) * limit:
        return []
    return [f"{name} reaches {fastest:.2f} of {limit:.2f} {unit}/s."]


def _unit(model: TaskParameterizedGMM, joint: int) -> str:
    """Return a joint's unit: 1 for parts of quaternions; of joints alone it is not known."""
    robot = model.kinematics_
    if not robot.links:
        return "rad or m"
    return "m" if joint in robot.lengths else "rad" if joint in turning_joints(robot) else "1"


def _obstacles(
    model: TaskParameterizedGMM,
    situations: Sequence[Situation],
    motions: Sequence[Trajectory],
    scene: Scene | None,
) -> tuple[list[str], str]:
    """Say and list what touches what in each motion; nothing without a scene."""
    if scene is None:
        return [], ""
    rows = [
        [number, a.one, a.other, f"{a.begin:.1f} to {a.end:.1f}", f"{1e3 * a.depth:.0f}"]
        for number, a in contacts(scene, motions, situations, model.holds_)
    ]
    count = len({row[0] for row in rows})
    said = f"Something touches in {count or 'none'} of {len(motions)} motions."
    allowed = (f"{one} and {other}: {why}" for (one, other), why in scene.allowed.items())
    head = ["episode", "what", "touches", "from, to [s]", "by [mm]"]
    text = f"<p>{said}</p>{_table(head, rows) if rows else ''}"
    return [said], f"{text}<details><summary>pairs that may</summary>{_list(allowed)}</details>"


def _demonstrations(left_out: Sequence[LeftOut]) -> str:
    rows = []
    for one in left_out:
        worst = max((round(mm, 1) for mm, _ in one.errors.values()), default="-")
        rows.append([one.index, f"{one.novelty:.2f}", f"{one.path:.3f}", worst])
    text = (
        "<p>Novelty is how far an episode's situation is from the others, in units of the "
        f"furthest of these; above {UNLIKELY} it is unlike them.</p>"
    )
    return text + _table(
        ["episode", "novelty", "path [rad or m]", "worst at an event [mm]"], rows
    )


def _moving(
    model: TaskParameterizedGMM,
    situation: Situation,
    demonstrations: Sequence[Demonstration],
    title: str,
    how: Mapping[str, Any],
) -> str:
    """Embed the moving picture; nothing for a model without links."""
    if not model.kinematics_.links:
        return ""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "motion.html"
        write_motion(place, model, situation, demonstrations, title=title, **how)
        page = html.escape(place.read_text(encoding="utf-8"), quote=True)
    return f'<iframe title="the motion" loading=lazy srcdoc="{page}"></iframe>'


def _picture(drawing: Any) -> str:
    buffer = io.BytesIO()
    save(drawing, buffer)  # type: ignore[arg-type]
    data = base64.b64encode(buffer.getvalue()).decode()
    source = f"data:image/png;base64,{data}"
    return f'<div><img alt="each operator\'s estimate over time" src="{source}"></div>'


def _list(lines: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{html.escape(line)}' for line in lines)}</ul>"


def _table(head: Sequence[object], rows: Sequence[Sequence[object]]) -> str:
    lines = ["".join(f"<th>{html.escape(str(one))}" for one in head)]
    lines += ["".join(f"<td>{html.escape(str(one))}" for one in row) for row in rows]
    return f"<table class=n><tr>{'<tr>'.join(lines)}</table>"

"""Pictures of models and reproductions, in the manner of the paper's figures 3 to 6."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from tpgmm_torch import operators as kinds
from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DependencyError, UnknownNameError
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.structure.segmentation import Segmentation
from tpgmm_torch.structure.select_operators import SelectOperators
from tpgmm_torch.training.local_data import local_data

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "STYLE",
    "figure",
    "plot_candidates",
    "plot_components",
    "plot_joints",
    "plot_local",
    "plot_parts",
    "plot_relevance",
]

#: Colours of Okabe and Ito, which readers with any kind of colour vision tell apart.
BLUE, GREEN, PURPLE, SKY, VERMILION = "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#D55E00"
ORANGE = "#E69F00"
DEMONSTRATION, REPRODUCTION, COMPONENT = "0.15", VERMILION, GREEN
#: Colour and line of each operator; in grey print, lines differ where colours do not.
OPERATORS = (
    (VERMILION, "--"), (BLUE, "-."), (GREEN, ":"), (SKY, (0, (5, 1))),
    (PURPLE, (0, (3, 1, 1, 1, 1, 1))),
)  # fmt: skip
#: Of a small text above a point of the axes.
ABOVE: dict[str, Any] = {
    "xytext": (0, 1), "textcoords": "offset points", "ha": "center", "va": "bottom",
    "fontsize": "x-small", "annotation_clip": False,
}  # fmt: skip
#: Matplotlib's settings while :func:`figure` and :func:`save` are at work; for other
#: pictures beside them, ``matplotlib.style.use(STYLE)``.
STYLE: dict[str, Any] = {
    "axes.labelsize": 9,
    "axes.prop_cycle": f"cycler(color={[BLUE, VERMILION, SKY, GREEN, PURPLE, ORANGE, '0.1']})",
    "font.size": 9,
    "legend.fontsize": 8,
    "legend.handlelength": 3.5,  # a whole period of every line
    "lines.solid_capstyle": "round",
    "pdf.fonttype": 42,  # publishers refuse Type 3
    "ps.fonttype": 42,
    "savefig.dpi": 150,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}


def figure(rows: int, title: str, width: float = 7.0, height: float = 1.7) -> Figure:
    """Make a matplotlib figure of panels one above the other with a common time axis.

    It belongs to no window, so it works without a display and needs no closing.

    Parameters
    ----------
    rows : int
        Number of panels.
    title : str
        Above all of them.
    width, height : float
        Of the figure, and of one panel [inch].

    Raises
    ------
    DependencyError
        If matplotlib is not installed.

    Examples
    --------
    >>> drawing = figure(2, "two joints")
    >>> shade(drawing.axes[0], {"reach": (0.0, 1.5)})
    >>> len(drawing.axes)
    2
    """
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError:
        raise DependencyError(
            "pictures need matplotlib: pip install 'tpgmm-torch[plot]'"
        ) from None
    with rc_context(STYLE):
        drawing = Figure(figsize=(width, height * rows + 0.9), layout="constrained")
        axes = drawing.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
        axes[-1].set_xlabel("time [s]")
        drawing.suptitle(title, fontsize="medium")
    return drawing


def operator_labels(operators: Sequence[Operator]) -> list[str]:
    """Shorten operators for a legend: links, and the frames that they are seen from.

    Parameters
    ----------
    operators : sequence of Operator
        Of one model. Where two short names are equal, all are :func:`format_operator`'s.

    Examples
    --------
    >>> from tpgmm_torch.operators.text import parse_operator
    >>> texts = "pose:l_hand@bottle + pose:r_hand@bottle", "canonical"
    >>> operator_labels([parse_operator(text) for text in texts])
    ['l_hand, r_hand from bottle', 'joints']
    """
    texts = [_label(one) for one in operators]
    return texts if len({*texts}) == len(texts) else [format_operator(one) for one in operators]


def _label(operator: Operator) -> str:
    parts = getattr(operator, "operators", (operator,))
    if all(part.links() and part.constrains_joints for part in parts):
        links, frames = (
            ", ".join(dict.fromkeys(names))
            for names in (operator.links(), operator.references())
        )
        return f"{links} from {frames}" if frames else links
    return "joints" if operator == kinds.Canonical() else format_operator(operator)


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


def legend(drawing: Figure) -> None:
    """Add one legend below all panels, where it hides nothing: each label once.

    Parameters
    ----------
    drawing : matplotlib Figure
        As :func:`figure` gives it, with all that is to be named in it.
    """
    from matplotlib import rc_context

    shown: dict[str, Any] = {}
    for axes in drawing.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            shown.setdefault(label, handle)
    with rc_context(STYLE):
        drawing.legend(
            shown.values(), shown.keys(), loc="outside lower center", ncols=min(4, len(shown))
        )


def save(drawing: Figure, path: Path) -> Path:
    """Write a figure in :data:`STYLE`, in the format of its suffix; vectors in PDF and SVG.

    Parameters
    ----------
    drawing : matplotlib Figure
        As :func:`figure` gives it.
    path : Path
        Ends in ``.png``, ``.pdf``, ``.svg``, or what else matplotlib writes.

    Returns
    -------
    Path
        The same.
    """
    from matplotlib import rc_context

    with rc_context(STYLE):
        drawing.savefig(path)
    return path


def shade(axes: Axes, spans: Mapping[str, tuple[float, float]]) -> None:
    """Mark phases on ``axes``: a grey band with its name for each of the ``spans`` [s]."""
    for name, (start, end) in spans.items():
        axes.axvspan(start, end, color="0.9", zorder=0, linewidth=0)
        middle, place = ((start + end) / 2, 1), ("data", "axes fraction")
        axes.annotate(name, middle, xycoords=place, color="0.4", **ABOVE)


def plot_joints(
    motion: Demonstration | Trajectory,
    joints: Sequence[str] | None = None,
    axes: Sequence[Axes] | None = None,
    **line: Any,
) -> list[Axes]:
    """Draw joints over time, one panel each.

    A trajectory has bands of two standard deviations, a demonstration marks at its events.

    Parameters
    ----------
    motion : Demonstration or Trajectory
        ``"joint_0"`` and so on name joints without names.
    joints : sequence of str, optional
        Names of those to draw; all by default.
    axes : sequence of matplotlib Axes, optional
        Panels to draw into, those of another motion for example; a new :func:`figure` by
        default.
    **line
        As for ``Axes.plot``.

    Raises
    ------
    UnknownNameError, DependencyError
        If there is no such joint, or no matplotlib.
    """
    names = list(motion.joint_names or (f"joint_{i}" for i in range(motion.joints.shape[1])))
    chosen = names if joints is None else list(joints)
    if unknown := sorted({*chosen} - {*names}):
        raise UnknownNameError("joint", unknown[0], "the motion", names)
    panels = figure(len(chosen), "", height=1.1).axes if axes is None else list(axes)
    for name, panel in zip(chosen, panels, strict=True):
        _plot_joint(panel, motion, names.index(name), **line)
        panel.set_ylabel(name, fontsize="small")
    for event, instant in getattr(motion, "events", {}).items():
        for panel in panels:
            panel.axvline(instant, color="0.7", linewidth=0.8, zorder=0)
        place = ("data", "axes fraction")
        panels[0].annotate(event, (instant, 1), xycoords=place, fontsize="x-small")
    return panels


def _plot_joint(
    panel: Axes, motion: Demonstration | Trajectory, joint: int, **line: Any
) -> None:
    """Draw a joint over time, in a trajectory with its band."""
    time, values = as_array(motion.time), as_array(motion.joints[:, joint])
    [curve] = panel.plot(time, values, **line)
    if isinstance(motion, Trajectory):
        band = 2 * as_array(motion.covariance[:, joint, joint]).clip(min=0) ** 0.5
        color = curve.get_color()
        panel.fill_between(time, values - band, values + band, color=color, alpha=0.2, lw=0)


def plot_components(
    axes: Axes, model: TaskParameterizedGMM, operator: int, column: int
) -> None:
    """Draw the components over time and one coordinate: contours of one standard deviation.

    Parameters
    ----------
    axes, model : matplotlib Axes, TaskParameterizedGMM
        Where to draw, and what; fitted.
    operator, column : int
        Which operator, and which of its local coordinates, time not counted.
    """
    from matplotlib.patches import Ellipse

    plane = [0, 1 + column]
    means = as_array(model.means_[operator][:, plane])
    covariances = as_array(model.covariances_[operator][:, plane][:, :, plane])
    for k, (mean, covariance) in enumerate(zip(means, covariances, strict=True)):
        variances, directions = np.linalg.eigh(covariance)
        angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
        small, large = 2 * np.sqrt(variances.clip(min=0))
        look = {"angle": angle, "color": COMPONENT, "alpha": 0.35, "zorder": 3}
        label = "" if k else "Gaussians, one standard deviation"
        axes.add_patch(Ellipse(mean, large, small, label=label, **look))


def plot_local(
    axes: Axes,
    model: TaskParameterizedGMM,
    operator: int,
    column: int,
    demonstrations: Sequence[Demonstration] = (),
    reproductions: Sequence[tuple[Trajectory, Mapping[str, Frame], Mapping[str, Any]]] = (),
) -> None:
    """Draw one local coordinate over time: demonstrations, components, reproductions.

    Parameters
    ----------
    axes, model : matplotlib Axes, TaskParameterizedGMM
        Where to draw; the model is fitted, and its operators define the coordinates.
    operator, column : int
        Which operator, and which of its coordinates.
    demonstrations : sequence of Demonstration
        Black.
    reproductions : sequence of (Trajectory, frames, style)
        Orange, labelled "reproduction" unless ``style``, which is passed to ``Axes.plot``, says
        otherwise. Trajectories may come from other models.
    """
    chosen = model.operators_[operator]
    thin: dict[str, Any] = {"color": DEMONSTRATION, "linewidth": 0.6}
    shown = [
        (one, {**thin, "label": "" if i else "demonstrations"})
        for i, one in enumerate(demonstrations)
    ]
    # what a reproduction would feel nobody knows
    for trajectory, frames, style in reproductions if chosen.constrains_joints else ():
        motion = Demonstration(trajectory.time, trajectory.joints, frames)
        look = {"color": REPRODUCTION, "linewidth": 1.8, "zorder": 4, "label": "reproduction"}
        shown.append((motion, {**look, **style}))

    def estimate(_operator: int, time: Tensor) -> Tensor:
        return model.skill.expect(operator, time)

    motions = [motion for motion, _ in shown]
    rows = local_data(motions, [chosen], model.kinematics_, estimate, model.holds_)
    for row, (_, style) in zip(rows, shown, strict=True):
        axes.plot(as_array(row[:, 0]), as_array(row[:, 1 + column]), **style)
    plot_components(axes, model, operator, column)


def plot_candidates(
    axes: Axes, trajectory: Trajectory, joint: str, labels: Sequence[str] = ()
) -> None:
    """Draw figure 6: each operator's estimate of a joint, its envelope, and the result.

    Parameters
    ----------
    axes, trajectory : matplotlib Axes, Trajectory
        Where to draw, and what; with candidates.
    joint : str
        Name of the joint.
    labels : sequence of str
        Names of the operators.
    """
    column = trajectory.joint_names.index(joint)
    time = as_array(trajectory.time)
    for j, candidate in enumerate(trajectory.candidates):
        mean = as_array(candidate.mean[:, column])
        spread = np.sqrt(as_array(candidate.covariance[:, column, column]).clip(min=0))
        color, line = OPERATORS[j % len(OPERATORS)]
        label = labels[j] if j < len(labels) else f"operator {j + 1}"
        axes.fill_between(
            time, mean - spread, mean + spread, color=color, alpha=0.2, linewidth=0
        )
        axes.plot(time, mean, color=color, linestyle=line, linewidth=2.2, label=label)
    # thin enough to see whose estimate it follows
    axes.plot(time, as_array(trajectory.joints[:, column]), "k", linewidth=1.0, label="TP-GMM")
    axes.set_ylabel(f"{joint} [rad]")


def plot_relevance(axes: Axes, selection: SelectOperators) -> None:
    """Draw when which candidate matters: gains over time, those kept above, in bold.

    Parameters
    ----------
    axes : matplotlib Axes
        Where to draw.
    selection : SelectOperators
        Fitted.
    """
    order = np.lexsort((-selection.relevance_.mean(0), ~selection.support_))
    gains = selection.relevance_[:, order].T.clip(min=0)
    begin, end = selection.time_[0], selection.time_[-1]
    extent = (float(begin), float(end), len(order) - 0.5, -0.5)
    image = axes.imshow(
        gains, aspect="auto", extent=extent, cmap="Greens", interpolation="nearest"
    )
    axes.set_yticks(
        range(len(order)), [format_operator(selection.candidates_[j]) for j in order]
    )
    for label, kept in zip(axes.get_yticklabels(), selection.support_[order], strict=True):
        label.set(fontsize="x-small", fontweight="bold" if kept else "normal")
    axes.axhline(selection.support_.sum() - 0.5, color=REPRODUCTION, linewidth=1.0)
    axes.set_xlabel("time [s]")
    axes.figure.colorbar(image, ax=axes, label="gain [nats]")


def plot_parts(
    axes: Axes, segmentation: Segmentation, demonstrations: Sequence[Demonstration]
) -> None:
    """Draw where parts begin and end: a bar per demonstration, and above them why.

    Parameters
    ----------
    axes : matplotlib Axes
        Where to draw.
    segmentation : Segmentation
        Fitted.
    demonstrations : sequence of Demonstration
        To these.
    """
    boundaries = segmentation.boundaries_
    for row, (one, own) in enumerate(zip(demonstrations, boundaries, strict=True)):
        edges = np.concatenate(([one.time[0]], own, [one.time[-1]]))
        for part, (begin, end) in enumerate(pairwise(edges)):
            axes.barh(row, end - begin, 0.8, begin, color="0.85" if part % 2 else "0.65")
    for reason, own in zip(segmentation.reasons_, boundaries.T, strict=True):
        axes.plot(own, range(len(own)), ".-", color=REPRODUCTION, linewidth=1.0)
        axes.annotate(reason.replace(", ", "\n"), (own[0], -0.5), **ABOVE)
    axes.set_ylim(len(boundaries) - 0.5, -0.5)
    axes.set_ylabel("demonstration")
    axes.set_xlabel("time [s]")

"""A card made from a model: what it does, what matters when, and how it was learned."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from inspect import signature

import numpy as np

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import as_array, as_tensor
from tpgmm_torch.data.demonstrations import Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import PlausibilityWarning
from tpgmm_torch.operators.base import of_joints
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.skills.reproduction import reproduce
from tpgmm_torch.skills.skill import CompositeSkill, Skill
from tpgmm_torch.skills.via_points import ViaPoints
from tpgmm_torch.skills.ways import Ways

#: Rows of the table of what matters when.
SPANS = 8
#: Markup of Markdown: references, links and pictures, addresses, code, emphasis.
MARKUP = re.compile(r"[\\`*\[\]<>!|~&:@$]|\b_|_\b|(?<=www)\.")
#: Settings that a card has elsewhere, or that are of no interest to others.
ELSEWHERE = {"n_components", "operators", "robot", "device"}
USE = """```python
from tpgmm_torch import hub

model = hub.load("{repo_id}")
```"""


def model_card(
    model: TaskParameterizedGMM | Skill,
    repo_id: str,
    *,
    measured: Mapping[str, object] | None = None,
    notes: str = "",
    license: str | None = None,
    use: str = USE,
    library: str = "tpgmm-torch",
) -> str:
    """Return the README.md of a repository that holds a model.

    Parameters
    ----------
    model : TaskParameterizedGMM or Skill
        Fitted.
    repo_id : str
        ``"owner/name"``, its title and in the lines that load it.
    measured : mapping of str to object, optional
        Measures and their values: ``{"grasp error, 50 situations": "0.2 mm"}``.
    notes : str, optional
        More for a reader, as Markdown.
    license : str, optional
        As the hub names them: ``"apache-2.0"``.
    use : str, optional
        How to load it, as Markdown; ``{repo_id}`` is replaced.
    library : str, default="tpgmm-torch"
        The library that loads it, as the hub names them.
    """
    head = ["---", f"library_name: {library}", "pipeline_tag: robotics"]
    head += [f"license: {license}"] if license else []
    head += ["tags:", "- robotics", "- learning-from-demonstration", "- tpgmm", "---"]
    parts = ["\n".join(head), f"# {repo_id}", describe(model, measured)]
    parts += [notes.strip()] if notes.strip() else []
    parts += ["## Use", use.replace("{repo_id}", repo_id)]
    return "\n\n".join(parts) + "\n"


def describe(
    model: TaskParameterizedGMM | Skill, measured: Mapping[str, object] | None = None
) -> str:
    """Return the sections of a card that follow from the model itself, as Markdown.

    Parameters
    ----------
    model : TaskParameterizedGMM or Skill
        Fitted; of several parts or ways, each is described.
    measured : mapping of str to object, optional
        As for :func:`model_card`.
    """
    chapters = sections(model, measured).items()
    return "\n\n".join(f"## {title}\n\n{text}" for title, text in chapters)


def sections(
    model: TaskParameterizedGMM | Skill, measured: Mapping[str, object] | None = None
) -> dict[str, str]:
    """Text of each section of :func:`describe`, by its title.

    Parameters
    ----------
    model, measured
        As there.
    """
    found: dict[str, str] = {}
    whole = model.skill if isinstance(model, TaskParameterizedGMM) else model
    for name, skill in _parts(whole):
        title = f" ({name})" if name else ""
        found |= {
            f"The skill{title}": _skill(skill),
            f"What matters, and when{title}": _influence(skill),
            f"Where it fails{title}": _limits(skill),
        }
    figures = "Nothing was stated."
    if measured:
        figures = _table(("what", "how much"), measured.items())
    return found | {"Measured": figures, "How it was learned": _learning(model)}


def _parts(skill: Skill, name: str = "") -> Iterator[tuple[str, Regression]]:
    """Return the fitted mixtures of a skill, by the name that each has among them."""
    if isinstance(skill, Regression):
        yield name, skill
    elif isinstance(skill, ViaPoints):
        yield from _parts(skill.skill, name)
    elif isinstance(skill, CompositeSkill):
        kind = "way" if isinstance(skill, Ways) else "part"
        for number, one in enumerate(skill.skills, start=1):
            yield from _parts(one, f"{name}, {kind} {number}".lstrip(", "))


def _skill(skill: Regression) -> str:
    seconds, steps = float(skill.time[-1] - skill.time[0]), len(skill.time)
    shown = skill.summary
    rows = [
        ("duration", f"{seconds:.2f} s, {steps} steps"),
        ("joints", ", ".join(skill.kinematics.joint_names)),
        ("links", ", ".join(skill.kinematics.links) or "none"),
        ("frames that it needs", ", ".join(skill.frame_names) or "none"),
        ("Gaussians", len(skill.log_weights)),
        ("demonstrations", "not known" if shown is None else shown.n_demonstrations),
    ]
    rows += [("operator", f"`{format_operator(one)}`") for one in skill.operators]
    rows += [("held", str(hold)) for hold in skill.holds]
    return (
        "A task-parameterised Gaussian mixture (TP-GMM). It gives joint references and their "
        "covariance over time, from a start posture and the poses of objects.\n\n"
        + _table(("", ""), rows)
    )


def _influence(skill: Regression) -> str:
    """Shares of the operators over time, in the middle of the demonstrated situations."""
    situation = _middle(skill)
    if situation is None:
        return "Not known: it depends on the situation, and what was shown is not kept."
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PlausibilityWarning)
        [trajectory] = reproduce(skill, [situation], candidates=True)
    time = as_array(trajectory.time - trajectory.time[0])
    shares = np.stack([as_array(100 * c.share.mean(-1)) for c in trajectory.candidates], -1)
    spans = np.array_split(np.arange(len(time)), min(SPANS, len(time)))
    rows = [
        (
            f"{time[span[0]]:.1f} to {time[span[-1]]:.1f}",
            *(f"{share:.0f} %" for share in shares[span].mean(0)),
        )
        for span in spans
    ]
    names = (f"`{format_operator(operator)}`" for operator in of_joints(skill.operators))
    return (
        "The share of each operator in what is known about the joints, their mean, where the "
        "start posture and the objects are in the middle of those shown.\n\n"
        + _table(("time [s]", *names), rows)
    )


def _middle(skill: Regression) -> Situation | None:
    """Return the situation amid those shown; None where they are not known."""
    shown = skill.summary
    if shown is None or not set(skill.frame_names) <= shown.frames.keys():
        return None
    joints = (np.array(shown.start_low) + np.array(shown.start_high)) / 2
    for start in skill.kinematics.quaternion_starts:
        quaternion = joints[start : start + 4]
        if np.linalg.norm(quaternion) < 0.5:  # they lie too far apart to have a middle
            return None
        joints[start : start + 4] = quaternions.normalize(as_tensor(quaternion, "orientation"))
    frames = {
        name: Frame(shown.frames[name].place.mean, shown.frames[name].orientation)
        for name in skill.frame_names
    }
    return Situation(joints=joints, frames=frames, joint_names=shown.joint_names)


def _limits(skill: Regression) -> str:
    text = (
        "Beyond its demonstrations it extrapolates, and may do anything within the robot's "
        "limits. It has no camera: frames are given to it. It knows nothing of "
        "collisions."
    )
    shown = skill.summary
    if shown is None:
        return f"{text} What was shown is not known."
    parts = [f"{text} `novelty` above 1 is further than any demonstration from the others."]
    if shown.frames:
        rows = [
            (
                name,
                *(f"{a:.3f} to {b:.3f}" for a, b in zip(one.low, one.high, strict=True)),
                f"{np.degrees(one.angle):.0f}",
            )
            for name, one in shown.frames.items()
        ]
        heading = ("frame was at", "x [m]", "y [m]", "z [m]", "turned by at most [deg]")
        parts.append(_table(heading, rows))
    starts = zip(shown.joint_names, shown.start_low, shown.start_high, strict=True)
    rows = [(name, f"{low:.3f} to {high:.3f}") for name, low, high in starts]
    parts.append(_table(("joint began at", "rad or m"), rows))
    return "\n\n".join(parts)


def _learning(model: TaskParameterizedGMM | Skill) -> str:
    rows: list[tuple[str, object]] = []
    if isinstance(model, TaskParameterizedGMM):
        rows.append(("iterations of EM", model.n_iter_))
        rows.append(("converged", "yes" if model.converged_ else "no"))
        if np.isfinite(model.lower_bound_):
            rows.append(("mean log-likelihood per time step", f"{model.lower_bound_:.3f}"))
        defaults = signature(type(model)).parameters
        rows += [
            (f"`{name}`", value)
            for name, value in model.get_params(deep=False).items()
            if name not in ELSEWHERE and str(value) != str(defaults[name].default)
        ]
    return _table(("", ""), [*rows, ("tpgmm-torch", version("tpgmm-torch"))])


def _table(heading: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join(f"| {' | '.join(map(_cell, line))} |" for line in lines)


def _cell(value: object) -> str:
    """Text that stays in its cell, and is neither a link, nor a picture, nor HTML."""
    text = " ".join(str(value).split())
    if re.fullmatch("`[^`]+`", text):  # code, which is shown as it is
        return text.replace("|", "\\|")
    return MARKUP.sub(r"\\\g<0>", text).replace("\\<", "&lt;")

"""Operators written as short text, for command lines and labels.

``position:l_hand@bottle + orientation:l_hand@bottle`` is a stack of two relative operators,
``position:l_hand`` an absolute one, ``pose:l_hand@bottle`` short for position and orientation,
``position:r_hand@held:bottle`` refers to the bottle as it is carried, ``position:bottle@tray``
is where a carried bottle is on a tray, ``canonical`` the joints themselves, and
``canonical:left_*,waist`` some of them. ``~`` and a number behind a term is its tolerance,
``position:l_hand@bottle~0.002`` [m], ``canonical~0.05`` [rad]. Orientations in tangent space
are ``orientation[tangent]:l_hand@bottle`` and ``pose[tangent]:l_hand@bottle``. Forces are
``wrench:r_hand@board``, with the axes that count ``wrench[z]:r_hand@board``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators.base import Operator
from tpgmm_torch.operators.canonical import Canonical
from tpgmm_torch.operators.orientation import AbsoluteOrientation, RelativeOrientation
from tpgmm_torch.operators.position import AbsolutePosition, RelativePosition
from tpgmm_torch.operators.stack import POSE_OPERATORS, Stack
from tpgmm_torch.operators.wrench import Wrench

__all__ = ["default_operators", "format_operator", "parse_operator"]

TERM = re.compile(
    r"(canonical(:(?P<joints>[^\s:@+~,]+(,[^\s:@+~,]+)*))?"
    r"|(?P<kind>position|(orientation|pose)(\[(?P<geometry>quaternion|tangent)\])?"
    r"|wrench(\[(?P<axes>[xyz]+)\])?)"
    r":(?P<link>[^\s:@+~]+)(@(?P<held>held:)?(?P<frame>[^\s:@+~]+))?)"
    r"(~(?P<tolerance>\d+\.?\d*(e-?\d+)?))?"
)
#: What ``pose`` is short for.
PAIR = re.compile(r"position:([^\s~]+) \+ orientation(\[tangent\])?:\1(?= |$)")
GRAMMAR = (
    "'canonical', or 'canonical:JOINTS' (some, by name or pattern, joined by commas), or "
    "'position:LINK', 'orientation:LINK' or 'pose:LINK' (both of them), each with '@FRAME' "
    "behind it if seen from a frame or another link, '@held:FRAME' if from an object as the "
    "robot carries it (LINK may be an object too), and '[tangent]' before the colon if "
    "orientations are rotation vectors, all but 'pose' perhaps with a tolerance, '~NUMBER', "
    "behind it; '+' stacks them, as in 'position:l_hand@bottle + orientation:l_hand@bottle'. "
    "'wrench:LINK@FRAME' stands alone, or 'wrench[z]:LINK@FRAME' with the axes that count"
)


def parse_operator(text: str) -> Operator:
    """The operator that a text stands for; a :class:`Stack` if there are several.

    Parameters
    ----------
    text : str
        One term, or several joined by ``+``, as this module's description has them.

    Raises
    ------
    DataError
        If a term is none of these; the message says what one looks like.

    Examples
    --------
    >>> parse_operator("position:l_hand@bottle")
    RelativePosition(link='l_hand', frame='bottle', held=False, tolerance=0.0)
    >>> parse_operator("pose:l_hand + canonical~0.02").operators[2]
    Canonical(tolerance=0.02, joints=None)
    """
    operators = [operator for term in text.split("+") for operator in _term(term.strip(), text)]
    return operators[0] if len(operators) == 1 else Stack(*operators)


def _term(term: str, text: str) -> list[Operator]:
    match = TERM.fullmatch(term)
    if match is None or (term.startswith("wrench") and (match["held"] or not match["frame"])):
        raise DataError(f"operator {text!r}: {term!r} is not a term. A term is {GRAMMAR}")
    kind, frame = match["kind"], match["frame"]
    options: dict[str, Any] = {}
    if match["tolerance"]:
        options["tolerance"] = float(match["tolerance"])
    if kind is None:
        joints = tuple(match["joints"].split(",")) if match["joints"] else None
        return [Canonical(joints=joints, **options)]
    if kind.startswith("wrench"):
        axes = None if match["axes"] is None else tuple(map("xyz".index, match["axes"]))
        return [Wrench(match["link"], frame, axes, **options)]
    return _poses(match, options, text)


def _poses(match: re.Match[str], options: dict[str, Any], text: str) -> list[Operator]:
    if match["kind"].startswith("pose") and options:
        raise DataError(
            f"operator {text!r}: {match[0]!r} is a position [m] and an orientation [rad], of "
            "which each has a tolerance of its own: write both"
        )
    place, frame = [match["link"]], match["frame"]
    position: Any = AbsolutePosition
    orientation: Any = AbsoluteOrientation
    if frame:
        position, orientation = RelativePosition, RelativeOrientation
        place, options["held"] = [*place, frame], bool(match["held"])
    geometry = match["geometry"] or "quaternion"
    one, other = position(*place, **options), orientation(*place, **options, geometry=geometry)
    kind = match["kind"].split("[")[0]
    return {"position": [one], "orientation": [other], "pose": [one, other]}[kind]


def default_operators(links: Sequence[str], frames: Sequence[str]) -> list[Operator]:
    """All ``links`` seen from all ``frames`` (or from the base) as one stack; the joints."""
    references = [f"@{name}" for name in frames] or [""]
    poses = [f"pose:{link}{reference}" for reference in references for link in links]
    texts = [" + ".join(poses), "canonical"] if poses else ["canonical"]
    return [parse_operator(text) for text in texts]


def format_operator(operator: Operator) -> str:
    """The inverse of :func:`parse_operator`, for people to read.

    Parameters
    ----------
    operator : Operator
        Operators that have no such text, like a user's own, are given by their ``repr``. The
        gain and the path of orientations, and the threshold of contact, are left out.

    Examples
    --------
    >>> format_operator(Stack(RelativePosition("l_hand", "bottle"), Canonical()))
    'position:l_hand@bottle + canonical'
    >>> format_operator(parse_operator("pose:l_hand@bottle"))
    'pose:l_hand@bottle'
    """
    if isinstance(operator, Stack):
        terms = " + ".join(map(format_operator, operator.operators))
        return PAIR.sub(r"pose\2:\1", terms)
    one: Any = operator
    text = _bare(one)
    if text is None:
        return repr(operator)
    return text if one.tolerance == type(one).tolerance else f"{text}~{one.tolerance!r}"


def _bare(one: Any) -> str | None:
    """Text of an operator without its tolerance; None if there is no such text."""
    if type(one) is Canonical:
        text = "canonical" if one.joints is None else f"canonical:{','.join(one.joints)}"
    elif type(one) is Wrench:
        axes = f"[{''.join(map('xyz'.__getitem__, one.axes))}]" if one.axes else ""
        text = f"wrench{axes}:{one.link}@{one.frame}"
    elif type(one) in POSE_OPERATORS:
        kind = "position" if one.gain is None else "orientation"
        tangent = "[tangent]" if one.rotation_vector_starts(None) else ""
        text = f"{kind}{tangent}:{one.link}"
        if hasattr(one, "frame"):
            text += f"@{'held:' if one.held else ''}{one.frame}"
    else:
        text = None
    return text

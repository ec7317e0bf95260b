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

__all__ = ["format_operator", "parse_operator"]

TERM = re.compile(
    r"(canonical(:(?P<joints>[^\s:@+~,]+(,[^\s:@+~,]+)*))?"
    r"|(?P<kind>position|(orientation|pose)(\[(?P<geometry>quaternion|tangent)\])?"
    r"|wrench(\[(?P<axes>[xyz]+)\])?)"
    r":(?P<link>[^\s:@+~]+)(@(?P<held>held:)?(?P<frame>[^\s:@+~]+))?)"
    r"(~(?P<tolerance>\d+\.?\d*(e-?\d+)?))?"
)
#: Classes of which the grammar has terms.
TERMS = (Canonical, Wrench, *POSE_OPERATORS)
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
    """Read an operator from text; a :class:`Stack` if there are several.

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
    pose = [position(*place, **options), orientation(*place, **options, geometry=geometry)]
    chosen = {"position": slice(0, 1), "orientation": slice(1, 2), "pose": slice(0, 2)}
    return pose[chosen[match["kind"].split("[")[0]]]


def default_operators(links: Sequence[str], frames: Sequence[str]) -> list[Operator]:
    """Stack all ``links`` seen from all ``frames`` (or from the base), and add the joints."""
    references = [f"@{name}" for name in frames] or [""]
    poses = [f"pose:{link}{reference}" for reference in references for link in links]
    texts = [" + ".join(poses), "canonical"] if poses else ["canonical"]
    return [parse_operator(text) for text in texts]


def format_operator(operator: Operator) -> str:
    """Write an operator as text, the inverse of :func:`parse_operator`.

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
        return PAIR.sub(r"pose\2:\1", " + ".join(map(format_operator, operator.operators)))
    text = operator.text() if type(operator) in TERMS else None
    if text is None:  # of a class that the grammar does not know
        return repr(operator)
    one: Any = operator
    return text if one.tolerance == type(one).tolerance else f"{text}~{one.tolerance!r}"

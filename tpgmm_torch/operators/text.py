"""Operators written as short text, for command lines and labels.

``position:l_hand@bottle + orientation:l_hand@bottle`` is a stack of two relative operators,
``position:l_hand`` an absolute one, ``pose:l_hand@bottle`` short for position and orientation,
``position:r_hand@held:bottle`` refers to the bottle as it is carried, ``position:bottle@tray``
is where a carried bottle is on a tray, ``canonical`` the joints themselves, and
``canonical:left_*,waist`` some of them.
``parameters@shelf`` takes task parameters A, b of the situation, on the joints,
``parameters:l_hand@shelf`` on a link's position. ``~`` and a number behind a term is its
tolerance, ``position:l_hand@bottle~0.002`` [m], ``canonical~0.05`` [rad]. Orientations in
tangent space are ``orientation[tangent]:l_hand@bottle`` and ``pose[tangent]:l_hand@bottle``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators.base import Operator
from tpgmm_torch.operators.canonical import Canonical
from tpgmm_torch.operators.orientation import AbsoluteOrientation, RelativeOrientation
from tpgmm_torch.operators.position import AbsolutePosition, RelativePosition
from tpgmm_torch.operators.stack import Stack
from tpgmm_torch.operators.task_parameters import TaskParameters

__all__ = ["default_operators", "format_operator", "parse_operator"]

#: By kind, the operator in the base frame and the one seen from a frame.
KINDS: dict[str, tuple[Callable[[str], Operator], Callable[..., Operator]]] = {
    "position": (AbsolutePosition, RelativePosition),
    "orientation": (AbsoluteOrientation, RelativeOrientation),
}
TERM = re.compile(
    r"(?P<kind>position|orientation|pose)(\[(?P<geometry>quaternion|tangent)\])?:(?P<link>[^\s:@+]+)"
    r"(@(?P<held>held:)?(?P<frame>[^\s:@+]+))?"
)
#: Task parameters: of the joints or of a link, and how many columns A has.
PARAMETERS = re.compile(
    r"parameters(:(?P<link>[^\s:@+]+))?@(?P<frame>[^\s:@+\[\]]+)(\[(?P<size>[1-9]\d*)\])?"
)
#: Some of the joints.
JOINTS = re.compile(r"canonical:(?P<joints>[^\s:@+~,]+(,[^\s:@+~,]+)*)")
TOLERANCE = re.compile(r"(?P<term>[^~]+)~(?P<tolerance>\d+\.?\d*(e-?\d+)?)")
GRAMMAR = (
    "'canonical', or 'canonical:JOINTS' (some, by name or pattern, joined by commas), or "
    "'position:LINK', 'orientation:LINK' or 'pose:LINK' (both of them), each with '@FRAME' "
    "behind it if seen from a frame or another link, '@held:FRAME' if from an object as the "
    "robot carries it (LINK may be an object too), and '[tangent]' before the colon if "
    "orientations are rotation vectors, or 'parameters@NAME' or "
    "'parameters:LINK@NAME' (with '[D]' behind it if A has D columns), all but 'pose' perhaps "
    "with a tolerance, '~NUMBER', behind it; '+' stacks them, as in "
    "'position:l_hand@bottle + orientation:l_hand@bottle'"
)


def parse_operator(text: str) -> Operator:
    """The operator that a text stands for; a :class:`Stack` if there are several.

    Parameters
    ----------
    text : str
        One term, or several joined by ``+``. A term is ``canonical``, perhaps with a colon
        and names or patterns of joints, joined by commas; or ``position``,
        ``orientation`` or ``pose`` (both), a colon and a link or an object that is carried;
        ``@`` and the name of a frame or of another link make it relative, ``@held:`` to an
        object as it is carried; ``[tangent]`` behind ``orientation`` or ``pose`` is the
        geometry of the orientation. ``parameters@NAME``, ``parameters:LINK@NAME`` are
        :class:`TaskParameters`. ``~0.01`` behind a term that is one operator is its tolerance.

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
    if given := TOLERANCE.fullmatch(term):
        operators = _term(given["term"], text)
        if len(operators) > 1:
            raise DataError(
                f"operator {text!r}: {term!r} is a position [m] and an orientation [rad], of "
                "which each has a tolerance of its own: write both"
            )
        return [replace(operators[0], tolerance=float(given["tolerance"]))]  # type: ignore[type-var]
    if term == "canonical":
        return [Canonical()]
    if some := JOINTS.fullmatch(term):
        return [Canonical(joints=tuple(some["joints"].split(",")))]
    if general := PARAMETERS.fullmatch(term):
        size = None if general["size"] is None else int(general["size"])
        return [TaskParameters(general["frame"], general["link"], size)]
    match = TERM.fullmatch(term)
    if match is None:
        raise DataError(f"operator {text!r}: {term!r} is not a term. A term is {GRAMMAR}")
    kind, link, frame, held = (match[name] for name in ("kind", "link", "frame", "held"))
    if match["geometry"] and kind == "position":
        raise DataError(f"operator {text!r}: {term!r} is a position, which has no geometry")
    pairs = KINDS.values() if kind == "pose" else [KINDS[kind]]
    operators = [
        relative(link, frame, held=bool(held)) if frame else absolute(link)
        for absolute, relative in pairs
    ]
    if match["geometry"]:
        operators[-1] = replace(operators[-1], geometry=match["geometry"])  # type: ignore[type-var]
    return operators


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
        gain and the path of orientations are left out.

    Examples
    --------
    >>> format_operator(Stack(RelativePosition("l_hand", "bottle"), Canonical()))
    'position:l_hand@bottle + canonical'
    """
    if isinstance(operator, Stack):
        return " + ".join(map(format_operator, operator.operators))
    if type(operator) is Canonical:
        some = "" if operator.joints is None else f":{','.join(operator.joints)}"
        return f"canonical{some}" + _tolerance(operator)
    if type(operator) is TaskParameters:
        link = "" if operator.link is None else f":{operator.link}"
        size = "" if operator.size is None else f"[{operator.size}]"
        return f"parameters{link}@{operator.frame}{size}" + _tolerance(operator)
    for kind, classes in KINDS.items():
        if type(operator) in classes:
            places = [f"@{name}" for name in operator.references()]
            link, *held = operator.links()
            places += [f"@held:{name}" for name in held]
            if operator.rotation_vector_starts(None):
                kind += "[tangent]"
            return f"{kind}:{link}" + "".join(places) + _tolerance(operator)
    return repr(operator)


def _tolerance(operator: Any) -> str:
    """What stands behind the term of an operator whose tolerance is not the default one."""
    given: float = operator.tolerance
    return "" if given == type(operator).tolerance else f"~{given!r}"

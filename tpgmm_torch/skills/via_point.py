"""Via-points: what a link or the joints shall be at a time of the skill."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.operators import Canonical, Operator
from tpgmm_torch.operators.text import format_operator, parse_operator
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["ViaPoint"]

TEXT = re.compile(
    r"(?P<time>[^:=~]+):(?P<what>[^=]+)=(?P<value>[^=~]+)(~(?P<tolerance>[^~]+))?"
)
GRAMMAR = (
    "TIME:OPERATOR=NUMBERS, as in '3.2:position:l_hand@bottle=0,0,0.1', with the numbers of "
    "'position', 'pose' (position and quaternion w, x, y, z) or 'orientation', or of some "
    "joints, '3.2:canonical=l_elbow:0.4', and perhaps '~TOLERANCE' behind them"
)


@dataclass(frozen=True)
class ViaPoint:
    """A pose or a posture through which a skill shall pass.

    Parameters
    ----------
    time : float
        When, in the time of the skill, ``time_`` of the model [s].
    operator : Operator or str
        Whose coordinates are given: ``"pose:l_hand@bottle"``, ``"position:l_hand"``,
        ``"canonical"``, or any other that :func:`parse_operator` reads.
    value : Frame, mapping of str to float, or array-like of shape (D,)
        The coordinates [m, rad, quaternions (w, x, y, z)]; a frame stands for a position and
        an orientation, and a mapping for some of the joints of ``canonical``.
    tolerance : float or sequence of float, default=0.0
        Standard deviation of what is asked for [m; rad], of all displacements or one for each:
        three of a position, along the axes of the base, three of an orientation, one of a
        joint. 0 is exact; a large one leaves an axis as it is.

    Raises
    ------
    DataError, ShapeError
        If numbers are not finite, or operator and value do not fit together.

    Examples
    --------
    >>> ViaPoint.parse("3.2:position:l_hand@bottle=0,0,0.1")
    ViaPoint(time=3.2, operator=RelativePosition(link='l_hand', ...), value=(0.0, 0.0, 0.1)...)
    >>> str(ViaPoint(1.0, "canonical", {"elbow": 0.4}, tolerance=0.01))
    '1.0:canonical=elbow:0.4~0.01'
    """

    time: float
    operator: Operator
    value: tuple[float, ...] | Mapping[str, float]
    tolerance: float | tuple[float, ...] = 0.0

    def __init__(
        self,
        time: float,
        operator: Operator | str,
        value: Any,
        tolerance: float | Sequence[float] = 0.0,
    ) -> None:
        if isinstance(operator, str):
            operator = parse_operator(operator)
        if not isinstance(operator, Operator):
            raise DataError(f"a via-point is of an operator, got {type(operator).__name__}")
        widths = as_tensor(tolerance, "the tolerance of a via-point")
        if not math.isfinite(float(time)) or not bool((widths >= 0).all()):
            raise DataError(
                "a via-point has a finite time and no negative tolerance, got "
                f"time={time}, tolerance={tolerance}"
            )
        width: Any = widths.tolist()
        found = _read_value(operator, value)
        if isinstance(found, dict):  # one form of some joints: the operator names them
            operator = Canonical(joints=tuple(found))
        width = tuple(width) if widths.ndim else width
        vars(self).update(time=float(time), operator=operator, value=found, tolerance=width)

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read a via-point from text, ``TIME:OPERATOR=NUMBERS~TOLERANCE``.

        Parameters
        ----------
        text : str
            ``3.2:position:l_hand@bottle=0,0,0.1``; joints go by name,
            ``3.2:canonical=l_elbow:0.4,l_wrist:0``. The tolerance may be left out, or be
            several numbers.

        Raises
        ------
        DataError
            If it is no such text.
        """
        match = TEXT.fullmatch(text.strip())
        try:
            if match is None:
                raise ValueError
            parts = [part.rpartition(":") for part in match["value"].split(",")]
            value: Any = [float(number) for *_, number in parts]
            if ":" in match["value"]:
                value = {name.strip(): float(number) for name, _, number in parts}
            tolerance = [float(part) for part in (match["tolerance"] or "0").split(",")]
            time = float(match["time"])
        except ValueError:
            raise DataError(f"via-point {text!r} is not of the form {GRAMMAR}") from None
        widths = tolerance if len(tolerance) > 1 else tolerance[0]
        return cls(time, match["what"].strip(), value, widths)

    def __str__(self) -> str:
        what, value = format_operator(self.operator), ",".join(map(repr, self.value))
        if isinstance(self.value, Mapping):
            what, named = "canonical", self.value.items()
            value = ",".join(f"{name}:{number!r}" for name, number in named)
        widths = self.tolerance if isinstance(self.tolerance, tuple) else (self.tolerance,)
        tolerance = "" if widths == (0.0,) else "~" + ",".join(map(repr, widths))
        return f"{self.time!r}:{what}={value}{tolerance}"

    def coordinates(self, kinematics: Kinematics) -> Tensor:
        """Compute the operator's coordinates (D,).

        Parameters
        ----------
        kinematics : Kinematics
            The robot, whose joints a value may name.

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If they are not those of the operator, or the norm of a quaternion is not 1.
        """
        like, size, value = kinematics.lower, self.operator.dimension(kinematics), self.value
        if isinstance(value, Mapping):
            value = tuple(value[name] for name in kinematics.joint_names if name in value)
        wanted = torch.tensor(value, dtype=like.dtype, device=like.device)
        if len(wanted) != size:
            raise ShapeError(
                f"the via-point {self} has {len(wanted)} numbers, but "
                f"{format_operator(self.operator)} has {size} coordinates"
            )
        for start in self.operator.quaternion_starts(kinematics):
            part = slice(start, start + 4)
            norm = float(wanted[part].norm())
            if not abs(norm - 1) < 1e-3:
                raise DataError(
                    f"the quaternion (w, x, y, z) of the via-point {self} has norm {norm:.4g}, "
                    "not 1"
                )
            wanted[part] = quaternions.normalize(wanted[part])
        return wanted

    def variances(self, n_displacements: int) -> list[float]:
        """Return the variance of each displacement that is asked for.

        Parameters
        ----------
        n_displacements : int
            How many the operator has.

        Raises
        ------
        ShapeError
            If there are more or fewer tolerances.
        """
        given = self.tolerance
        widths = given if isinstance(given, tuple) else (given,) * n_displacements
        if len(widths) != n_displacements:
            raise ShapeError(
                f"the via-point {self} has {len(widths)} tolerances, but "
                f"{format_operator(self.operator)} has {n_displacements} displacements"
            )
        return [width**2 for width in widths]


def _read_value(operator: Operator, value: Any) -> tuple[float, ...] | dict[str, float]:
    """Check what is given as a value: a frame, joints by name, or all coordinates."""
    named = isinstance(value, Mapping)
    if named and type(operator) is not Canonical:
        raise DataError(
            "values by name are of joints, ViaPoint(time, 'canonical', {...}); the operator is "
            f"{format_operator(operator)}"
        )
    if isinstance(value, Frame):
        value = torch.cat((value.position, value.orientation), -1)
    numbers = as_tensor(list(value.values()) if named else value, "the value of a via-point")
    if numbers.ndim != 1 or not len(numbers):
        raise ShapeError(f"the value of a via-point has shape (D,), got {tuple(numbers.shape)}")
    found = numbers.tolist()
    return dict(zip(map(str, value), found, strict=True)) if named else tuple(found)

"""Allowed values of constructors' parameters: a table in each estimator, read by ``fit``.

Constructors of scikit-learn's interface only store. What they stored is checked where it is
used, by a table ``_parameter_constraints`` of the class: for each parameter the kinds of
value that it may have, one of which has to fit.

==================== =======================================================================
in the table         fits
==================== =======================================================================
:class:`Interval`    numbers between two bounds; never NaN, nor a boolean
:class:`Options`     some words
a class              its instances
``None``             ``None``
``"array-like"``     whatever has elements, a text excepted
``"boolean"``        ``True`` and ``False``, those of NumPy too
``"random_state"``   ``None``, a seed from 0 to 2**32 - 1, a ``numpy.random.RandomState``
``"verbose"``        booleans, and integers from 0
==================== =======================================================================

A parameter that a class checks by itself stands in the table as ``ANYTHING``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Literal

import numpy as np

from tpgmm_torch.exceptions import InvalidParameterError

__all__ = ["ANYTHING", "Interval", "Options", "check_parameters"]

#: Entry of a parameter that is checked elsewhere.
ANYTHING: tuple[Any, ...] = (object,)

BOOLEANS = (bool, np.bool_)


@dataclass(frozen=True)
class Interval:
    """Numbers between two bounds.

    Parameters
    ----------
    kind : numbers.Real or numbers.Integral
        Whether fractions are among them.
    low, high : float or None
        The bounds; none at ``None``, where infinity is not among them.
    closed : {"left", "right", "both", "neither"}
        Which bounds are themselves among them.

    Examples
    --------
    >>> from numbers import Integral, Real
    >>> from tpgmm_torch.constraints import Interval
    >>> 0.0 in Interval(Real, 0, 1, closed="left"), 1 in Interval(Real, 0, 1, closed="left")
    (True, False)
    >>> print(Interval(Integral, 1, None, closed="left"))
    an int in the range [1, inf)
    """

    kind: type
    low: float | None
    high: float | None
    closed: Literal["left", "right", "both", "neither"]

    def __contains__(self, value: Any) -> bool:
        if not isinstance(value, self.kind) or isinstance(value, BOOLEANS):
            return False
        number = float(value)  # type: ignore[arg-type]
        left = self.low is not None and self.closed in ("left", "both")
        right = self.high is not None and self.closed in ("right", "both")
        low = -np.inf if self.low is None else self.low
        high = np.inf if self.high is None else self.high
        above = number >= low if left else number > low
        below = number <= high if right else number < high
        return above and below  # NaN is neither

    def __str__(self) -> str:
        left = "[" if self.closed in ("left", "both") and self.low is not None else "("
        right = "]" if self.closed in ("right", "both") and self.high is not None else ")"
        low = "-inf" if self.low is None else f"{self.low:g}"
        high = "inf" if self.high is None else f"{self.high:g}"
        kind = "an int" if self.kind is Integral else "a float"
        return f"{kind} in the range {left}{low}, {high}{right}"


@dataclass(frozen=True)
class Options:
    """Some words.

    Examples
    --------
    >>> from tpgmm_torch.constraints import Options
    >>> print(Options("time", "kmeans"))
    one of 'kmeans', 'time'
    """

    words: frozenset[str]

    def __init__(self, *words: str) -> None:
        object.__setattr__(self, "words", frozenset(words))

    def __contains__(self, value: Any) -> bool:
        return isinstance(value, str) and value in self.words

    def __str__(self) -> str:
        words = ", ".join(map(repr, sorted(self.words)))
        return words if len(self.words) == 1 else f"one of {words}"


def check_parameters(estimator: Any) -> None:
    """Hold what the constructor of an ``estimator`` stored to the table of its class.

    Raises
    ------
    InvalidParameterError
        If a parameter is of none of the kinds that the table allows.
    """
    table: Mapping[str, Sequence[Any]] = estimator._parameter_constraints
    values = estimator.get_params(deep=False)
    for name, constraints in table.items():
        if not any(_fits(values[name], constraint) for constraint in constraints):
            *others, last = map(_in_words, constraints)
            allowed = f"{', '.join(others)} or {last}" if others else last
            raise InvalidParameterError(
                f"the {name!r} parameter of {type(estimator).__name__} must be {allowed}, "
                f"not {values[name]!r}"
            )


def _fits(value: Any, constraint: Any) -> bool:
    if constraint is None:
        return value is None
    if isinstance(constraint, Interval | Options):
        return value in constraint
    if isinstance(constraint, type):
        return isinstance(value, constraint)
    if constraint == "array-like":
        has_elements = hasattr(value, "__len__") or hasattr(value, "__array__")
        return has_elements and not isinstance(value, str | bytes | type)
    if constraint == "boolean":
        return isinstance(value, BOOLEANS)
    if constraint == "random_state":
        seeds = Interval(Integral, 0, 2**32 - 1, closed="both")
        return value is None or isinstance(value, np.random.RandomState) or value in seeds
    assert constraint == "verbose", constraint
    return isinstance(value, BOOLEANS) or value in Interval(Integral, 0, None, closed="left")


def _in_words(constraint: Any) -> str:
    if isinstance(constraint, type):
        return f"a {constraint.__name__}"
    words = {
        "boolean": "True or False",
        "random_state": "a seed, a RandomState",
        "verbose": "a boolean or an int in the range [0, inf)",
    }
    return words.get(constraint, str(constraint))

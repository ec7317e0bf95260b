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
``"random_state"``   ``None``, a seed from 0 to 2**32 - 1, a ``numpy.random.RandomState``
==================== =======================================================================

A parameter that a class checks by itself stands in the table as ``ANYTHING``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Literal

import numpy as np
from numpy.random import RandomState
from sklearn.base import BaseEstimator

from tpgmm_torch.exceptions import InvalidParameterError, NotFittedError

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
        low, high, left, right = self._ends()
        above = number >= low if left == "[" else number > low
        below = number <= high if right == "]" else number < high
        return above and below  # NaN is neither

    def __str__(self) -> str:
        low, high, left, right = self._ends()
        kind = "an int" if self.kind is Integral else "a float"
        return f"{kind} in the range {left}{low:g}, {high:g}{right}"

    def _ends(self) -> tuple[float, float, str, str]:
        """Return the bounds, and the brackets that say which are themselves among them."""
        left = "[" if self.closed in ("left", "both") and self.low is not None else "("
        right = "]" if self.closed in ("right", "both") and self.high is not None else ")"
        low = -np.inf if self.low is None else self.low
        return low, np.inf if self.high is None else self.high, left, right


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


#: The kinds of values that have a name in the table, and what errors call them.
SEED = Interval(Integral, 0, 2**32 - 1, closed="both")
NAMED: Mapping[str | None, tuple[Callable[[Any], bool], str]] = {
    None: (lambda value: value is None, "None"),
    "array-like": (
        lambda value: (
            not isinstance(value, str | bytes | type)
            and (hasattr(value, "__len__") or hasattr(value, "__array__"))
        ),
        "array-like",
    ),
    "random_state": (
        lambda value: value is None or isinstance(value, RandomState) or value in SEED,
        "a seed, a RandomState",
    ),
}


def _fits(value: Any, constraint: Any) -> bool:
    if isinstance(constraint, Interval | Options):
        return value in constraint
    if isinstance(constraint, type):
        return isinstance(value, constraint)
    return NAMED[constraint][0](value)


def _in_words(constraint: Any) -> str:
    if isinstance(constraint, Interval | Options):
        return str(constraint)
    return f"a {constraint.__name__}" if isinstance(constraint, type) else NAMED[constraint][1]


class DemonstrationEstimator(BaseEstimator):  # type: ignore[misc]
    """Estimator of scikit-learn's interface whose samples are demonstrations."""

    def _check_fitted(self, attribute: str) -> None:
        """Refuse what needs an attribute that ``fit`` sets.

        Raises
        ------
        NotFittedError
        """
        if not hasattr(self, attribute):
            name = type(self).__name__
            raise NotFittedError(f"this {name} is not fitted yet: call fit(demonstrations)")

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False  # X is a list of demonstrations
        return tags

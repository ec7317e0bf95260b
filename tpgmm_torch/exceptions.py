"""Every error and warning that the toolkit raises on purpose.

Each error derives from :class:`TPGMMError` and from the builtin that scikit-learn and
plain Python code expect, so that ``except ValueError`` keeps working.
"""

from collections.abc import Iterable

from sklearn.exceptions import ConvergenceWarning as SklearnConvergenceWarning
from sklearn.exceptions import NotFittedError as SklearnNotFittedError

__all__ = [
    "ConvergenceWarning",
    "DataError",
    "DegenerateComponentWarning",
    "DependencyError",
    "DistributedError",
    "InvalidParameterError",
    "MissingLimitsWarning",
    "ModelFileError",
    "NotFittedError",
    "PlausibilityError",
    "PlausibilityWarning",
    "ShapeError",
    "TPGMMError",
    "UnknownNameError",
]


class TPGMMError(Exception):
    """Base class of all errors raised by this project."""


class DataError(TPGMMError, ValueError):
    """A value is not usable: NaN, time that does not increase, a quaternion off unit norm."""


class ShapeError(DataError):
    """An array has another shape than the one that is needed."""


class PlausibilityError(DataError):
    """Recordings or situations cannot be what they are taken for: units, order, clock."""


class InvalidParameterError(TPGMMError, ValueError, TypeError):
    """A parameter of a constructor has a value that is not allowed; raised by ``fit``."""


class UnknownNameError(TPGMMError, KeyError):
    """A name (frame, link, joint, column) does not exist where it was looked up.

    Parameters
    ----------
    kind : str
        What was looked up, for example ``"frame"``.
    name : str
        The name that was given.
    where : str
        Where it was looked up, for example ``"the demonstration"``.
    available : iterable of str
        The names that exist there.

    Examples
    --------
    >>> print(UnknownNameError("frame", "cup", "the demonstration", ["table", "bottle"]))
    frame 'cup' is not in the demonstration; it has ['bottle', 'table']
    """

    def __init__(self, kind: str, name: str, where: str, available: Iterable[str]) -> None:
        self.kind, self.name, self.where = kind, name, where
        self.available = sorted(available)
        super().__init__(kind, name, where, self.available)

    def __str__(self) -> str:
        return f"{self.kind} {self.name!r} is not in {self.where}; it has {self.available}"


class NotFittedError(TPGMMError, SklearnNotFittedError):
    """The model was asked for a result before ``fit`` or ``load``."""


class ModelFileError(TPGMMError, ValueError):
    """A saved model is truncated, tampered with, of another version, or not a model."""


class DependencyError(TPGMMError, ImportError):
    """An optional package is missing; the message says which extra installs it."""


class DistributedError(TPGMMError, RuntimeError):
    """The processes that learn a model together cannot reach each other, or one has died."""


class ConvergenceWarning(SklearnConvergenceWarning):
    """Expectation-maximisation stopped before its tolerance was reached."""


class DegenerateComponentWarning(UserWarning):
    """A mixture component lost its data."""


class MissingLimitsWarning(UserWarning):
    """A robot is described without limits that its motions could keep within."""


class PlausibilityWarning(UserWarning):
    """Recordings or situations are unlikely to be what they are taken for.

    One for each call, with all that was found; each with a remedy. Make errors of
    them by ``strict=True`` or ``plausibility="error"``.
    """

"""States that are replaced, never changed, as often as a loop ticks, and their settings."""

from typing import Any

from tpgmm_torch.exceptions import DataError


def replace_fields[State](state: State, **values: Any) -> State:
    """Copy a frozen dataclass with other values of some fields.

    ``dataclasses.replace`` without initialising it again, which for twenty fields takes
    longer than what a tick computes of them.

    Parameters
    ----------
    state : dataclass
        Without cached properties, which would be kept.
    **values
        Of its fields.
    """
    new = object.__new__(type(state))
    new.__dict__.update(state.__dict__, **values)
    return new


def check_positive(settings: Any, *may_vanish: str) -> None:
    """Check that all fields of a dataclass are numbers above 0; infinity is one.

    Parameters
    ----------
    settings : dataclass
        With numbers as fields.
    *may_vanish : str
        Fields that may also be 0.

    Raises
    ------
    DataError
        If one of them is not.
    """
    for name, value in vars(settings).items():
        if not (value > 0 or (value == 0 and name in may_vanish)):
            raise DataError(
                f"{name} of {type(settings).__name__} is a positive number, got {value!r}"
            )

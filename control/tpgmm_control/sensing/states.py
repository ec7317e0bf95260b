"""States that are replaced, never changed, as often as a control loop ticks."""

from typing import Any

__all__ = ["replace_fields"]


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

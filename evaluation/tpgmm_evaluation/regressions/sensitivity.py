"""What a constant matters: golden references and recordings at half and at twice its value."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module

import numpy as np

from tpgmm_evaluation.regressions.plan import Measured, Plan
from tpgmm_evaluation.regressions.sections import SECTIONS
from tpgmm_torch.exceptions import DataError

__all__ = ["sensitivity"]

FACTORS = (0.5, 2.0)


def sensitivity(constant: str, plan: Plan, sections: tuple[str, ...] = ()) -> Iterator[str]:
    """Measure with a constant as it is, at half and at twice its value.

    Modules that imported the constant by name get the other value too; default values of
    parameters and fields were taken when the module was loaded, and stay.

    Parameters
    ----------
    constant : str
        ``"MODULE:NAME"``.
    plan : Plan
    sections : tuple of str
        What to measure; the golden references and the recordings where none are given.

    Yields
    ------
    str
        A table: for each quantity its mean, and how far it goes with the other values. Of
        golden references the largest difference counts.

    Raises
    ------
    DataError
        If there is no such constant, or it is no number.
    """
    module, _, name = constant.partition(":")
    value = getattr(import_module(module), name, None)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DataError(
            f"a constant is given as MODULE:NAME, a number; {constant} is {value!r}"
        )
    found = []
    for factor in (1.0, *FACTORS):
        with _patched(name, value, type(value)(value * factor)):
            found.append(_figures(plan, sections or ("goldens", "recordings")))
    yield f"{constant} = {value}" + "".join(f"{f'x {f:g}':>14}" for f in FACTORS)
    for key, usual in found[0].items():
        others = [figures[key] for figures in found[1:]]
        golden = key.startswith("same:")
        gone = [
            f"{np.abs(other - usual).max() if golden else other.mean():14.4g}"
            if other.shape == usual.shape
            else f"{'other shape':>14}"
            for other in others
        ]
        yield f"{key:60}{0.0 if golden else usual.mean():14.4g}" + "".join(gone)


def _figures(plan: Plan, sections: tuple[str, ...]) -> Measured:
    return {
        f"{key} ({name})": value
        for section in sections
        for name, work in SECTIONS[section](plan)
        for key, value in work().items()
        if not key.startswith("same:") or "references" in key
    }


@contextmanager
def _patched(name: str, usual: float, value: float) -> Iterator[None]:
    """All modules of ours that have the constant, by its name and value, have the other."""
    holders = [
        module
        for key, module in sys.modules.items()
        if key.startswith("tpgmm_") and getattr(module, name, None) is usual
    ]
    for module in holders:
        setattr(module, name, value)
    try:
        yield
    finally:
        for module in holders:
            setattr(module, name, usual)

"""Where and how much to measure, and what a measurement is."""

from __future__ import annotations

import os
import sys
import types
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Arrays by ``KIND:NAME``. The kind says how two of them are compared: ``same`` to rounding;
#: ``success`` (0 or 1), ``score`` (more is better) and ``error`` (less is better) in pairs, the
#: same episode, fold or situation in both; ``seconds`` by their ratio.
Measured = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Plan:
    """Plan of measurements, and where they are kept.

    Parameters
    ----------
    out : Path
        Where cells are kept, as ``SECTION/NAME.npz``.
    small : bool, default=False
        Whether a few situations of each do, in minutes; the whole takes hours.
    root : Path
        The checkout, whose examples, tests and benchmarks are used.
    data : Path
        The folder of the recordings; they are left out where it is missing.
    workers : int, default=1
        Processes for the rollouts.
    """

    out: Path
    small: bool = False
    root: Path = Path()
    data: Path = Path("../shared/data")
    workers: int = 1

    def load_module(self, module: str) -> Any:
        """Import a module of the checkout's examples or tests, which are in no package."""
        parent = module.partition(".")[0]
        if parent not in sys.modules or not hasattr(sys.modules[parent], "__path__"):
            sys.modules[parent] = types.ModuleType(parent)
        sys.modules[parent].__path__ = [str(self.root / parent)]
        return import_module(module)


def import_paths(root: Path) -> str:
    """Return the ``PYTHONPATH`` with which the packages of a checkout are found."""
    folders = ("control", "datasets", "vision", "tools", "policies", "environments")
    return os.pathsep.join(str(root.resolve() / name) for name in ("", *folders, "evaluation"))

"""Sensitivity to a constant: what is measured at half and at twice its value."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from tpgmm_evaluation.regressions.comparison import compared, stored
from tpgmm_evaluation.regressions.plan import Plan, import_paths
from tpgmm_torch.exceptions import DataError

__all__ = ["sensitivity"]


def sensitivity(
    constant: str, plan: Plan, sections: Sequence[str], factors: Sequence[float] = (0.5, 2.0)
) -> Iterator[str]:
    """Measure with a constant as it is, and with other values, in copies of its package.

    Parameters
    ----------
    constant : str
        ``"MODULE:NAME"``, on a line of its own.
    plan : Plan
        What was measured is kept in ``plan.out``, and measured once.
    sections : sequence of str
    factors : sequence of float

    Yields
    ------
    str
        A row for each value: the largest change of golden references, by how much errors grow
        on average [%], how likelihoods change [nats], and how many quantities are worse.

    Raises
    ------
    DataError
        If there is no such constant, or it is no number.
    """
    module, _, name = constant.partition(":")
    value = getattr(import_module(module), name, None)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DataError(f"give a number as MODULE:NAME; {constant} is {value!r}")
    usual = _measured(plan.out / "usual", plan, sections)
    for factor in factors:
        other = type(value)(value * factor)
        out = plan.out / f"{module}.{name}={other:g}"
        with tempfile.TemporaryDirectory() as copy:
            _edit(Path(copy), module, name, other)
            _measured(out, plan, sections, copy)
        yield f"{constant} = {other:g} (usually {value:g}): {_change(usual, out, sections)}"


def _edit(copy: Path, module: str, name: str, value: float) -> None:
    """Copy the package of a module, with another value of a constant."""
    package, *_ = parts = module.split(".")
    home: Any = import_module(package).__path__
    shutil.copytree(home[0], copy / package)
    path = copy.joinpath(*parts).with_suffix(".py")
    if not path.exists():
        path = copy.joinpath(*parts, "__init__.py")
    line = re.compile(rf"^{name}\b[^=\n]*=.*$", re.M)
    text, n = line.subn(f"{name} = {value!r}", path.read_text(encoding="utf-8"))
    if n != 1:
        raise DataError(f"{module} sets {name} {n} times on a line of its own, not once")
    path.write_text(text, encoding="utf-8")


def _measured(out: Path, plan: Plan, sections: Sequence[str], copy: str = "") -> Path:
    """The small form, by a process that finds the copy first."""
    command = [sys.executable, "-P", "-m", "tpgmm_evaluation.regressions", "baseline"]
    command += ["--small", "--only", ",".join(sections), "--out", str(out.resolve())]
    paths = os.pathsep.join(filter(None, (copy, import_paths(plan.root))))
    subprocess.run(command, cwd=plan.root, env=os.environ | {"PYTHONPATH": paths}, check=True)
    return out


def _change(usual: Path, other: Path, sections: Sequence[str]) -> str:
    pairs = list(stored(usual / "baseline-small", other / "baseline-small", sections))
    moved: dict[str, list[float]] = {"same": [0.0], "error": [], "score": [], "success": []}
    for _, before, now in pairs:
        for key in set(before) & set(now):
            kind, one, two = key.partition(":")[0], before[key], now[key]
            if kind == "same" and one.shape == two.shape and "references" in key:
                moved[kind].append(np.abs(one - two).max())
            elif kind == "error" and one.mean() > 0:
                moved[kind].append(100 * (two.mean() / one.mean() - 1))
            elif kind in ("score", "success"):
                moved[kind].append((two - one).mean())
    worse = sum(bool(row.worse) and row.now != row.before for row in compared(pairs))
    means = {kind: np.mean(values) for kind, values in moved.items() if values}
    texts = {"error": "errors {:+.2f} %", "score": "scores {:+.3g}", "success": "share {:+.3g}"}
    parts = [texts[kind].format(mean) for kind, mean in means.items() if kind in texts]
    return ", ".join([f"references up to {max(moved['same']):.2g}", *parts, f"{worse} worse"])

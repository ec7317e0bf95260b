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

from tpgmm_evaluation.regressions.comparison import Array, compare_cells, read_pairs
from tpgmm_evaluation.regressions.plan import Plan, import_paths
from tpgmm_torch.exceptions import DataError


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
        What is measured.
    factors : sequence of float
        By which the constant is multiplied.

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
    usual = _measure(plan.out / "usual", plan, sections)
    for factor in factors:
        other = type(value)(value * factor)
        out = plan.out / f"{module}.{name}={other:g}"
        with tempfile.TemporaryDirectory() as copy:
            _edit(Path(copy), module, name, other)
            _measure(out, plan, sections, copy)
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


def _measure(out: Path, plan: Plan, sections: Sequence[str], copy: str = "") -> Path:
    """Measure the small form, by a process that finds the copy first."""
    command = [sys.executable, "-P", "-m", "tpgmm_evaluation.regressions", "baseline"]
    command += ["--small", "--only", ",".join(sections), "--out", str(out.resolve())]
    paths = os.pathsep.join(filter(None, (copy, import_paths(plan.root))))
    subprocess.run(command, cwd=plan.root, env=os.environ | {"PYTHONPATH": paths}, check=True)
    return out


def _change(usual: Path, other: Path, sections: Sequence[str]) -> str:
    """Describe how quantities changed."""
    pairs = list(read_pairs(usual / "baseline-small", other / "baseline-small", sections))
    changes: dict[str, list[float]] = {"same": [0.0], "error": [], "score": [], "success": []}
    for _, before, now in pairs:
        for key in set(before) & set(now):
            kind, _, name = key.partition(":")
            changes.get(kind, []).extend(_change_of(kind, name, before[key], now[key]))
    worse = sum(bool(row.worse) and row.now != row.before for row in compare_cells(pairs))
    texts = {"error": "errors {:+.2f} %", "score": "scores {:+.3g}", "success": "share {:+.3g}"}
    parts = [text.format(np.mean(changes[k])) for k, text in texts.items() if changes[k]]
    return ", ".join([f"references up to {max(changes['same']):.2g}", *parts, f"{worse} worse"])


def _change_of(kind: str, name: str, before: Array, now: Array) -> list[float]:
    """Compute how much a quantity changed, by its kind; nothing where that says nothing."""
    if kind == "same":
        same = "references" in name and before.shape == now.shape
        return [float(np.abs(before - now).max())] if same else []
    if kind == "error":
        return [float(100 * (now.mean() / before.mean() - 1))] if before.mean() > 0 else []
    return [float((now - before).mean())]

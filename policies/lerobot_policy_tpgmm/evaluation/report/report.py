"""The report of a comparison, for a reader who did not run it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_policy_tpgmm.evaluation.cells import Cell
from lerobot_policy_tpgmm.evaluation.report.sections import Sections
from lerobot_policy_tpgmm.evaluation.report.tables import cell_table, episode_table, write_table
from lerobot_policy_tpgmm.evaluation.settings import Settings

__all__ = ["write_report"]


def write_report(
    out: Path,
    settings: Settings,
    results: Sequence[Mapping[str, Any]],
    failures: Mapping[Cell, str],
    command: str,
) -> Path:
    """Write tables, figures and ``report.md``.

    Parameters
    ----------
    out : Path
        The folder.
    settings : Settings
    results : sequence of mapping
        Of all finished cells.
    failures : mapping
        Cells that failed, with the reason.
    command : str
        What was called; the report lists it after those of earlier calls.

    Returns
    -------
    Path
        The report.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / "report.md"
    lines = [f"# What demonstrations buy: {settings.env}", ""]
    if results:
        cells, episodes = cell_table(results), episode_table(results)
        write_table(cells, out / "cells")
        write_table(episodes, out / "episodes_evaluated")
        lines += Sections(out, settings, results, cells, episodes).text()
    lines += _failed(failures)
    lines += _commands(out / "commands.txt", command)
    partial = path.with_name(".report.md.partial")
    partial.write_text("\n".join(lines), encoding="utf-8")
    partial.replace(path)
    return path


def _failed(failures: Mapping[Cell, str]) -> list[str]:
    if not failures:
        return []
    lines = [f"- `{cell.key}`: {reason}" for cell, reason in failures.items()]
    return ["## Cells that failed", "", *lines, ""]


def _commands(path: Path, command: str) -> list[str]:
    known = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    if command and command not in known:
        known.append(command)
        path.write_text("\n".join(known) + "\n", encoding="utf-8")
    return ["## Commands", "", "```", *known, "```", ""] if known else []

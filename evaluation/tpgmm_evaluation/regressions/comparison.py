"""Two folders of cells beside each other: what became worse, and whether that is chance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wilcoxon

from lerobot_policy_tpgmm.evaluation.report.significance import LEVEL, holm, mcnemar

__all__ = ["Row", "compared", "table"]

#: Rounding, relative to the largest value.
ROUNDING = 1e-9
#: By which share a mean may be worse that no test calls so.
TOLERATED = 0.01
#: By how much more time may be taken; less where an optimising compiler leaves no excuse.
SLOWER, SLOWER_COMPILED = 1.25, 1.1

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """One quantity before and now, over the cells of a group.

    Parameters
    ----------
    name : str
    before, now : float
        Means; of times, medians.
    n : int
        Episodes, folds, situations or values.
    p : float
        The least of the cells', corrected by Holm; 1 where none was tested.
    worse : str
        Why this is worse; empty if it is not.
    changed : bool
        Whether anything differs beyond rounding.
    """

    name: str
    before: float
    now: float
    n: int
    p: float = 1.0
    worse: str = ""
    changed: bool = True


def compared(
    before: Path, now: Path, sections: Sequence[str], in_turns: Sequence[tuple[Cell, Cell]] = ()
) -> list[Row]:
    """Compare what both folders hold.

    Parameters
    ----------
    before, now : Path
        As :func:`~tpgmm_evaluation.regressions.sections.measure` fills them.
    sections : sequence of str
    in_turns : sequence of pair of cell
        Times of another checkout and of this one, taken in turns; they stand for the files'.

    Returns
    -------
    list of Row
        One for each quantity of each group of cells.
    """
    pairs: dict[str, list[tuple[Array, Array]]] = {}
    rows = []
    for section in sections:
        if section == "times" and in_turns:
            for one, other in in_turns:
                _enter(pairs, "times", one, other)
            continue
        for path in sorted((before / section).rglob("*.npz")):
            other = now / path.relative_to(before)
            group = path.parent if path.parent.name != section else path
            name = str(group.relative_to(before).with_suffix(""))
            if not other.exists():
                rows.append(
                    Row(f"{name}: {path.stem}", np.nan, np.nan, 0, worse="not measured")
                )
            else:
                _enter(pairs, name, np.load(path), np.load(other))
    return rows + _tested(pairs)


Cell = Mapping[str, Array]


def _enter(
    pairs: dict[str, list[tuple[Array, Array]]], group: str, one: Cell, other: Cell
) -> None:
    for key in one:
        kind, _, name = key.partition(":")
        found = other[key] if key in other else np.array([])
        pairs.setdefault(f"{kind}:{group}: {name}", []).append((one[key], found))


def _tested(pairs: Mapping[str, Sequence[tuple[Array, Array]]]) -> list[Row]:
    """Rows with p-values that are corrected for how many tests were made."""
    names = [name for name, cells in pairs.items() for _ in cells]
    p = holm([_p_value(name, *cell) for name, cells in pairs.items() for cell in cells])
    return [
        _row(name, cells, p[[i for i, other in enumerate(names) if other == name]])
        for name, cells in pairs.items()
    ]


def _gain(kind: str, before: Array, now: Array) -> Array:
    """By how much each of a pair is better now; rounding, and what is infinite, is no gain."""
    gain = before - now if kind == "error" else now - before
    same = np.isclose(before, now, rtol=ROUNDING, atol=ROUNDING, equal_nan=True)
    return np.where(same | ~np.isfinite(gain), 0.0, gain)


def _p_value(name: str, before: Array, now: Array) -> float:
    """That one cell differs by chance; 1 where that is not asked."""
    kind = name.partition(":")[0]
    if kind in ("same", "seconds") or before.shape != now.shape:
        return 1.0
    gain = _gain(kind, before, now)
    if kind == "success":
        return mcnemar(int((gain > 0).sum()), int((gain < 0).sum()))
    return float(wilcoxon(gain[gain != 0]).pvalue) if gain.any() else 1.0


def _row(name: str, cells: Sequence[tuple[Array, Array]], p: Array) -> Row:
    kind, _, name = name.partition(":")
    if any(one.shape != other.shape for one, other in cells):
        return Row(name, np.nan, np.nan, 0, worse="of another shape, or gone")
    before, now = (np.concatenate([cell[i].ravel() for cell in cells]) for i in (0, 1))
    if kind == "same":
        return _same(name, before, now)
    if kind == "seconds":
        one, other = float(np.median(before)), float(np.median(now))
        most = SLOWER_COMPILED if "compiled" in name else SLOWER
        slow = f"{other / one:.2f} x the time" if other > most * one else ""
        return Row(name, one, other, len(before), worse=slow)
    gain = _gain(kind, before, now)
    both = np.isfinite(before) & np.isfinite(now)
    row = Row(
        name,
        float(before[both].mean()) if both.any() else np.nan,
        float(now[both].mean()) if both.any() else np.nan,
        len(before),
        float(p.min()),
        changed=bool(gain.any()) or bool((np.isfinite(before) != np.isfinite(now)).any()),
    )
    lost = [_gain(kind, *cell).mean() < 0 for cell in cells]
    if any(lost & (p < LEVEL)):
        return replace(row, worse="significantly")
    if gain.mean() < -TOLERATED * abs(row.before):
        return replace(row, worse=f"on average by {abs(gain.mean() / row.before):.1%}")
    return row


def _same(name: str, before: Array, now: Array) -> Row:
    apart = np.abs(before - now)
    most = float(apart.max()) if len(apart) else 0.0
    size = max(1.0, float(np.abs(before).max())) if len(before) else 1.0
    changed = "" if most <= ROUNDING * size else f"changed by {most:.2g}"
    return Row(name, 0.0, most, len(before), worse=changed, changed=most > 0)


def table(rows: Sequence[Row], every: bool = False) -> Iterator[str]:
    """Lines of a table: what changed, and how much is as it was.

    Parameters
    ----------
    rows : sequence of Row
    every : bool, default=False
        Whether to show what is as it was.
    """
    shown = [row for row in rows if row.changed or row.worse or every]
    width = max([4, *(len(row.name) for row in shown)])
    yield f"{'':{width}}{'before':>12}{'now':>12}{'n':>7}{'p':>9}"
    for row in shown:
        figures = f"{row.before:12.4g}{row.now:12.4g}{row.n:7}{row.p:9.2g}"
        yield f"{row.name:{width}}{figures}" + (f"  WORSE: {row.worse}" if row.worse else "")
    yield f"{len(rows) - len(shown)} of {len(rows)} quantities are as they were"
    yield f"{sum(bool(row.worse) for row in rows)} are worse"

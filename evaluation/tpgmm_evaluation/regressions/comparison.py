"""Two measurements beside each other: what became worse, and whether that is chance."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wilcoxon

from tpgmm_evaluation.regressions.plan import Measured
from tpgmm_evaluation.report.significance import LEVEL, holm, mcnemar

#: Rounding, relative to the largest value or to 1.
ROUNDING = 1e-9
#: By which share a mean may be worse though no test finds that significant.
TOLERATED = 0.01
#: How many times the time may be taken; of a compiled step, which hardly varies.
SLOWER, SLOWER_COMPILED = 1.25, 1.1

Array = NDArray[np.float64]
Pairs = Sequence[tuple[Array, Array]]


@dataclass(frozen=True)
class Row:
    """One quantity before and now, over the cells of a group.

    Parameters
    ----------
    name : str
        Of the group and quantity.
    before, now : float
        Means; of times, medians; of golden references, the largest difference is ``now``.
    n : int
        Episodes, folds, situations or values.
    p : float
        The least of the cells', corrected by Holm; 1 where none was tested.
    worse : str
        Why this is worse; empty if it is not.
    changed : bool
        Whether anything differs by more than rounding.
    """

    name: str
    before: float
    now: float
    n: int
    p: float = 1.0
    worse: str = ""
    changed: bool = True


def read_pairs(
    before: Path, now: Path, sections: Iterable[str]
) -> Iterator[tuple[str, Measured, Measured]]:
    """Read cells of two folders, with the name of their group: the folder they are in.

    Parameters
    ----------
    before, now : Path
        As :func:`~tpgmm_evaluation.regressions.sections.measure` fills them.
    sections : iterable of str
        Which of their folders.
    """
    for section in sections:
        for path in sorted((before / section).rglob("*.npz")):
            file, group = path.relative_to(before), path.parent.relative_to(before)
            name = str(group if len(group.parts) > 1 else file.with_suffix(""))
            yield name, np.load(path), np.load(now / file) if (now / file).exists() else {}


def compare_cells(cells: Iterable[tuple[str, Measured, Measured]]) -> list[Row]:
    """Compare each quantity, over all cells of a group.

    Parameters
    ----------
    cells : iterable of (str, mapping, mapping)
        Group, what was measured before, and now.

    Returns
    -------
    list of Row
    """
    pairs: dict[tuple[str, str], list[tuple[Array, Array]]] = {}
    for group, before, now in cells:
        for key in before:
            kind, _, name = key.partition(":")
            found = now[key] if key in now else np.array([])
            pairs.setdefault((kind, f"{group}: {name}"), []).append((before[key], found))
    p = iter(holm([_p_value(kind, *each) for (kind, _), of in pairs.items() for each in of]))
    return [_row(*key, of, np.array([next(p) for _ in of])) for key, of in pairs.items()]


def _gain(kind: str, before: Array, now: Array) -> Array:
    """Compute by how much each of a pair is better now; 0 for what is infinite."""
    gain = before - now if kind == "error" else now - before
    same = np.isclose(before, now, rtol=ROUNDING, atol=ROUNDING, equal_nan=True)
    return np.where(same | ~np.isfinite(gain), 0.0, gain)


def _p_value(kind: str, before: Array, now: Array) -> float:
    """Test whether one cell differs by chance; 1 where that is not asked."""
    if kind in ("same", "seconds") or before.shape != now.shape:
        return 1.0
    gain = _gain(kind, before, now)
    if kind == "success":
        return mcnemar(int((gain > 0).sum()), int((gain < 0).sum()))
    return float(wilcoxon(gain[gain != 0]).pvalue) if gain.any() else 1.0


def _row(kind: str, name: str, pairs: Pairs, p: Array) -> Row:
    if any(before.shape != now.shape for before, now in pairs):
        return Row(name, np.nan, np.nan, 0, worse="not measured, or of another shape")
    before, now = (np.concatenate([pair[i].ravel() for pair in pairs]) for i in (0, 1))
    if kind == "same":
        most = float(np.abs(before - now).max())
        changed = most > ROUNDING * max(1.0, float(np.abs(before).max()))
        return Row(name, 0.0, most, len(now), 1.0, "changed" if changed else "", most > 0)
    if kind == "seconds":
        usual, taken = float(np.median(before)), float(np.median(now))
        limit = SLOWER_COMPILED if "compiled" in name else SLOWER
        slow = f"{taken / usual:.2f} times as long" if taken > limit * usual else ""
        return Row(name, usual, taken, len(now), worse=slow)
    return _compare_means(kind, name, pairs, p)


def _compare_means(kind: str, name: str, pairs: Pairs, p: Array) -> Row:
    """Compare successes, scores or errors: by the tests of cells, and by the mean."""
    before, now = (np.concatenate([pair[i].ravel() for pair in pairs]) for i in (0, 1))
    gain, both = _gain(kind, before, now), np.isfinite(before) & np.isfinite(now)
    usual, found = (float(v[both].mean()) if both.any() else np.nan for v in (before, now))
    lost = np.array([_gain(kind, *pair).mean() < 0 for pair in pairs])
    why = "significantly" if (lost & (p < LEVEL)).any() else ""
    if not why and gain.mean() < -TOLERATED * abs(usual):
        why = f"on average, by {abs(gain.mean() / usual):.1%}"
    changed = bool(gain.any() or (np.isfinite(before) != np.isfinite(now)).any())
    return Row(name, usual, found, len(now), float(p.min()), why, changed)


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Format the lines of a table: what changed, and how many quantities did not."""
    shown = [row for row in rows if row.changed or row.worse]
    width = max([4, *(len(row.name) for row in shown)])
    yield f"{'':{width}}{'before':>12}{'now':>12}{'n':>7}{'p':>9}"
    for row in shown:
        figures = f"{row.before:12.4g}{row.now:12.4g}{row.n:7}{row.p:9.2g}"
        yield f"{row.name:{width}}{figures}" + (f"  WORSE: {row.worse}" if row.worse else "")
    yield f"{len(rows) - len(shown)} of {len(rows)} quantities are as they were"
    yield f"{sum(bool(row.worse) for row in rows)} are worse"

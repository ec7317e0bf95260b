"""What objects show of themselves: tables in notebooks and as text, and curves over time."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from tpgmm_torch.exceptions import DependencyError, UnknownNameError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Tabular", "in_columns", "listed", "panels"]


class Tabular:
    """Shown as a small table in a notebook; a subclass says what stands in it."""

    def _rows(self) -> Mapping[str, object]:
        """What is told of the object, by what it is."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th>{html.escape(name)}</th><td>{html.escape(str(value))}</td></tr>"
            for name, value in self._rows().items()
        )
        caption = html.escape(type(self).__name__)
        return f"<table><caption>{caption}</caption><tbody>{rows}</tbody></table>"


def listed(names: Iterable[object]) -> str:
    """``names`` with commas between them; a dash where there are none.

    Examples
    --------
    >>> listed(["shoulder", "elbow"]), listed([])
    ('shoulder, elbow', '-')
    """
    return ", ".join(map(str, names)) or "-"


def in_columns(lines: Sequence[Sequence[str]]) -> str:
    """Lines of cells as text, with columns as wide as they need.

    Parameters
    ----------
    lines : sequence of sequence of str
        As many cells in each.

    Examples
    --------
    >>> print(in_columns([("joint", "range"), ("lift", "0 to 2")]))
    joint  range
    lift   0 to 2
    """
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def panels(
    names: Sequence[str],
    chosen: Sequence[str] | None = None,
    axes: Sequence[Axes] | None = None,
) -> dict[str, tuple[int, Axes]]:
    """Which column goes into which panel of a picture over time.

    Parameters
    ----------
    names : sequence of str
        Of all columns.
    chosen : sequence of str, optional
        Those to draw; all by default.
    axes : sequence of matplotlib Axes, optional
        To draw into, one for each; a new pyplot figure by default.

    Returns
    -------
    dict of str to (int, Axes)
        The column's place and its panel.

    Raises
    ------
    UnknownNameError
        If there is no such column.
    DependencyError
        If matplotlib is not installed.
    """
    drawn = list(names if chosen is None else chosen)
    for name in drawn:
        if name not in names:
            raise UnknownNameError("joint", name, "what is drawn", names)
    if axes is None:
        try:
            from matplotlib import pyplot
        except ImportError:
            raise DependencyError(
                "pictures need matplotlib: pip install 'tpgmm-torch[plot]'"
            ) from None
        _, grid = pyplot.subplots(
            len(drawn), 1, sharex=True, squeeze=False,
            figsize=(7.0, 1.1 * len(drawn) + 0.6), layout="constrained",
        )  # fmt: skip
        axes = list(grid[:, 0])
        axes[-1].set_xlabel("time [s]")
        for name, panel in zip(drawn, axes, strict=True):
            panel.set_ylabel(name, fontsize="small")
    return {name: (names.index(name), panel) for name, panel in zip(drawn, axes, strict=True)}

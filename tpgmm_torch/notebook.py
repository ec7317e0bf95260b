"""Text in columns, of reports."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["in_columns"]


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

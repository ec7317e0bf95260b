"""Findings of a check, each with its number and a remedy, and the one warning made of them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tpgmm_torch.exceptions import PlausibilityError, PlausibilityWarning

__all__ = ["Finding", "Report"]

PACKAGE = str(Path(__file__).parents[1])


@dataclass(frozen=True)
class Finding:
    """One thing that cannot be, or is unlikely.

    Parameters
    ----------
    check : str
        Name of the check, for example ``"units"``, ``"speed"``, ``"frames"``.
    message : str
        What was found, with the number and what was expected.
    remedy : str
        What to do about it.
    names : tuple of str
        The joints, frames or events it is about.
    episodes : tuple of int
        The demonstrations (or situations) it is about; empty where it is about all.
    value : float
        The number that stands out most.
    impossible : bool
        Whether it cannot be, or is only unlikely.
    """

    check: str
    message: str
    remedy: str
    names: tuple[str, ...] = ()
    episodes: tuple[int, ...] = ()
    value: float = float("nan")
    impossible: bool = False

    def __str__(self) -> str:
        return f"{self.check}: {self.message}. {self.remedy}"


@dataclass(frozen=True)
class Report:
    """All findings of one check.

    Parameters
    ----------
    findings : tuple of Finding
        Errors first.
    subject : str
        What was checked, for example ``"10 demonstrations"``.

    Examples
    --------
    >>> found = Finding("time", "a step of time is 30 s", "Is it in milliseconds?")
    >>> report = Report.of([found], "4 demonstrations")
    >>> print(report)
    4 demonstrations: one thing is implausible: (1) time: a step of time is 30 s. Is it ...
    """

    findings: tuple[Finding, ...]
    subject: str

    @classmethod
    def of(cls, findings: Iterable[Finding], subject: str) -> Report:
        """Make a report with errors first."""
        return cls(tuple(sorted(findings, key=lambda f: not f.impossible)), subject)

    def __iter__(self) -> Iterator[Finding]:
        """Iterate over the findings."""
        return iter(self.findings)

    def __len__(self) -> int:
        """Count the findings."""
        return len(self.findings)

    def __str__(self) -> str:
        if not self.findings:
            return f"{self.subject}: nothing implausible"
        items = "; ".join(f"({n}) {finding}" for n, finding in enumerate(self, start=1))
        things = "one thing is" if len(self) == 1 else f"{len(self)} things are"
        worst = "impossible" if self.errors() else "implausible"
        return f"{self.subject}: {things} {worst}: {items}"

    def errors(self) -> tuple[Finding, ...]:
        """Return the findings that are impossible."""
        return tuple(finding for finding in self if finding.impossible)

    def act(self, packages: tuple[str, ...] = ()) -> Report:
        """Raise an error if something cannot be, warn once of what is unlikely.

        Parameters
        ----------
        packages : tuple of str, default=()
            Folders of code, beside this package, that the warning does not point at: it names
            the line that called them.

        Returns
        -------
        self

        Raises
        ------
        PlausibilityError
            With all findings, if one of them cannot be.

        Warns
        -----
        PlausibilityWarning
            Once, with all findings.
        """
        if self.errors():
            raise PlausibilityError(str(self))
        if self.findings:
            skipped = (PACKAGE, *packages)
            warnings.warn(str(self), PlausibilityWarning, 2, skip_file_prefixes=skipped)
        return self


def shorten_list(items: Sequence[str], most: int = 3) -> str:
    """Name the first of some ``items``, ``most`` of them, and how many more there are.

    Examples
    --------
    >>> shorten_list(["a", "b", "c", "d", "e"])
    'a, b, c and 2 more'
    """
    shown = ", ".join(items[:most])
    more = len(items) - most
    return f"{shown} and {more} more" if more > 0 else shown


def in_columns(lines: Sequence[Sequence[str]]) -> str:
    """Format lines of cells in columns as wide as they need.

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

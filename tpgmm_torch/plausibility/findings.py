"""What a check of plausibility found: named, with its number, and said once."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from tpgmm_torch.exceptions import PlausibilityError, PlausibilityWarning

__all__ = ["PLAUSIBILITY", "Finding", "Report", "listed"]

#: What can be done about findings.
PLAUSIBILITY = ("warn", "error", "ignore")

#: So many examples of one finding are spelled out.
MOST_EXAMPLES = 3
#: So many findings are spelled out in one warning; a report has them all.
MOST_FINDINGS = 8


@dataclass(frozen=True)
class Finding:
    """One thing that is not as it should be.

    Parameters
    ----------
    check : str
        Which check found it, for example ``"units"``, ``"speed"``, ``"frames"``.
    severity : {"error", "unlikely"}
        Whether it cannot be, or is only unlikely.
    message : str
        What was found, with the number and what was expected.
    remedy : str
        What to do about it.
    names : tuple of str
        The joints, frames or events it is about.
    episodes : tuple of int
        The demonstrations (or situations) it is about; none where it is about all.
    value : float
        The number that stands out most.
    """

    check: str
    severity: str
    message: str
    remedy: str
    names: tuple[str, ...] = ()
    episodes: tuple[int, ...] = ()
    value: float = float("nan")

    def __str__(self) -> str:
        return f"{self.check}: {self.message}. {self.remedy}"


@dataclass(frozen=True)
class Report:
    """All findings of one check.

    Parameters
    ----------
    findings : tuple of Finding
        What cannot be comes first.
    subject : str
        What was looked at, for example ``"10 demonstrations"``.

    Examples
    --------
    >>> from tpgmm_torch import Demonstration
    >>> from tpgmm_torch.plausibility.check import examine
    >>> degrees = [Demonstration([0.0, 0.1, 0.2], [[30.0 + n], [60], [90]]) for n in range(2)]
    >>> report = examine(degrees)
    >>> [finding.check for finding in report]
    ['units']
    """

    findings: tuple[Finding, ...]
    subject: str

    @classmethod
    def of(cls, findings: Sequence[Finding], subject: str) -> Report:
        """The report with errors first."""
        return cls(tuple(sorted(findings, key=lambda f: f.severity != "error")), subject)

    def and_also(self, *findings: Finding) -> Report:
        """The report with more findings."""
        return Report.of([*self.findings, *findings], self.subject)

    def __iter__(self) -> Iterator[Finding]:
        """One finding after the other."""
        return iter(self.findings)

    def __len__(self) -> int:
        """Number of findings."""
        return len(self.findings)

    def errors(self) -> tuple[Finding, ...]:
        """What cannot be."""
        return tuple(finding for finding in self if finding.severity == "error")

    def __str__(self) -> str:
        if not self.findings:
            return f"{self.subject}: nothing implausible"
        spelled = self.findings[:MOST_FINDINGS]
        items = "; ".join(f"({n}) {finding}" for n, finding in enumerate(spelled, start=1))
        if len(self) > len(spelled):
            items += f"; and {len(self) - len(spelled)} more"
        one = "one thing is" if len(self) == 1 else f"{len(self)} things are"
        worst = "impossible" if self.errors() else "implausible"
        return f"{self.subject}: {one} {worst}: {items}"

    def act(self, plausibility: str = "warn", stacklevel: int = 2) -> Report:
        """Raise what cannot be, warn once of what is unlikely.

        Parameters
        ----------
        plausibility : {"warn", "error", "ignore"}, default="warn"
            "error" raises what is unlikely too; "ignore" does nothing.
        stacklevel : int, default=2
            As of ``warnings.warn``: whose line the warning names.

        Returns
        -------
        self

        Raises
        ------
        PlausibilityError
            With all findings.
        """
        if self.findings and plausibility != "ignore":
            if plausibility == "error" or self.errors():
                raise PlausibilityError(str(self))
            warnings.warn(str(self), PlausibilityWarning, stacklevel + 1)
        return self


def listed(items: Sequence[str]) -> str:
    """The first of some ``items``, and how many more there are.

    Examples
    --------
    >>> listed(["a", "b", "c", "d", "e"])
    'a, b, c and 2 more'
    """
    shown = ", ".join(items[:MOST_EXAMPLES])
    more = len(items) - MOST_EXAMPLES
    return f"{shown} and {more} more" if more > 0 else shown

"""What was measured, beside what is asked for."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

__all__ = ["Asked", "Kind", "Omitted", "Row", "format_table"]

Kind = Literal["faster", "times", "most"]


@dataclass(frozen=True)
class Asked:
    """A figure to reach.

    Parameters
    ----------
    kind : {"faster", "times", "most"}
        ``faster``: theirs / ours is at least the figure; ``times``: ours / theirs is at most
        the figure; ``most``: ours is at most the figure, in the row's unit.
    figure : float
    """

    kind: Kind
    figure: float

    def __str__(self) -> str:
        return {
            "faster": f"ratio ≥ {self.figure:g}",
            "times": f"ratio ≥ 1/{self.figure:g}",
            "most": f"≤ {self.figure:g}",
        }[self.kind]


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Parameters
    ----------
    work : str
    unit : str
        Of both figures; less is better.
    ours : float
        Median, unless ``work`` says otherwise.
    competitor : str, default=""
        With its configuration.
    theirs : float, optional
    asked : Asked, optional
    share_of_peak : float, optional
        Arithmetic per second, relative to the matrix products measured in the same run.
    rounds : int, default=1
        How many measurements the median is of.
    note : str, default=""
    """

    work: str
    unit: str
    ours: float
    competitor: str = ""
    theirs: float | None = None
    asked: Asked | None = None
    share_of_peak: float | None = None
    rounds: int = 1
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """Their figure as a multiple of ours; None where one of them is not known."""
        if self.theirs is None or self.ours <= 0:  # a difference of times within their noise
            return None
        return self.theirs / self.ours

    @property
    def is_reached(self) -> bool | None:
        """True if the figure asked for was reached; None where none is asked for."""
        if self.asked is None:
            return None
        if self.ours <= 0:  # a difference of times that is smaller than their noise
            return False
        if self.asked.kind == "most":
            return self.ours <= self.asked.figure
        if self.theirs is None:
            raise ValueError(f"{self.work}: a ratio is asked for, and there is no competitor")
        if self.asked.kind == "faster":
            return self.theirs >= self.asked.figure * self.ours
        return self.ours <= self.asked.figure * self.theirs

    def record(self) -> dict[str, Any]:
        """Return everything, for JSON."""
        derived = {"ratio": self.ratio, "reached": self.is_reached}
        return asdict(self) | derived | {"asked": self.asked and str(self.asked)}


@dataclass(frozen=True)
class Omitted:
    """What could not be measured here, and why."""

    work: str
    reason: str

    def record(self) -> dict[str, Any]:
        """Return everything, for JSON."""
        return {"work": self.work, "omitted": self.reason}


HEADINGS = (
    *("work", "ours", "rounds", "competitor", "theirs", "ratio", "asked", "reached"),
    "of peak",
)


def _cells(row: dict[str, Any]) -> list[str]:
    def figure(value: float | None) -> str:
        return "" if value is None else f"{value:.3g} {row['unit']}"

    reached = {None: "", True: "yes", False: "**no**"}[row["reached"]]
    ratio = "" if row["ratio"] is None else f"{row['ratio']:.3g}"
    share = "" if row["share_of_peak"] is None else f"{100 * row['share_of_peak']:.0f} %"
    ours, theirs = figure(row["ours"]), figure(row["theirs"])
    texts = (row["work"], ours, str(row["rounds"]), row["competitor"], theirs, ratio)
    return [*texts, row["asked"] or "", reached, share]


def format_table(records: list[dict[str, Any]]) -> str:
    """Format rows as a table in Markdown, then notes, then what was left out.

    Parameters
    ----------
    records : list of dict
        What ``record`` of rows and omissions gave.
    """
    rows = [record for record in records if "omitted" not in record]
    lines = [HEADINGS, ["---"] * len(HEADINGS), *map(_cells, rows)]
    table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
    notes = [f"- {row['work']}: {row['note']}" for row in rows if row["note"]]
    left_out = [
        f"- not measured: {record['work']}: {record['omitted']}"
        for record in records
        if "omitted" in record
    ]
    return "\n".join([table, "", *dict.fromkeys(notes + left_out)]) + "\n"

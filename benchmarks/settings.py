"""Which cases there are, and how they are to be measured."""

from dataclasses import dataclass
from pathlib import Path

from benchmarks.rows import Asked, Kind

__all__ = ["CASES", "Settings"]

#: Name on the command line -> function of a module beside this file that yields rows.
CASES = {
    "import": "start_up.measure",
    "em-13k": "em.measure_small",
    "em-1m": "em.measure_large",
    "memory": "memory.measure",
    "disk": "disk.measure",
    "processes": "processes.measure",
    "kinematics": "kinematics.measure",
    "step": "steps.measure_one",
    "controller": "controller_tick.measure",
    "batch": "steps.measure_batch",
    "predict": "steps.measure_whole",
    "curves": "curves.measure",
    "main": "main_times.measure",
}


@dataclass(frozen=True)
class Settings:
    """How to measure.

    Parameters
    ----------
    full : bool
        The sizes that the figures are about; False only shows that everything runs.
    out : Path
        Folder for results, and for large files while they are needed.
    repeat : int, optional
        Rounds of every measurement; None leaves it to the case.
    seed : int, default=0
        Of all random numbers.
    """

    full: bool
    out: Path
    repeat: int | None = None
    seed: int = 0

    def size(self, full: int, tiny: int) -> int:
        """Return one of two sizes."""
        return full if self.full else tiny

    def rounds(self, full: int) -> int:
        """Return how often to measure: as asked, or ``full`` times at full sizes, or once."""
        return self.repeat or self.size(full, 1)

    def iterations(self, few: int, many: int) -> tuple[int, int]:
        """Return the numbers of iterations of two fits whose difference is measured."""
        return (few, many) if self.full else (1, 2)

    def target(self, kind: Kind, figure: float) -> Asked | None:
        """Return the figure to reach; None at tiny sizes."""
        return Asked(kind, figure) if self.full else None

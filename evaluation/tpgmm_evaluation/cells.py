"""The grid of a comparison, and the files that remember what is done."""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lerobot_env_bimanual.disturbances import NOMINAL
from tpgmm_evaluation.processes import run_jobs
from tpgmm_evaluation.variants import Variant
from tpgmm_torch.atomic import replacing
from tpgmm_torch.exceptions import DataError


@dataclass(frozen=True, order=True)
class Cell:
    """One entry of the grid: a policy that is trained once and evaluated in one condition.

    Parameters
    ----------
    env : str
        Name of the benchmark.
    policy : str
        What is trained, and with which settings it is used, as :class:`Variant` reads it.
    demonstrations : int
        How many of the episodes it sees, the first ones.
    seed : int
        Of the training.
    condition : str, default="nominal"
        Disturbances of the evaluation, joined by ``+``.
    """

    env: str
    policy: str
    demonstrations: int
    seed: int
    condition: str = NOMINAL

    @property
    def training(self) -> str:
        """Name of the trained policy, which cells of all conditions and settings share."""
        return self._name(self.variant.base)

    @property
    def variant(self) -> Variant:
        """The trained policy and its settings."""
        return Variant.parse(self.policy)

    @property
    def key(self) -> str:
        """Name of the cell."""
        policy = re.sub(r"[^\w.+=:-]+", "_", self.policy.replace(" --policy.", "+"))
        return f"{self._name(policy)}-{self.condition}"

    def _name(self, policy: str) -> str:
        return f"{self.env}-{policy}-n{self.demonstrations}-s{self.seed}"


def parse_numbers(text: str, option: str) -> list[int]:
    """Read the numbers of an option of the command line, joined by commas."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise DataError(f"{option} takes numbers like 5,10,25, got {text!r}") from None


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file in one step: it is there as a whole, or as it was."""
    with replacing(path) as file:
        file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


class Results:
    """The finished cells in a folder, one file each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, cell: Cell) -> Path:
        """Return the file of a cell."""
        return self.folder / f"{cell.key}.json"

    def write(self, cell: Cell, result: Mapping[str, Any]) -> None:
        """Keep the result of a cell.

        Parameters
        ----------
        result : mapping
            What JSON can hold.
        """
        content = {"cell": asdict(cell), **result}
        write_json(self.path(cell), {**content, "checksum": _checksum(content)})

    def read(self, cell: Cell) -> dict[str, Any] | None:
        """Read the result of a cell; None if it is missing."""
        path = self.path(cell)
        if not path.exists():
            return None
        content = _read(path)
        if content["cell"] != asdict(cell):
            raise DataError(f"{path} holds another cell, {content['cell']}")
        return content

    def has(self, cell: Cell, say: Callable[[str], None]) -> bool:
        """Return whether a cell is finished; report and remove a damaged file."""
        try:
            return self.read(cell) is not None
        except DataError as error:
            say(f"{error}; the cell is run again")
            self.path(cell).unlink()
            return False

    def read_all(self, say: Callable[[str], None]) -> list[dict[str, Any]]:
        """Read all results in the folder, in the order of their names.

        Parameters
        ----------
        say : callable
            Told of damaged files, which are left out.
        """
        results = []
        for path in sorted(self.folder.glob("*.json"), key=_natural):
            try:
                results.append(_read(path))
            except DataError as error:
                say(f"{error}; it is left out")
        return results


@dataclass(frozen=True)
class Job:
    """Cells that one process runs one after the other.

    Parameters
    ----------
    cells : sequence of Cell
        Those of one training, or of one environment.
    results : Results
        Where they are kept.
    arguments : tuple
        Of the function that runs them.
    """

    cells: Sequence[Cell]
    results: Results
    arguments: tuple[Any, ...]

    @property
    def log(self) -> Path:
        """The file for a traceback."""
        return self.results.folder.parent / "failures" / f"{self.cells[0].training}.txt"


def run_cells(
    function: Callable[..., None],
    jobs: Sequence[Job],
    workers: int,
    say: Callable[[str], None],
) -> dict[Cell, str]:
    """Run cells by several processes; return those without a result, with the reason.

    Parameters
    ----------
    function : callable
        Of a module; it writes the results of a job's cells.
    jobs : sequence of Job
        Of cells that are not finished.
    workers : int
        How many run at a time.
    say : callable
        Takes a line of progress.
    """
    pending, finished = sum(len(job.cells) for job in jobs), 0
    began, failures = time.monotonic(), {}
    for number, _, problem in run_jobs(function, [job.arguments for job in jobs], workers):
        job = jobs[number]
        job.log.unlink(missing_ok=True)
        if problem:
            job.log.parent.mkdir(parents=True, exist_ok=True)
            job.log.write_text(problem, encoding="utf-8")
        finished += len(job.cells)
        for cell in job.cells:
            result = job.results.read(cell)
            if result is None:
                failures[cell] = (problem.strip().splitlines() or ["it left no result"])[-1]
                text = f"FAILED, {failures[cell]} (all of it in {job.log})"
            else:
                successes = sum(row["success"] for row in result["episodes"])
                text = f"{successes} of {len(result['episodes'])} succeed"
            say(f"{cell.key}: {text}")
        say(f"[{finished}/{pending}] after {(time.monotonic() - began) / 60:.1f} min")
    return failures


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        checksum = content.pop("checksum")
        Cell(**content["cell"])
    except (OSError, ValueError, AttributeError, KeyError, TypeError) as error:
        raise DataError(f"{path} is not the result of a cell: {error!r}") from error
    if checksum != _checksum(content):
        raise DataError(f"{path} was changed after it was written, or damaged")
    return dict(content)


def _checksum(content: Mapping[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _natural(path: Path) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]

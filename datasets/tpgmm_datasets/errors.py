"""Errors of a data set on disk, and where they are."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from tpgmm_torch.exceptions import DataError

__all__ = ["DatasetError", "DatasetWarning"]

#: The checks that ``relax`` may name, with what each of them refuses.
CHECKS = {
    "duplicates": "an episode that is there twice",
    "events": "an event that a frame is at and that is not found",
    "gaps": "a step of time longer than one and a half periods",
    "metadata": "lengths, names, rates and tasks that contradict each other",
    "missing": "a parquet file that is absent, truncated or corrupted",
    "nan": "values that are NaN, infinite or null",
    "poses": "quaternions whose norm is not 1",
    "time": "time that does not increase",
}


class DatasetError(DataError):
    """A data set is incomplete, contradicts itself, or is not what the caller took it for.

    Parameters
    ----------
    message : str
        What is wrong and what to do.
    check : str, optional
        Name of the check in :data:`CHECKS` that failed; empty for what cannot be relaxed.
    file : str or Path, optional
        The file it was found in, relative to the data set.
    episode : int, optional
        The index of the episode.
    column : str, optional
        The column, feature or field.
    """

    def __init__(
        self,
        message: str,
        *,
        check: str = "",
        file: str | Path | None = None,
        episode: int | None = None,
        column: str | None = None,
    ) -> None:
        self.check, self.episode, self.column = check, episode, column
        self.file = None if file is None else str(file)
        place = [] if self.file is None else [self.file]
        place += [] if episode is None else [f"episode {episode}"]
        place += [] if column is None else [f"column {column!r}"]
        if "relax=" not in message:
            message += self._suggest_relaxing()
        super().__init__(f"{', '.join(place)}: {message}" if place else message)

    def _suggest_relaxing(self) -> str:
        # without its description there is no set
        whole = self.file is None or self.file.startswith("meta")
        if not self.check or (self.check == "missing" and whole):
            return ""
        lost = "the episode is"
        if self.episode is None:
            lost = "episodes that fail it are"
            if self.check == "metadata":
                lost = "it goes unchecked and no episode is"
        return f". With relax=[{self.check!r}] (--relax {self.check}) {lost} left out"


class UnknownUnitsError(DatasetError):
    """Nobody said in which units values are, and they do not tell."""


class DatasetWarning(UserWarning):
    """A relaxed check dropped something; the message says what and why."""


def list_problems(problems: Iterable[DatasetError]) -> list[str]:
    """Write one line for all problems that differ in nothing but numbers and episodes.

    Parameters
    ----------
    problems : iterable of DatasetError
        Problems of one or several episodes.

    Returns
    -------
    list of str
        In order of the first of each kind; it is given whole, of the others only the number
        and the episodes.
    """
    kinds: dict[str, list[DatasetError]] = {}
    for problem in problems:
        kind = re.sub(r"[-+]?[\d.]+(e[-+]?\d+)?", "#", str(problem))
        kinds.setdefault(kind, []).append(problem)
    lines = []
    for first, *others in kinds.values():
        line = str(first)
        if others:
            line += f" (and {len(others)} more like it"
            episodes = sorted({item.episode for item in others if item.episode is not None})
            if episodes:
                numbers = ", ".join(map(str, episodes[:10])) + ", ..." * (len(episodes) > 10)
                line += f": episode{'s' * (len(episodes) > 1)} {numbers}"
            line += ")"
        lines.append(line)
    return lines

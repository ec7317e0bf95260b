"""What is wrong with a data set on disk, and where."""

from pathlib import Path

from tpgmm_torch.exceptions import DataError

__all__ = ["CHECKS", "DatasetError", "DatasetWarning"]

#: The checks that ``relax`` may name, with what each of them refuses.
CHECKS = {
    "duplicates": "an episode that is there twice",
    "gaps": "a step of time longer than one and a half periods",
    "metadata": "lengths, names, rates and tasks that contradict each other",
    "missing": "a parquet file that is absent, truncated or corrupted",
    "nan": "values that are NaN, infinite or null",
    "time": "time that does not increase",
}


class DatasetError(DataError):
    """A data set is incomplete, contradicts itself, or is not what the caller took it for.

    Parameters
    ----------
    message : str
        What is wrong and what to do.
    check : str, optional
        Which of :data:`CHECKS` failed; empty for what cannot be relaxed.
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
        where = [
            self.file,
            None if episode is None else f"episode {episode}",
            None if column is None else f"column {column!r}",
        ]
        place = ", ".join(part for part in where if part)
        super().__init__(f"{place}: {message}" if place else message)


class DatasetWarning(UserWarning):
    """A relaxed check dropped something; the message says what and why."""

"""EM on points that stay on disk, beside reading them."""

import shutil
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.child import ask, peak_memory, reset_peak
from benchmarks.points import BLOCKS, Problem, motions
from benchmarks.rows import Omitted, Row
from benchmarks.settings import Settings
from benchmarks.timing import in_turns, medians, per_iteration, seconds
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.mixture.row_file import RowFile

__all__ = ["measure"]

FILES, BATCH = 10, 65_536


class Batches:
    """The columns of parquet files, again and again, as arrays of shape (n, columns).

    Parameters
    ----------
    folder : Path
        With the files.
    """

    def __init__(self, folder: Path) -> None:
        self.paths = sorted(folder.glob("*.parquet"))

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        """Iterate over one pass."""
        for batch in self.records():
            # a column is contiguous on disk, and stays so
            columns = np.empty((batch.num_columns, batch.num_rows), dtype=np.float32)
            for row, column in zip(columns, batch.columns, strict=True):
                row[:] = column.to_numpy()
            yield columns.T

    def records(self) -> Iterator[object]:
        """Iterate over one pass as pyarrow has it, in one thread."""
        from pyarrow import parquet

        for path in self.paths:
            yield from parquet.ParquetFile(path).iter_batches(BATCH, use_threads=False)


def measure(settings: Settings) -> Iterator[Row | Omitted]:
    """Measure a pass of EM over all files, and the peak memory of the whole process."""
    n_points, n_components = settings.size(10_000_000, 2_600), settings.size(10, 3)
    rounds = settings.rounds(1)
    work = f"EM on disk, N = {n_points} x {sum(BLOCKS)} float32, K = {n_components}"
    folder = Path(tempfile.mkdtemp(prefix="points-", dir=settings.out))
    try:
        _write(folder, n_points // FILES, settings.seed)
        found = ask("disk", str(folder.resolve()), n_components, rounds, settings.seed)
    finally:
        shutil.rmtree(folder)
    note = "files in the system's cache, read once into another"
    beside = ("pyarrow reads the same columns", found["pyarrow"])
    asked = settings.target("times", 4)
    name = f"{work}: one pass"
    yield Row(name, "s", found["ours"], *beside, asked, rounds=rounds, note=note)
    if found["peak"] is None:
        yield Omitted(f"{work}: peak memory", "it cannot be read on this system")
    else:
        asked = settings.target("most", 1.2)
        yield Row(f"{work}: peak memory, imports included", "GB", found["peak"], asked=asked)


def _write(folder: Path, n_rows: int, seed: int) -> None:
    """Write the same points to every file: what they are does not matter here."""
    import pyarrow
    from pyarrow import parquet

    points = motions(n_rows, seed=seed).astype(np.float32)
    names = [f"column_{index}" for index in range(points.shape[1])]
    first = folder / "0.parquet"
    parquet.write_table(pyarrow.table(list(points.T), names=names), first)
    for index in range(1, FILES):
        shutil.copyfile(first, folder / f"{index}.parquet")


def answer(folder: str, n_components: int, rounds: int, seed: int) -> dict[str, object]:
    """Measure a pass of EM, and reading alone, in turns."""
    try:
        reset_peak()
        peak_is_known = True
    except OSError:
        peak_is_known = False
    batches = Batches(Path(folder))
    start = Problem.of(motions(13_000, seed=seed), n_components).start
    settings = {"blocks": BLOCKS, "tol": 0.0, "dtype": "float32"}

    def fit(n: int) -> object:
        with warnings.catch_warnings(action="ignore"):
            mixture = BlockGaussianMixture(n_components, max_iter=n, **settings)
            return mixture.fit(RowFile.of(batches), start=start)

    def read() -> None:
        for _ in batches.records():
            pass

    measurements = {"pyarrow": lambda: seconds(read), "ours": per_iteration(fit, 1, 4)}
    taken = medians(in_turns(measurements, rounds))
    return {**taken, "peak": peak_memory() / 1e9 if peak_is_known else None}

"""The state of EM on disk, so that a fit that was interrupted goes on where it was."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.em.ascent import Run
from tpgmm_torch.em.block_gaussians import Parameters
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.exceptions import DataError, ModelFileError
from tpgmm_torch.large_data.processes import ALONE, Processes
from tpgmm_torch.storage import Folder

__all__ = ["Checkpoint", "Purpose"]

FOLDER = Folder("checkpoint", 1)

#: Data are the same if moments of their columns differ by less, in standard deviations: sums
#: over another number of processes are rounded in another way.
SAME = 1e-9


@dataclass(frozen=True)
class Purpose:
    """What a fit is of: the settings that shape its result, and the data.

    Parameters
    ----------
    settings : mapping
        JSON values by name.
    columns : Tensor of shape (5, n_features)
        Mean, standard deviation, smallest, largest value and regularisation of each column.
    """

    settings: Mapping[str, Any]
    columns: Tensor

    @classmethod
    def of(
        cls, settings: Mapping[str, Any], regularization: Any, moments: ColumnMoments
    ) -> Purpose:
        """Of parameters of an estimator, and the moments of the data.

        Parameters
        ----------
        settings : mapping
            Arrays in it are replaced by their digests, a random state that is no int by None.
        regularization : float or array of shape (n_features,)
        moments : ColumnMoments
        """
        deviation = np.sqrt(moments.scatter / moments.count)
        amount = np.broadcast_to(np.asarray(regularization, np.float64), deviation.shape)
        columns = [moments.mean, deviation, moments.smallest, moments.largest, amount]
        described = {name: _described(value) for name, value in settings.items()}
        return cls(
            described | {"n_samples": moments.count}, torch.from_numpy(np.stack(columns))
        )

    def differences(self, settings: Mapping[str, Any], columns: Tensor) -> list[str]:
        """What is another with these settings and columns, in words."""
        found = [
            f"{name} was {settings.get(name)!r} and is {value!r}"
            for name, value in self.settings.items()
            if settings.get(name) != value
        ]
        if columns.shape != self.columns.shape:
            return [*found, f"there were {columns.shape[1]} columns"]
        unit = torch.where(self.columns[1] > 0, self.columns[1], 1.0).repeat(5, 1)
        unit[4] = self.columns[4].clamp(min=1e-300)
        size = torch.maximum(unit, self.columns.abs() * 1e-3)
        apart = (columns - self.columns).abs() > SAME * size
        names = ("mean", "standard deviation", "minimum", "maximum", "regularisation")
        for row, column in apart.nonzero().tolist()[:1]:
            before, now = float(columns[row, column]), float(self.columns[row, column])
            found.append(f"the {names[row]} of column {column} was {before!r} and is {now!r}")
        return found


def _described(value: Any) -> Any:
    """A JSON value that differs where the value does."""
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, Integral):
        return int(value)
    if isinstance(value, np.random.RandomState):
        return None
    if isinstance(value, (float, np.floating)):
        return float(value)
    if isinstance(value, (Tensor, np.ndarray)):
        array = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
        return hashlib.sha256(array.astype(np.float64).tobytes()).hexdigest()[:16]
    return [_described(item) for item in value]


@dataclass(frozen=True)
class Checkpoint:
    """Where ``fit`` keeps the state of EM, for a later one to go on from there.

    If the folder holds the state of the same fit (the same settings, ``max_iter`` aside, and
    the same data), ``fit`` goes on from it; the result is that of a fit without a pause.
    Nothing in it is executed. With several processes, process 0 writes it and all read it.

    Parameters
    ----------
    path : str or Path
        A folder; it is replaced as a whole each time.
    every : int, default=10
        Iterations of EM from one state to the next. The last one is always kept.

    Raises
    ------
    DataError
        If ``every`` is not positive.

    Examples
    --------
    >>> import tempfile
    >>> from tpgmm_torch import BlockGaussianMixture
    >>> X = np.random.RandomState(0).randn(100, 2)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     checkpoint = Checkpoint(Path(folder) / "em", every=2)
    ...     model = BlockGaussianMixture(2).fit(X, checkpoint=checkpoint)
    ...     checkpoint.n_iter() == model.n_iter_
    True
    """

    path: str | Path
    every: int = 10

    def __post_init__(self) -> None:
        if self.every < 1:
            raise DataError(f"every is a number of iterations, at least 1, got {self.every}")

    def n_iter(self) -> int:
        """Iterations that the kept state has behind it, of the longest run; 0 if none is kept.

        Raises
        ------
        ModelFileError
            If it is damaged, or something else is in the folder.
        """
        kept = self._read()
        runs: list[dict[str, Any]] = [] if kept is None else kept[0]["runs"]
        return max((run["n_iter"] for run in runs), default=0)

    def resume(self, purpose: Purpose, processes: Processes = ALONE) -> list[Run] | None:
        """The runs that were kept, None if there are none.

        Parameters
        ----------
        purpose : Purpose
        processes : Processes

        Raises
        ------
        ModelFileError
            If the state is damaged, or of another fit; the message says what differs.
        DataError
            If not all processes see the same state.
        """
        kept = self._read()
        seen = processes.texts("nothing" if kept is None else kept[0]["digest"])
        if len(set(seen)) > 1:
            raise DataError(
                f"the processes see different checkpoints in {self.path}: put it where all can "
                "read it"
            )
        if kept is None:
            return None
        config, tensors = kept
        try:
            found = purpose.differences(config["settings"], tensors["columns"])
            if found:
                raise ModelFileError(
                    f"the checkpoint in {self.path} is of another fit: {'; '.join(found)}. Use "
                    "another folder, or remove this one"
                )
            runs: list[dict[str, Any]] = config["runs"]
            return [_run(run, tensors, f"{i}.") for i, run in enumerate(runs)]
        except (KeyError, TypeError, AttributeError) as error:
            raise ModelFileError(f"{self.path} does not fit together: {error!r}") from error

    def keeper(
        self, purpose: Purpose, max_iter: int, processes: Processes = ALONE
    ) -> Callable[[Sequence[Run]], None]:
        """What writes the state when it is time, called after each iteration with all runs.

        Parameters
        ----------
        purpose : Purpose
        max_iter : int
            Where a run ends at the latest.
        processes : Processes
        """

        def keep(runs: Sequence[Run]) -> None:
            going = [r for r in runs if not r.converged and r.n_iter < max_iter]
            due = not going or any(run.n_iter % self.every == 0 for run in going)
            if due and processes.rank == 0:
                self._write(purpose, runs)

        return keep

    def _read(self) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
        path = Path(self.path)
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return None
        return FOLDER.read(path)

    def _write(self, purpose: Purpose, runs: Sequence[Run]) -> None:
        tensors = {"columns": purpose.columns}
        described = []
        for number, run in enumerate(runs):
            tensors |= _tensors(run, f"{number}.")
            _, _, place, has_gauss, gauss = run.rng.get_state(legacy=True)
            described.append(
                {name: getattr(run, name) for name in PLAIN}
                | {"rng": [int(place), int(has_gauss), float(gauss)]}
            )
        config = {"settings": dict(purpose.settings), "runs": described}
        FOLDER.write(self.path, json.loads(json.dumps(config)), tensors)


#: What JSON says of a run.
PLAIN = ("bounds", "n_iter", "converged", "replaced", "n_replaced", "floored")


def _tensors(run: Run, prefix: str) -> dict[str, Tensor]:
    """Numbers of a run by name; ``prefix`` tells the runs apart."""
    mixture = run.parameters
    _, keys, *_ = run.rng.get_state(legacy=True)
    numbers = torch.from_numpy(np.asarray(keys, dtype=np.int64))
    tensors = {"weights": mixture.weights, "keys": numbers}
    for j, (mean, factor) in enumerate(zip(mixture.means, mixture.factors, strict=True)):
        tensors |= {f"means.{j}": mean, f"factors.{j}": factor}
    return {prefix + name: tensor.clone() for name, tensor in tensors.items()}


def _run(described: Mapping[str, Any], tensors: Mapping[str, Tensor], prefix: str) -> Run:
    """The inverse of :func:`_tensors` and of what JSON says."""
    count = sum(name.startswith(f"{prefix}means.") for name in tensors)
    parameters = Parameters(
        tensors[f"{prefix}weights"],
        tuple(tensors[f"{prefix}means.{j}"] for j in range(count)),
        tuple(tensors[f"{prefix}factors.{j}"] for j in range(count)),
    )
    place, has_gauss, gauss = described["rng"]
    rng = np.random.RandomState()
    keys = tensors[f"{prefix}keys"].numpy().astype(np.uint32)
    rng.set_state(("MT19937", keys, place, has_gauss, gauss))
    plain = {name: described[name] for name in PLAIN}
    return Run(parameters, rng, **plain)

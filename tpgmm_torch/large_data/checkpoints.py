"""The state of EM on disk, so that a fit that was interrupted goes on where it was."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.atomic import recover
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.em.expectation_maximization import Fit
from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.exceptions import DataError, ModelFileError
from tpgmm_torch.large_data.processes import ALONE, Processes
from tpgmm_torch.storage import Folder

__all__ = ["Checkpoint"]

FOLDER = Folder("checkpoint", 2)

#: Data are the same if moments of their columns differ by less, relative to the largest of a
#: column: sums over other batches or processes are rounded in another way.
SAME = 1e-9

#: What JSON says of a fit.
PLAIN = ("bounds", "n_iter", "converged", "reseedings", "n_reseeded", "floored")


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
        """Iterations that the kept state has behind it, of the longest start; 0 without one.

        Raises
        ------
        ModelFileError
            If it is damaged, or something else is in the folder.
        """
        kept = self._read()
        fits: list[dict[str, Any]] = [] if kept is None else kept[0]["fits"]
        return max((fit["n_iter"] for fit in fits), default=0)

    def resume(
        self, settings: Mapping[str, Any], moments: ColumnMoments, processes: Processes = ALONE
    ) -> list[Fit] | None:
        """The fits that were kept, None if there are none.

        Parameters
        ----------
        settings : mapping
            What shapes the result, by name.
        moments : ColumnMoments
            Of the data.

        Raises
        ------
        ModelFileError
            If the state is damaged, or of other settings or data.
        DataError
            If not all processes see the same state.
        """
        kept = self._read()
        if len(set(processes.gather("" if kept is None else kept[0]["digest"]))) > 1:
            raise DataError(
                f"the processes see different checkpoints in {self.path}: put it where all can "
                "read it"
            )
        if kept is None:
            return None
        config, tensors = kept
        described = _described(settings)
        differences = [
            f"{name} was {config['settings'].get(name)!r} and is {value!r}"
            for name, value in described.items()
            if config["settings"].get(name) != value
        ]
        if not _same(tensors["moments"], _moments(moments)):
            differences.append("the data are other ones")
        if differences:
            raise ModelFileError(
                f"the checkpoint in {self.path} is of another fit: {'; '.join(differences)}. "
                "Use another folder, or remove this one"
            )
        return [_fit(fit, tensors, f"{i}.") for i, fit in enumerate(config["fits"])]

    def keep(
        self, fits: Sequence[Fit], settings: Mapping[str, Any], moments: ColumnMoments,
        max_iter: int,
    ) -> None:  # fmt: skip
        """Write the state if it is time: after every iteration of EM.

        Parameters
        ----------
        fits : sequence of Fit
            All of them.
        settings, moments
            As for :meth:`resume`.
        max_iter : int
            Where a fit ends at the latest.
        """
        going = [fit for fit in fits if not fit.converged and fit.n_iter < max_iter]
        if going and all(fit.n_iter % self.every for fit in going):
            return
        tensors = {"moments": _moments(moments)}
        described = []
        for number, fit in enumerate(fits):
            tensors |= _tensors(fit, f"{number}.")
            _, _, place, has_gauss, gauss = fit.rng.get_state(legacy=True)
            plain = {name: getattr(fit, name) for name in PLAIN}
            described.append(plain | {"rng": [int(place), int(has_gauss), float(gauss)]})
        FOLDER.write(self.path, {"settings": _described(settings), "fits": described}, tensors)

    def _read(self) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
        path = Path(self.path)
        recover(path)
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return None
        return FOLDER.read(path)


def _described(settings: Mapping[str, Any]) -> dict[str, Any]:
    """JSON values, with arrays by their digests and random states as None."""

    def plain(value: Any) -> Any:
        match value:
            case np.random.RandomState():
                return None
            case Tensor():
                return plain(value.detach().cpu().numpy())
            case np.ndarray() if value.ndim:
                # to the digits that do not depend on the order of sums
                content = " ".join(f"{number:.9g}" for number in value.ravel().tolist())
                return hashlib.sha256(content.encode()).hexdigest()[:16]
            case np.ndarray() | np.generic():
                return value.item()
        return list(value)

    described: dict[str, Any] = json.loads(json.dumps(dict(settings), default=plain))
    return described


def _moments(moments: ColumnMoments) -> Tensor:
    """Of each column, (5, n_features)."""
    count = np.full_like(moments.mean, moments.count)
    deviation = np.sqrt(moments.scatter / moments.count)
    columns = [count, moments.mean, deviation, moments.smallest, moments.largest]
    return torch.from_numpy(np.stack(columns))


def _same(kept: Tensor, now: Tensor) -> bool:
    if kept.shape != now.shape:
        return False
    unit = torch.maximum(now[2], 1e-3 * now[3:].abs().amax(0))
    unit = torch.stack([now[0] * 1e-3, unit, unit, unit, unit])
    return bool(((kept - now).abs() <= SAME * unit).all())


def _tensors(fit: Fit, prefix: str) -> dict[str, Tensor]:
    """Numbers of a fit by name; ``prefix`` tells the fits from each other."""
    mixture = fit.parameters
    _, keys, *_ = fit.rng.get_state(legacy=True)
    numbers = torch.from_numpy(np.asarray(keys, dtype=np.int64))
    tensors = {"weights": mixture.weights, "keys": numbers}
    for j, (mean, factor) in enumerate(zip(mixture.means, mixture.factors, strict=True)):
        tensors |= {f"means.{j}": mean, f"factors.{j}": factor}
    return {prefix + name: tensor.clone() for name, tensor in tensors.items()}


def _fit(described: Mapping[str, Any], tensors: Mapping[str, Tensor], prefix: str) -> Fit:
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
    return Fit(parameters, rng, **{name: described[name] for name in PLAIN})

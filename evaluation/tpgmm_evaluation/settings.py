"""Settings that all cells of a comparison have in common."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from lerobot_env_bimanual.disturbances import NOMINAL, parse_condition
from tpgmm_evaluation.benchmarks import Benchmark, benchmark
from tpgmm_evaluation.cells import write_json
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings:
    """Everything on which results depend, but for what tells cells apart.

    Parameters
    ----------
    env : str, default="bottle_shaking"
        Name of the benchmark.
    options : mapping, optional
        Fields of its configuration.
    rate : int, optional
        Of the recorded episodes [Hz]; the default is the environment's.
    episodes : int, default=50
        Evaluation episodes of each cell.
    budget : float, default=600
        Seconds after which the training of a baseline ends, if its validation error still
        falls.
    validation : int, default=10
        Held-out episodes on which baselines are validated; no policy learns from them.
    n_components : int, optional
        K of TP-GMM; the default is the environment's.
    demonstration_seed : int, optional
        Of the demonstrations, if all trainings learn from the same ones. The default is the
        seed of the training: each learns from another draw of demonstrations, which matters
        more than the start of the learning.
    evaluation_seed : int
        Of the first evaluation episode.
    """

    env: str = "bottle_shaking"
    options: Mapping[str, Any] = field(default_factory=dict)
    rate: int | None = None
    episodes: int = 50
    budget: float = 600.0
    validation: int = 10
    n_components: int | None = None
    demonstration_seed: int | None = None
    evaluation_seed: int = 100_000

    @property
    def seeds(self) -> range:
        """Seeds of the evaluation episodes."""
        return range(self.evaluation_seed, self.evaluation_seed + self.episodes)

    def drawn(self, seed: int) -> int:
        """Return the seed of the demonstrations that the training with a seed learns from."""
        return seed if self.demonstration_seed is None else self.demonstration_seed

    def episodes_in(self, folder: Path, seed: int) -> Path:
        """Return the folder, in that of an environment, with the episodes of a training."""
        return folder / "episodes" / f"s{self.drawn(seed)}"

    def benchmark(self) -> Benchmark:
        """Return the environment that is meant."""
        return benchmark(self.env, self.rate, self.options)

    def disturb(self, condition: str) -> dict[str, Any]:
        """Return the environment's options in a condition, disturbances joined by ``+``."""
        benchmark = self.benchmark()
        options, others = benchmark.options, []
        for name in () if condition == NOMINAL else condition.split("+"):
            if name in benchmark.disturbances:
                options = {**options, **benchmark.disturbances[name]}
            elif benchmark.conditions and _parses(name):
                others.append(name)
            else:
                where, known = f"the conditions of {self.env}", benchmark.all_conditions
                raise UnknownNameError("disturbance", name, where, known)
        if others:
            parse_condition("+".join(others))
            options = {**options, "condition": "+".join(others)}
        return options

    def knows(self, condition: str) -> bool:
        """Return whether the environment has a condition."""
        try:
            self.disturb(condition)
        except UnknownNameError:
            return False
        return True

    def keep(self, path: Path) -> None:
        """Write to a file, or check that it says the same.

        Raises
        ------
        DataError
            If the file belongs to a comparison with other settings.
        """
        now = asdict(self)
        if not path.exists():
            write_json(path, now)
            return
        before = _content(path)
        changes = [
            f"{key} was {before.get(key)!r}, now {now.get(key)!r}"
            for key in {**now, **before}
            if now.get(key) != before.get(key)
        ]
        if changes:
            raise DataError(
                f"{path.parent} holds results with other settings: {'; '.join(changes)}. Take "
                "another folder, or the earlier settings"
            )

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read back the settings that :meth:`keep` wrote.

        Raises
        ------
        DataError
            If the file is missing, or holds no settings.
        """
        content = _content(path)
        try:
            return cls(**content)
        except TypeError as error:
            raise DataError(f"{path} holds no settings of a comparison: {error}") from error


def _content(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error}") from error
    except ValueError as error:
        raise DataError(f"{path} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise DataError(f"{path} holds no settings of a comparison but {content!r}")
    return content


def _parses(name: str) -> bool:
    try:
        parse_condition(name)
    except UnknownNameError:
        return False
    return True

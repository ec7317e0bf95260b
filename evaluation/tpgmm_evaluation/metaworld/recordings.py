"""The experts' episodes in files, so that they are recorded once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lerobot_env_bimanual.metaworld.demonstrations import Recorded, record_metaworld
from lerobot_env_bimanual.metaworld.state import MetaworldStateEnv
from tpgmm_torch.atomic import replacing
from tpgmm_torch.exceptions import DataError

#: Demonstrations of training seed s are of the situations ``STRIDE * s`` and on.
STRIDE = 1000
#: Evaluations begin here, then those for tuning, then demonstrations that nothing is learned
#: from: no situation of one is one of another.
EVALUATION, TUNING, VALIDATION = 1_000_000, 2_000_000, 3_000_000
#: Episodes that tell when training shall end, the same for all training seeds.
VALIDATED = 6
#: The expert is given up after so many times the episodes that it is to solve.
PATIENCE = 5


def demonstration_seeds(seed: int, n: int) -> range:
    """Return the ``n`` situations that the expert is to solve for training seed ``seed``."""
    if not (0 <= seed < EVALUATION // STRIDE and 0 < n <= STRIDE):
        raise DataError(
            f"training seeds are from 0 to {EVALUATION // STRIDE - 1}, with up to {STRIDE} "
            f"episodes each; got {seed} and {n}"
        )
    return range(STRIDE * seed, STRIDE * seed + n)


def evaluation_seeds(n: int, *, tuning: bool = False) -> range:
    """Return the ``n`` situations that policies are tried in; others while ``tuning``."""
    first = TUNING if tuning else EVALUATION
    return range(first, first + n)


def validation_seeds() -> range:
    """Return the situations of demonstrations that nothing is learned from."""
    return range(VALIDATION, VALIDATION + VALIDATED)


def record_expert(folder: Path, task: str, seed: int, n: int, least: int) -> list[Recorded]:
    """Record the expert's episodes for a training seed, or read them from a file.

    Where it fails, it is asked for further ones, five times ``n`` in all at most.

    Parameters
    ----------
    folder : Path
        Where the files are.
    task : str
        As Meta-World names it.
    seed : int
        As of :func:`demonstration_seeds`.
    n : int
        Episodes that solve the task.
    least : int
        Episodes in any case.
    """
    asked = max(n, least)
    while True:
        seeds = demonstration_seeds(seed, asked)
        episodes = _read_or_record(folder / f"{task}-s{seed}.npz", task, seeds)
        missing = n - sum(episode.success for episode in episodes)
        if missing <= 0 or asked >= PATIENCE * n:
            return episodes
        asked += missing


def validation(folder: Path, task: str) -> list[Recorded]:
    """Return the expert's episodes of :func:`validation_seeds` that solve the task."""
    episodes = _read_or_record(folder / f"{task}-validation.npz", task, validation_seeds())
    return [episode for episode in episodes if episode.success]


def _read_or_record(path: Path, task: str, seeds: range) -> list[Recorded]:
    episodes = read(path) if path.exists() else []
    there = [episode.seed for episode in episodes]
    if there[: len(seeds)] != [*seeds][: len(there)]:
        episodes = []
    if len(episodes) < len(seeds):
        env = MetaworldStateEnv(task, control="displacement", stop_at_success=False)
        episodes = episodes + record_metaworld(env, seeds[len(episodes) :])
        env.close()
        write(path, episodes)
    return episodes[: len(seeds)]


def successes(episodes: Sequence[Recorded], n: int, task: str) -> list[Recorded]:
    """Return the first ``n`` episodes that solve the task.

    Raises
    ------
    DataError
        If there are fewer.
    """
    solved = [episode for episode in episodes if episode.success]
    if len(solved) < n:
        raise DataError(
            f"the expert of {task} solved {len(solved)} of {len(episodes)} situations, where "
            f"{n} demonstrations were asked for: ask for fewer"
        )
    return solved[:n]


def write(path: Path, episodes: Sequence[Recorded]) -> None:
    """Write episodes as ``npz`` to a path, in one step."""
    ends = np.cumsum([len(episode.actions) for episode in episodes])
    rows = {
        name: np.concatenate([getattr(episode, name) for episode in episodes])
        for name in ("observed", "references", "actions")
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as new, new.open("wb") as file:
        np.savez_compressed(
            file,
            seeds=[episode.seed for episode in episodes],
            success=[episode.success for episode in episodes],
            ends=ends,
            **rows,
        )


def read(path: Path) -> list[Recorded]:
    """Read the episodes that :func:`write` wrote.

    Raises
    ------
    DataError
        If the file is damaged, or another one.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            held = {name: file[name] for name in file.files}
        cuts = held["ends"][:-1]
        rows = [np.split(held[name], cuts) for name in ("observed", "references", "actions")]
        flags = zip(held["seeds"].tolist(), held["success"].tolist(), strict=True)
        return [
            Recorded(int(seed), observed, references, actions, bool(success))
            for (seed, success), observed, references, actions in zip(flags, *rows, strict=True)
        ]
    except (OSError, ValueError, KeyError, EOFError, TypeError) as error:
        raise DataError(f"{path} holds no episodes: {error}; delete it") from error

"""What the tests of several processes start with torchrun: one process of a job.

``python torchrun_worker.py SCENARIO FOLDER`` writes what it found into the folder. It imports
nothing of the other tests: where it is started, they are no package.
"""

import os
import signal
import sys
import traceback
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Stack,
    TaskParameterizedGMM,
)
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.mixture.processes import Processes, joined_processes
from tpgmm_torch.mixture.row_file import RowFile
from tpgmm_torch.robots import Poses

BLOCKS = (2, 3)
HAND = Poses(("hand",))


def rows(n: int = 900) -> np.ndarray:
    """Rows with shared times in the first column, (n, 5)."""
    rng = np.random.RandomState(3)
    time = rng.randint(0, 100, n) * 0.04
    waves = np.stack([np.sin(time * k) for k in range(1, 5)], 1)
    return np.column_stack([time, waves + 0.05 * rng.standard_normal(waves.shape)])


def handlings(n: int = 5) -> list[Demonstration]:
    """One tracked hand about a cup, on one time grid; every other one with -eps for eps."""
    rng, time = np.random.default_rng(1), np.linspace(0, 2, 40)
    result = []
    for number in range(n):
        cup = Frame(rng.uniform(-0.3, 0.3, 3))
        path = np.stack([np.sin(2 * time), np.cos(2 * time), 0.3 * time], 1)
        position = cup.position.numpy() + path + 2e-3 * rng.standard_normal((40, 3))
        half = 0.4 * time + 0.02 * rng.standard_normal()
        turn = (-1) ** number * np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], 1)
        joints = np.concatenate([position, turn], 1)
        result.append(Demonstration(time, joints, {"cup": cup}, HAND.joint_names))
    return result


def uneven(n: int = 5) -> list[Demonstration]:
    """Demonstrations on clocks of their own."""
    return [replace(d, time=d.time * (1 + 0.03 * i)) for i, d in enumerate(handlings(n))]


def mixture(**settings) -> BlockGaussianMixture:
    defaults = {"n_components": 4, "blocks": BLOCKS, "tol": 0.0, "max_iter": 10}
    return BlockGaussianMixture(**{**defaults, "random_state": 0, **settings})


MIXTURES = {
    "time": {},
    "several": {"n_init": 3},
    "kmeans": {"init_params": "kmeans"},
    "random": {"init_params": "random", "covariance_type": "diag"},
    "seedless": {"init_params": "random", "random_state": None},
    "single": {"dtype": "float32"},
}
SKILLS = {
    "instants": (handlings, {}),
    "uneven": (uneven, {}),
    "points": (handlings, {"responsibilities": "point", "init_params": "kmeans"}),
}


def skill(**settings) -> TaskParameterizedGMM:
    pose = Stack(RelativePosition("hand", "cup"), RelativeOrientation("hand", "cup"))
    defaults = {"tol": 0.0, "max_iter": 8, "random_state": 0}
    return TaskParameterizedGMM(4, [pose, Canonical()], HAND, **{**defaults, **settings})


def learned(model) -> dict[str, torch.Tensor]:
    tensors = {"weights": model.weights_, "bound": torch.tensor(model.lower_bound_)}
    for j, (mean, covariance) in enumerate(zip(model.means_, model.covariances_, strict=True)):
        tensors |= {f"means.{j}": mean, f"covariances.{j}": covariance}
    return tensors


def described(model: TaskParameterizedGMM) -> dict[str, torch.Tensor]:
    """The same of a skill, with its time."""
    return learned(model.mixture_) | {"grid": model.time_}


def share(processes: Processes, X):
    """Unequal parts: process 0 has a third."""
    third = len(X) // 3
    return X[:third] if processes.rank == 0 else X[third:]


def equal(processes: Processes, folder: Path) -> None:
    """Fit all kinds of models, and save each process's results."""
    found = {}
    for name, settings in MIXTURES.items():
        part = share(processes, rows())
        source = part if name != "time" else RowFile.of([part[:100], part[100:]])
        found[name] = learned(mixture(**settings).fit(source, processes=processes))
    for name, (demonstrations, settings) in SKILLS.items():
        model = skill(**settings).fit(share(processes, demonstrations(5)), processes=processes)
        found[name] = described(model)
    torch.save(found, folder / f"found{processes.rank}.pt")


def refused(processes: Processes, folder: Path) -> None:
    """Bad shares: all processes get an error, none hangs; save what they say."""
    nothing = np.empty((0, 5))
    ragged = rows()[:, : 5 - processes.rank]
    bare = [replace(d, frames={}) for d in handlings(3)]
    attempts = {
        "empty": lambda: mixture().fit(
            RowFile.of([rows() if processes.rank == 0 else nothing]), processes=processes
        ),
        "columns": lambda: mixture(blocks=None).fit(ragged, processes=processes),
        "few": lambda: mixture(n_components=9).fit(
            np.repeat(rows()[:3], 20, 0), processes=processes
        ),
        "none": lambda: skill().fit(
            [handlings(2)] if processes.rank == 0 else [[]], processes=processes
        ),
        "frames": lambda: skill().fit(
            handlings(3) if processes.rank == 0 else bare, processes=processes
        ),
        "share": lambda: processes.share([1]),
    }
    for name, attempt in attempts.items():
        try:
            attempt()
            message = "nothing was raised"
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
        (folder / f"{name}{processes.rank}.txt").write_text(message)


def dies(processes: Processes, folder: Path) -> None:
    """Process 1 is killed in the middle of a fit."""
    if processes.rank == 1:
        exchanged, add = [], processes.sum

        def deadly(*tensors):
            exchanged.append(1)
            if len(exchanged) == 5:
                os.kill(os.getpid(), signal.SIGKILL)
            return add(*tensors)

        processes.sum = deadly
    try:
        mixture(max_iter=50).fit(rows(), processes=processes)
    except Exception:
        (folder / f"error{processes.rank}.txt").write_text(traceback.format_exc())
        raise
    (folder / f"model{processes.rank}.txt").write_text("learned")


if __name__ == "__main__":
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    scenario = {"equal": equal, "refused": refused, "dies": dies}[sys.argv[1]]
    with joined_processes() as processes:
        scenario(processes, Path(sys.argv[2]))

"""EM by two processes together, beside one of them alone."""

import warnings
from collections.abc import Iterator
from time import perf_counter, process_time

import numpy as np
import torch
from numpy.typing import NDArray
from torch import distributed

from benchmarks.child import ask
from benchmarks.machine import cores_allowed
from benchmarks.points import Problem, motions
from benchmarks.rows import Omitted, Row
from benchmarks.settings import Settings
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.mixture.processes import ALONE, Processes, joined_processes

__all__ = ["measure"]

LAUNCHER = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2")


def measure(settings: Settings) -> Iterator[Row | Omitted]:
    """Measure an iteration: halves of points in two gloo processes, and all in one."""
    n_points, n_components = settings.size(1_000_000, 2_600), settings.size(10, 3)
    rounds = settings.rounds(3)
    work = f"EM iteration, N = {n_points}, K = {n_components}, float64, two gloo processes"
    if settings.full and cores_allowed() < 2:
        yield Omitted(work, "this process may use one core only")
        return
    arguments = (n_points, n_components, rounds, settings.seed)
    taken = ask("processes", *arguments, launcher=LAUNCHER)
    asked, other = settings.target("faster", 1.85), "ours in one process"
    (wall, busy), (alone, busy_alone) = taken["two"], taken["one"]
    yield Row(work, "s", wall, other, alone, asked, rounds=rounds)
    note = "what is left when the other core is free: the row before needs two that are"
    work += ": processor time of the busier"
    yield Row(work, "s", busy, other, busy_alone, rounds=rounds, note=note)


def answer(
    n_points: int, n_components: int, rounds: int, seed: int
) -> dict[str, list[float]] | None:
    """Take seconds as one of the two processes; the first one tells them."""
    with joined_processes() as joined:
        found = _in_turns(joined, n_points, n_components, rounds, seed)
        return found if joined.rank == 0 else None


def _in_turns(
    processes: Processes, n_points: int, n_components: int, rounds: int, seed: int
) -> dict[str, list[float]]:
    """Take wall and processor seconds of an iteration, the larger of two processes."""
    torch.set_num_threads(1)
    problem = Problem.of(motions(n_points, seed=seed), n_components)
    half = len(problem.points) // 2
    share = problem.points[:half] if processes.rank == 0 else problem.points[half:]
    settings = {"blocks": problem.blocks, "tol": 0.0}

    def taken(n: int, points: object, together: Processes) -> NDArray[np.float64]:
        mixture = BlockGaussianMixture(n_components, max_iter=n, **settings)
        began = np.array([perf_counter(), process_time()])
        with warnings.catch_warnings(action="ignore"):
            mixture.fit(points, start=problem.start, processes=together)
        return np.array([perf_counter(), process_time()]) - began

    def iteration(points: object, together: Processes) -> NDArray[np.float64]:
        return (taken(6, points, together) - taken(2, points, together)) / 4

    found: dict[str, list[NDArray[np.float64]]] = {"two": [], "one": []}
    for _ in range(rounds):
        larger = torch.from_numpy(iteration(share, processes))
        distributed.all_reduce(larger, distributed.ReduceOp.MAX)
        found["two"].append(larger.numpy())
        if processes.rank == 0:  # the other one waits at the barrier, without computing
            found["one"].append(iteration(problem.points, ALONE))
        distributed.barrier()
    return {name: np.median(each, axis=0).tolist() for name, each in found.items() if each}

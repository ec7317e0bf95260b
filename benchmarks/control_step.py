"""One control tick of one robot, kinematics included."""

from collections.abc import Iterator
from time import perf_counter

import numpy as np
import torch

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import learned, skill

__all__ = ["measure"]


def measure(settings: Settings) -> Iterator[Row]:
    """Ten thousand ticks: the skill from start to end, and again from another start."""
    ticks = settings.size(10_000, 30)
    taken = 1e3 * _latencies(settings, ticks)
    work = "model.step, batch 1, 17 joints, two hands, K = 10, P = 2, float64, eager"
    median, late = float(np.median(taken)), float(np.percentile(taken, 99))
    yield Row(f"{work}: median", "ms", median, asked=settings.asked("most", 0.45), rounds=ticks)
    yield Row(
        f"{work}: 99th percentile", "ms", late, asked=settings.asked("most", 1), rounds=ticks
    )


def _latencies(settings: Settings, ticks: int) -> np.ndarray:
    """Seconds of each tick, of what a controller has to wait for: floats in, floats out."""
    model = learned(settings)
    grid = model.time_.tolist()
    situations = skill(settings).situations(ticks // len(grid) + 1, settings.seed + 1000)
    taken = np.empty(ticks)
    with torch.inference_mode():
        for tick in range(-min(200, ticks), ticks):  # the first ones warm up
            at = max(tick, 0) % len(grid)
            if at == 0:
                situation = situations[max(tick, 0) // len(grid)]
                joints = situation.joints
            began = perf_counter()
            estimate = model.step(grid[at], joints, situation.frames)
            taken[tick] = perf_counter() - began
            joints = estimate.joints
    return taken

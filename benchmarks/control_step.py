"""One control tick of one robot, kinematics included."""

from collections.abc import Callable, Iterator
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import fit_model, skill
from tpgmm_torch.skills.compiled import compile_skill

__all__ = ["measure"]

Step = Callable[..., Any]


def measure(settings: Settings) -> Iterator[Row]:
    """Measure ten thousand ticks: the skill from start to end, from many starts."""
    ticks = settings.size(10_000, 30)
    model = fit_model(settings)
    step: Step = model.step
    work = "model.step, batch 1, 17 joints, two hands, K = 10, P = 2, float64"
    for how, asked in (("eager", (0.45, 1.0)), ("compiled", (0.18, None))):
        if how == "compiled":
            # at tiny sizes, what is asked is only whether it runs
            backend = "inductor" if settings.full else "aot_eager"
            step = compile_skill(model.skill, backend=backend).estimate
        taken = 1e3 * _latencies(step, model.time_, settings, ticks)
        figures = float(np.median(taken)), float(np.percentile(taken, 99))
        names = "median", "99th percentile"
        for name, figure, most in zip(names, figures, asked, strict=True):
            limit = None if most is None else settings.target("most", most)
            yield Row(f"{work}, {how}: {name}", "ms", figure, asked=limit, rounds=ticks)


def _latencies(step: Step, time: Tensor, settings: Settings, ticks: int) -> np.ndarray:
    """Take seconds of each tick, of what a controller waits for: floats in, floats out."""
    grid = list(time)
    situations = skill(settings).situations(ticks // len(grid) + 1, settings.seed + 1000)
    taken = np.empty(ticks)
    with torch.inference_mode():
        for tick in range(-min(200, ticks), ticks):  # the first ones warm up
            at = max(tick, 0) % len(grid)
            if at == 0:
                situation = situations[max(tick, 0) // len(grid)]
                joints = situation.joints
            began = perf_counter()
            estimate = step(grid[at], joints, situation.frames)
            taken[tick] = perf_counter() - began
            joints = estimate.joints
    return taken

"""One tick of a controller: as it is, and exported, in Python."""

from collections.abc import Callable, Iterator
from time import perf_counter
from typing import Any

import numpy as np
import torch

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import learned, skill
from tpgmm_torch import load_exported

__all__ = ["measure"]


def measure(settings: Settings) -> Iterator[Row]:
    """Loading, and ticks of the skill from its start to its end, again and again."""
    model, ticks = learned(settings), settings.size(5_000, 30)
    [situation] = skill(settings).situations(1, settings.seed + 1000)
    start, frames = situation.joints, situation.frames
    dt = float(model.time_.diff().median())

    def controller() -> Callable[[float], Any]:
        made = model.controller(start, frames, clock="even", trust=None, smoothing=None)
        made.step(dt)
        return made.step

    ways = {"eager": (controller, 0.45)}
    if settings.full:  # at tiny sizes, a minute of compiling shows nothing
        path = settings.out / "exported.pt2"
        model.export(path)
        began = perf_counter()
        exported = load_exported(path)
        loading = perf_counter() - began
        path.unlink()
        yield Row("load_exported", "s", loading, asked=settings.asked("most", 1.0), rounds=1)

        def again() -> Callable[[float], Any]:
            exported.reset(start, frames)
            return exported.step

        ways["exported"] = again, 0.12
    work = "controller, batch 1, 17 joints, two hands, K = 10, P = 2, float64"
    for how, (begin, most) in ways.items():
        taken = 1e3 * _latencies(begin, dt, ticks, len(model.time_) - 1)
        figures = float(np.median(taken)), float(np.percentile(taken, 99))
        names = "median", "99th percentile"
        for name, figure, limit in zip(names, figures, (most, 1.0), strict=True):
            asked = settings.asked("most", limit)
            yield Row(f"{work}, {how}: {name}", "ms", figure, asked=asked, rounds=ticks)


def _latencies(
    begin: Callable[[], Callable[[float], Any]], dt: float, ticks: int, length: int
) -> np.ndarray:
    """Seconds of each tick."""
    taken, step = np.empty(ticks), begin()
    with torch.inference_mode():
        for tick in range(-min(200, ticks), ticks):  # the first ones warm up
            if tick % length == 0:
                step = begin()
            began = perf_counter()
            step(dt)
            taken[tick] = perf_counter() - began
    return taken

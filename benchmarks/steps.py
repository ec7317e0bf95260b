"""Ticks of one robot and of thousands, and whole reproductions, kinematics included."""

from collections.abc import Callable, Iterator
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import compile_estimate, fit_model, skill
from benchmarks.timing import Work, in_turns, medians, per_call, seconds
from tpgmm_torch import Frame, Situation, TaskParameterizedGMM

__all__ = ["measure_batch", "measure_one", "measure_whole", "tick", "tick_of_one"]

Step = Callable[..., Any]


def measure_one(settings: Settings) -> Iterator[Row]:
    """Measure ten thousand ticks: the skill from start to end, from many starts."""
    ticks = settings.size(10_000, 30)
    model = fit_model(settings)
    steps: dict[str, tuple[Step, float, float | None]] = {
        "eager": (model.step, 0.45, 1.0),
        "compiled": (compile_estimate(settings, model), 0.18, None),
    }
    work = "model.step, batch 1, 17 joints, two hands, K = 10, P = 2, float64"
    for how, (step, *asked) in steps.items():
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


def measure_batch(settings: Settings) -> Iterator[Row]:
    """Measure robots with bottles and postures of their own, and one clock or many."""
    n_robots = settings.size(4096, 8)
    rounds = settings.rounds(9)
    model = fit_model(settings, dtype="float32")
    compiled = compile_estimate(settings, model, n_robots)
    ticks = {
        "one clock": tick(model, settings, n_robots, False),
        "own clocks": tick(model, settings, n_robots, True),
        "one clock, compiled": tick(model, settings, n_robots, False, compiled),
    }
    measurements = {name: per_call(work, 1) for name, work in ticks.items()}
    taken = medians(in_turns(measurements, rounds, warm_up=True))
    for name in measurements:
        work = f"model.step, {n_robots} robots, {name}, float32, mean and covariance: per robot"
        asked = settings.target("most", 14 if "compiled" in name else 25)
        yield Row(work, "us", 1e6 * taken[name] / n_robots, asked=asked, rounds=rounds)


def tick(
    model: TaskParameterizedGMM,
    settings: Settings,
    n_robots: int,
    own_clocks: bool = True,
    estimate: Step | None = None,
) -> Work:
    """Make a tick of a batch of robots, 3 s after they began, or up to a second apart."""
    situations = skill(settings).situations(n_robots, settings.seed + 2000)
    like = model.time_
    joints = torch.stack([situation.joints for situation in situations]).to(like)
    bottles = [situation.frames["bottle"] for situation in situations]
    positions = torch.stack([bottle.position for bottle in bottles]).to(like)
    orientations = torch.stack([bottle.orientation for bottle in bottles]).to(like)
    time = torch.full((), 3.0).to(like)
    if own_clocks:
        time = time + torch.linspace(-1, 1, n_robots).to(like)
    frames = {"bottle": Frame(positions, orientations)}
    return _tick(model.step, estimate or model.step, time, joints, frames)


def tick_of_one(settings: Settings, step: Step) -> Work:
    """Make a tick of one robot, 3 s after it began."""
    [situation] = skill(settings).situations(1, settings.seed + 2000)
    time = torch.tensor(3.0, dtype=torch.float64)
    return _tick(step, step, time, situation.joints, situation.frames)


def _tick(first: Step, step: Step, time: Tensor, joints: Tensor, frames: Any) -> Work:
    """Let robots catch up with the skill by some ticks, as those on their way have."""
    for _ in range(5):
        joints = first(time, joints, frames).joints

    def work() -> object:
        with torch.inference_mode():
            return step(time, joints, frames)

    return work


def measure_whole(settings: Settings) -> Iterator[Row]:
    """Measure fifty situations from start to end, and one; plain, and with candidates."""
    model = fit_model(settings)
    situations = skill(settings).situations(settings.size(50, 2), settings.seed + 1000)
    first, last = float(model.time_[0]), float(model.time_[-1])
    time = torch.linspace(first, last, settings.size(1300, len(model.time_)))
    situations = [Situation(s.joints, s.frames, time.double()) for s in situations]
    rounds = settings.rounds(3)
    measurements = {
        f"predict, {len(given)} situation(s) x {len(time)} steps, float64, {how}": partial(
            seconds, partial(model.predict, given, **options)
        )
        for given in (situations, situations[:1])
        for how, options in (("eager", {"candidates": False}), ("with candidates", {}))
    }
    limits = [settings.target("most", 5), None, None, None]
    taken = medians(in_turns(measurements, rounds, warm_up=settings.full))
    for (name, figure), most in zip(taken.items(), limits, strict=True):
        yield Row(name, "s", figure, asked=most, rounds=rounds)

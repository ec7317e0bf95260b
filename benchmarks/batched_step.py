"""One control tick of thousands of robots at a time, kinematics included."""

from collections.abc import Callable, Iterator
from typing import Any

import torch

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import fit_model, skill
from benchmarks.timing import Work, in_turns, medians, per_call
from tpgmm_torch import Frame, TaskParameterizedGMM
from tpgmm_torch.skills.compiled import compile_skill

__all__ = ["measure", "tick"]


def measure(settings: Settings) -> Iterator[Row]:
    """Measure robots with bottles and postures of their own, and one clock or many."""
    n_robots = settings.size(4096, 8)
    rounds = settings.rounds(9)
    model = fit_model(settings, dtype="float32")
    clocks = {"one clock": False, "own clocks": True}
    measurements = {
        name: per_call(tick(model, settings, n_robots, own), 1) for name, own in clocks.items()
    }
    # at tiny sizes, what is asked is only whether it runs
    backend = "inductor" if settings.full else "aot_eager"
    compiled = compile_skill(model.skill, n_robots, backend).estimate
    work = tick(model, settings, n_robots, False, compiled)
    measurements["one clock, compiled"] = per_call(work, 1)
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
    estimate: Callable[..., Any] | None = None,
) -> Work:
    """Make a tick of a batch of robots, 3 s after they began, or up to a second apart.

    They have caught up with the skill by some ticks, as robots on their way have.
    """
    situations = skill(settings).situations(n_robots, settings.seed + 2000)
    like = model.time_
    joints = torch.stack([situation.joints for situation in situations]).to(like)
    bottles = [situation.frames["bottle"] for situation in situations]
    positions = torch.stack([bottle.position for bottle in bottles]).to(like)
    orientations = torch.stack([bottle.orientation for bottle in bottles]).to(like)
    frames = {"bottle": Frame(positions, orientations)}
    time = torch.full((), 3.0).to(like)
    if own_clocks:
        time = time + torch.linspace(-1, 1, n_robots).to(like)
    for _ in range(5):
        joints = model.step(time, joints, frames).joints

    step = estimate or model.step

    def work() -> object:
        with torch.inference_mode():
            return step(time, joints, frames)

    return work

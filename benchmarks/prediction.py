"""Whole reproductions of many situations at once."""

import copy
import functools
from collections.abc import Iterator

import torch

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import learned, skill
from benchmarks.timing import in_turns, medians, seconds
from tpgmm_torch import Situation

__all__ = ["measure"]


def measure(settings: Settings) -> Iterator[Row]:
    """Fifty situations from start to end, and one; plain, compiled, and with candidates."""
    model = learned(settings)
    situations = skill(settings).situations(settings.size(50, 2), settings.seed + 1000)
    first, last = float(model.time_[0]), float(model.time_[-1])
    time = torch.linspace(first, last, settings.size(1300, len(model.time_)))
    situations = [Situation(s.joints, s.frames, time.double()) for s in situations]
    rounds = settings.rounds(3)
    compiled = copy.copy(model).compile(
        "inductor" if settings.full else "aot_eager", n_robots=len(situations)
    )
    work = {
        "eager": lambda: model.predict(situations, candidates=False),
        "with candidates": lambda: model.predict(situations),
        "compiled": lambda: compiled.predict(situations, candidates=False),
        "one situation": lambda: model.predict(situations[:1], candidates=False),
        "one situation, with candidates": lambda: model.predict(situations[:1]),
    }
    measurements = {name: functools.partial(seconds, call) for name, call in work.items()}
    taken = medians(in_turns(measurements, rounds, warm_up=settings.full))
    for name, figure in taken.items():
        count = 1 if name.startswith("one") else len(situations)
        how = name.removeprefix("one situation").removeprefix(", ") or "eager"
        yield Row(
            f"predict, {count} situation(s) x {len(time)} steps, float64, {how}",
            "s",
            figure,
            asked=settings.asked("most", 5) if name == "eager" else None,
            rounds=rounds,
        )

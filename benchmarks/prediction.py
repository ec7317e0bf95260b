"""Whole reproductions of many situations at once."""

from collections.abc import Iterator
from functools import partial

import torch

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import fit_model, skill
from benchmarks.timing import in_turns, medians, seconds
from tpgmm_torch import Situation

__all__ = ["measure"]


def measure(settings: Settings) -> Iterator[Row]:
    """Measure fifty situations from start to end, and one; plain, and with candidates."""
    model = fit_model(settings)
    situations = skill(settings).situations(settings.size(50, 2), settings.seed + 1000)
    first, last = float(model.time_[0]), float(model.time_[-1])
    time = torch.linspace(first, last, settings.size(1300, len(model.time_)))
    situations = [Situation(s.joints, s.frames, time.double()) for s in situations]
    rounds = settings.rounds(3)
    one = situations[:1]
    work = [
        ("eager", situations, {"candidates": False}, settings.target("most", 5)),
        ("with candidates", situations, {}, None),
        ("eager", one, {"candidates": False}, None),
        ("with candidates", one, {}, None),
    ]
    measurements, limits = {}, {}
    for how, given, options, most in work:
        name = f"predict, {len(given)} situation(s) x {len(time)} steps, float64, {how}"
        measurements[name] = partial(seconds, partial(model.predict, given, **options))
        limits[name] = most
    taken = medians(in_turns(measurements, rounds, warm_up=settings.full))
    for name, figure in taken.items():
        yield Row(name, "s", figure, asked=limits[name], rounds=rounds)

"""Whole reproductions of many situations at once."""

from collections.abc import Iterator

import torch

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import learned, skill
from benchmarks.timing import in_turns, medians, seconds
from tpgmm_torch import Situation

__all__ = ["measure"]


def measure(settings: Settings) -> Iterator[Row]:
    """Fifty situations from start to end."""
    model = learned(settings)
    situations = skill(settings).situations(settings.size(50, 2), settings.seed + 1000)
    first, last = float(model.time_[0]), float(model.time_[-1])
    time = torch.linspace(first, last, settings.size(1300, len(model.time_)))
    situations = [Situation(s.joints, s.frames, time.double()) for s in situations]
    rounds = settings.rounds(3)
    work = {"predict": lambda: seconds(lambda: model.predict(situations, candidates=False))}
    taken = medians(in_turns(work, rounds))
    yield Row(
        f"predict, {len(situations)} situations x {len(time)} steps, float64",
        "s",
        taken["predict"],
        asked=settings.asked("most", 5),
        rounds=rounds,
        note="without candidates",
    )

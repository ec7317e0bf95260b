"""Whole reproductions of many situations at once."""

from collections.abc import Iterator

from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import learned, skill
from benchmarks.timing import in_turns, medians, seconds

__all__ = ["measure"]


def measure(settings: Settings) -> Iterator[Row]:
    """Fifty situations from start to end."""
    model = learned(settings)
    situations = skill(settings).situations(settings.size(50, 2), settings.seed + 1000)
    rounds = settings.rounds(3)
    work = {"predict": lambda: seconds(lambda: model.predict(situations, candidates=False))}
    taken = medians(in_turns(work, rounds))
    yield Row(
        f"predict, {len(situations)} situations x {len(model.time_)} steps, float64",
        "s",
        taken["predict"],
        asked=settings.asked("most", 5),
        rounds=rounds,
        note="without candidates",
    )

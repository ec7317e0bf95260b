"""Stop watches: medians of measurements taken in turns."""

import gc
import statistics
from collections.abc import Callable, Mapping
from time import perf_counter

__all__ = ["in_turns", "medians", "per_call", "per_iteration", "seconds"]

Work = Callable[[], object]
Measurement = Callable[[], float]


def seconds(work: Work) -> float:
    """Wall time of one call [s], without garbage collection, as timeit does it."""
    gc.disable()
    try:
        began = perf_counter()
        work()
        return perf_counter() - began
    finally:
        gc.enable()


def per_call(work: Work, calls: int) -> Measurement:
    """A measurement of many calls, for what takes microseconds: seconds of one."""

    def measure() -> float:
        began = perf_counter()
        for _ in range(calls):
            work()
        return (perf_counter() - began) / calls

    return measure


def per_iteration(fit: Callable[[int], object], few: int, many: int) -> Measurement:
    """A measurement of one iteration, as the difference of two fits.

    Parameters
    ----------
    fit : callable
        ``fit(n)`` makes n iterations, besides what does not depend on n.
    few, many : int
        Numbers of iterations.
    """

    def measure() -> float:
        short, long = seconds(lambda: fit(few)), seconds(lambda: fit(many))
        return (long - short) / (many - few)

    return measure


def in_turns(
    measurements: Mapping[str, Measurement],
    rounds: int,
    limits: Mapping[str, int] | None = None,
    *,
    warm_up: bool = False,
) -> dict[str, list[float]]:
    """Take every measurement in every round, so that all see the same weather.

    Parameters
    ----------
    measurements : mapping of str to callable
    rounds : int
    limits : mapping of str to int, optional
        Most rounds for those that take long.
    warm_up : bool, default=False
        Take one round more, which does not count.
    """
    if warm_up:
        in_turns(measurements, 1)
    taken: dict[str, list[float]] = {name: [] for name in measurements}
    for number in range(rounds):
        for name, measurement in measurements.items():
            if number < (limits or {}).get(name, rounds):
                taken[name].append(measurement())
    return taken


def medians(taken: Mapping[str, list[float]]) -> dict[str, float]:
    """The median of each."""
    return {name: statistics.median(values) for name, values in taken.items()}

"""Stop watches: medians of measurements taken in turns."""

import gc
import statistics
from collections.abc import Callable, Mapping
from functools import partial
from time import perf_counter

__all__ = ["in_turns", "medians", "per_call", "per_iteration", "seconds"]

Work = Callable[[], object]
Measurement = Callable[[], float]


def seconds(work: Work, clock: Measurement | None = None) -> float:
    """Take the time of a call [s] by a clock, without garbage collection, as timeit."""
    clock = clock or perf_counter
    gc.disable()
    try:
        began = clock()
        work()
        return clock() - began
    finally:
        gc.enable()


def per_call(work: Work, calls: int, clock: Measurement | None = None) -> Measurement:
    """Make a measurement of many calls, for what takes microseconds: seconds of one."""

    def repeat() -> None:
        for _ in range(calls):
            work()

    def measure() -> float:
        return seconds(repeat, clock) / calls

    return measure


def per_iteration(
    fit: Callable[[int], object], few: int, many: int, clock: Measurement | None = None
) -> Measurement:
    """Make a measurement of an iteration, as the difference of two fits.

    Parameters
    ----------
    fit : callable
        ``fit(n)`` makes n iterations, besides what does not depend on n.
    few, many : int
        Numbers of iterations.
    clock : callable, optional
        As :func:`seconds`.
    """

    def measure() -> float:
        short, long = (seconds(partial(fit, n), clock) for n in (few, many))
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
    """Compute the median of each."""
    return {name: statistics.median(values) for name, values in taken.items()}

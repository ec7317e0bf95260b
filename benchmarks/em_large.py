"""EM on a million points: dense, gated along time, and in float32."""

import gc
from collections.abc import Iterator

import torch

from benchmarks import mixtures
from benchmarks.points import BLOCKS, Problem, motions
from benchmarks.roofline import flops_of_iteration, peak
from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.timing import in_turns, medians, per_iteration

__all__ = ["measure"]

#: Number of components -> ratios asked for: dense, gated, gated in float32.
ASKED = {10: (5, 7.5, 7), 50: (11, 34, 22)}
#: Of rows that are not gated over time, and of those that are.
NOTES = (
    "times are shuffled, so that no component is left out",
    "points that are far in time from a component leave it out; the share of the peak counts "
    "the arithmetic of all components",
)


def measure(settings: Settings) -> Iterator[Row]:
    """Measure an iteration from a given start, for few and for many components."""
    n_points = settings.size(1_000_000, 1_300)
    points = motions(n_points, seed=settings.seed)
    for n_components, asked in ASKED.items():
        n_components = settings.size(n_components, n_components // 5)
        yield from _rows(settings, Problem.of(points, n_components), asked)


def _rows(settings: Settings, problem: Problem, asked: tuple[float, ...]) -> Iterator[Row]:
    n_points, n_components = len(problem.points), len(problem.weights)
    fits = {
        "dense, float64": (mixtures.ours(problem.shuffle_times(settings.seed)), "float64"),
        "gated, float64": (mixtures.ours(problem), "float64"),
        "gated, float32": (mixtures.ours(problem, "float32"), "float32"),
    }
    others = {dtype: mixtures.scikit_learn(problem, dtype) for dtype in ("float64", "float32")}
    measurements = {
        name: per_iteration(fit, *settings.iterations(1, 3)) for name, (fit, _) in fits.items()
    }
    measurements |= {dtype: per_iteration(fit, 1, 2) for dtype, fit in others.items()}
    rounds = settings.rounds(2)
    # half a minute for one of its iterations
    limits = dict.fromkeys(others, rounds if n_components <= 10 else 1)
    every = in_turns(measurements, rounds, limits)
    taken = medians(every)
    for (name, (_, dtype)), figure in zip(fits.items(), asked, strict=True):
        flops = flops_of_iteration(n_points, n_components, BLOCKS)
        share = flops / taken[name] / peak(getattr(torch, dtype))
        work = f"EM iteration, N = {n_points}, K = {n_components}, {name}"
        other = f"scikit-learn, full, {dtype}, {len(every[dtype])} round(s)"
        asked, n = settings.target("faster", figure), len(every[name])
        note = NOTES["gated" in name]
        yield Row(work, "s", taken[name], other, taken[dtype], asked, share, n, note)
    gc.collect()

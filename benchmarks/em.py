"""EM on as many points as ten demonstrations have, and on a million; beside other libraries."""

import gc
from collections.abc import Callable, Iterator

import torch

from benchmarks import mixtures
from benchmarks.points import BLOCKS, Problem, motions
from benchmarks.roofline import flops_of_iteration, peak
from benchmarks.rows import Omitted, Row
from benchmarks.settings import Settings
from benchmarks.timing import Measurement, in_turns, medians, per_iteration

__all__ = ["measure_large", "measure_small"]

STARTS = 10
OTHERS = {"pomegranate": mixtures.pomegranate, "gmr": mixtures.gmr}
#: Number of components -> ratios asked for: dense, gated, gated in float32.
ASKED = {10: (5, 7.5, 7), 50: (11, 34, 22)}
#: Of rows that are not gated over time, and of those that are.
NOTES = (
    "times are shuffled, so that no component is left out",
    "points that are far in time from a component leave it out; the share of the peak counts "
    "the arithmetic of all components",
)


def measure_small(settings: Settings) -> Iterator[Row | Omitted]:
    """Measure an iteration from a given start, and of each of ten starts."""
    n_points, n_components = settings.size(13_000, 650), settings.size(10, 3)
    problem = Problem.of(motions(n_points, seed=settings.seed), n_components)
    ours, starts = mixtures.ours(problem), mixtures.ours(problem, n_init=STARTS)
    few, many = settings.iterations(2, 7), settings.iterations(2, 12)
    measurements: dict[str, Measurement] = {
        "ours": per_iteration(ours, *many),
        "scikit-learn": per_iteration(mixtures.scikit_learn(problem), *few),
        "restarts": per_iteration(starts, *many),
    }
    for name, other in OTHERS.items():
        fit = _available(name, other, problem)
        if isinstance(fit, Omitted):
            yield fit
        else:
            measurements[name] = per_iteration(fit, *settings.iterations(2, 5))
    rounds = settings.rounds(7)
    taken = medians(in_turns(measurements, rounds, warm_up=settings.full))
    flops = flops_of_iteration(n_points, n_components, BLOCKS) / peak(torch.float64)
    milli = {name: 1e3 * value for name, value in taken.items()}
    work = f"EM iteration, N = {n_points}, K = {n_components}, float64"
    theirs = ("scikit-learn, full", milli["scikit-learn"])
    for name, n, figure in (("ours", 1, 4.5), ("restarts", STARTS, 9)):
        per_start = f", per start of {n}" if n > 1 else ""
        each, asked = milli[name] / n, settings.target("faster", figure)
        yield Row(work + per_start, "ms", each, *theirs, asked, 1e3 * flops / each, rounds)
    for name in OTHERS:
        if name in milli:
            yield Row(work, "ms", milli["ours"], f"{name}, full", milli[name], rounds=rounds)


def _available(
    name: str, other: Callable[[Problem], mixtures.Fit], problem: Problem
) -> mixtures.Fit | Omitted:
    try:
        return other(problem)
    except ImportError as error:
        return Omitted(f"EM iteration of {name}", f"{error} (pip install 'tpgmm-torch[bench]')")


def measure_large(settings: Settings) -> Iterator[Row]:
    """Measure an iteration on a million points: dense, gated along time, and in float32."""
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
    flops = flops_of_iteration(n_points, n_components, BLOCKS)
    for (name, (_, dtype)), figure in zip(fits.items(), asked, strict=True):
        share = flops / taken[name] / peak(getattr(torch, dtype))
        work = f"EM iteration, N = {n_points}, K = {n_components}, {name}"
        other = f"scikit-learn, full, {dtype}, {len(every[dtype])} round(s)"
        target, n, note = (
            settings.target("faster", figure),
            len(every[name]),
            NOTES["gated" in name],
        )
        yield Row(work, "s", taken[name], other, taken[dtype], target, share, n, note)
    gc.collect()

"""EM on as many points as ten demonstrations have."""

from collections.abc import Callable, Iterator

import torch

from benchmarks import mixtures
from benchmarks.points import BLOCKS, Problem, motions
from benchmarks.roofline import flops_of_iteration, peak
from benchmarks.rows import Omitted, Row
from benchmarks.settings import Settings
from benchmarks.timing import Measurement, in_turns, medians, per_iteration

__all__ = ["measure"]

STARTS = 10
OTHERS = {"pomegranate": mixtures.pomegranate, "gmr": mixtures.gmr}


def measure(settings: Settings) -> Iterator[Row | Omitted]:
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
    for name, starts, figure in (("", 1, 4.5), (f", per start of {STARTS}", STARTS, 9)):
        each = (milli["restarts"] if name else milli["ours"]) / starts
        asked, share = settings.target("faster", figure), 1e3 * flops / each
        yield Row(work + name, "ms", each, *theirs, asked, share, rounds)
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

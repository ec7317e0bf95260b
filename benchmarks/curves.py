"""How the cost grows: with points, components, dimensions, operators, robots. A picture."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from benchmarks import mixtures
from benchmarks.points import Problem, motions
from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import fit_model
from benchmarks.steps import tick
from benchmarks.timing import in_turns, medians, per_call, per_iteration

__all__ = ["measure"]

COMPONENTS, WIDTH = 10, 16
EM = "EM iteration [ms]"
POINTS, NUMBERS = (650, 2_600, 10_400, 41_600, 166_400), (2, 5, 10, 20, 50)


@dataclass(frozen=True)
class _Curve:
    """Cost over one number; the others stay. ``cost(number)`` gives it by library."""

    title: str
    numbers: Sequence[int]
    ylabel: str
    cost: Callable[[int], Mapping[str, float]]


def measure(settings: Settings) -> Iterator[Row]:
    """Measure five curves, in ``cost.png``; every point is a row too."""
    rounds = settings.rounds(3)
    usual, components = settings.size(26_000, 650), settings.size(COMPONENTS, 3)

    def em(n_points: int, n_components: int, widths: tuple[int, ...]) -> Mapping[str, float]:
        points = motions(n_points, widths, settings.seed)
        problem = Problem.of(points, n_components, widths)
        fits = {"ours": mixtures.ours(problem), "scikit-learn": mixtures.scikit_learn(problem)}
        measurements = {
            name: per_iteration(fit, *settings.iterations(2, 4)) for name, fit in fits.items()
        }
        return {name: 1e3 * s for name, s in medians(in_turns(measurements, rounds)).items()}

    def step(n_robots: int) -> Mapping[str, float]:
        work = tick(fit_model(settings), settings, n_robots)
        measurements = {"ours": per_call(work, max(1, settings.size(64, 1) // n_robots))}
        [taken] = medians(in_turns(measurements, rounds, warm_up=True)).values()
        return {"ours": 1e6 * taken / n_robots}

    two, most = (WIDTH, WIDTH), None if settings.full else 2
    k, at, width = f"K = {components}", f"N = {usual}", f"D = 2 x {WIDTH}"
    curves = [
        _Curve(f"points N ({k}, {width})", POINTS, EM, lambda n: em(n, components, two)),
        _Curve(f"components K ({at}, {width})", NUMBERS, EM, lambda n: em(usual, n, two)),
        _Curve(
            f"columns D, half in each block ({at}, {k})",
            (8, 16, 32, 64),
            EM,
            lambda n: em(usual, components, (n // 2, n // 2)),
        ),
        _Curve(
            f"blocks P of {WIDTH} columns ({at}, {k})",
            (1, 2, 3, 4),
            EM,
            lambda n: em(usual, components, (WIDTH,) * n),
        ),
        _Curve("robots in a batch", (1, 8, 64, 512, 4096), "step, per robot [us]", step),
    ]
    costs = [
        pd.DataFrame({number: curve.cost(number) for number in curve.numbers[:most]}).T
        for curve in curves
    ]
    _draw(curves, costs, settings)
    for curve, cost in zip(curves, costs, strict=True):
        unit = curve.ylabel.partition("[")[2].rstrip("]")
        for number, found in cost.iterrows():
            theirs = found.get("scikit-learn")
            other = "" if theirs is None else "scikit-learn, full"
            work = f"{number} {curve.title}"
            yield Row(work, unit, found["ours"], other, theirs, rounds=rounds)


def _draw(curves: Sequence[_Curve], costs: Sequence[pd.DataFrame], settings: Settings) -> None:
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 3, figsize=(13, 7), layout="constrained")
    for axis, curve, cost in zip(axes.flat, curves, costs, strict=False):
        cost.clip(lower=1e-3).plot(ax=axis, style="o-", loglog=True, grid=True)
        axis.set(ylabel=curve.ylabel)
        axis.set_title(curve.title, fontsize="small")
        axis.set_xticks(cost.index, [f"{number:,}" for number in cost.index])
        axis.minorticks_off()
    axes.flat[-1].axis("off")
    figure.savefig(settings.out / "cost.png", dpi=110)
    pyplot.close(figure)

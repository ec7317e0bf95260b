"""How the cost grows: with points, components, dimensions, operators, robots. A picture."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

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

    two = (WIDTH, WIDTH)
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
    costs = []
    for curve in curves:
        numbers = curve.numbers if settings.full else curve.numbers[:2]
        costs.append({number: curve.cost(number) for number in numbers})
    _draw(curves, costs, settings)
    for curve, by_number in zip(curves, costs, strict=True):
        for number, cost in by_number.items():
            unit = curve.ylabel.partition("[")[2].rstrip("]")
            theirs = cost.get("scikit-learn")
            other = "" if theirs is None else "scikit-learn, full"
            work = f"{number} {curve.title}"
            yield Row(work, unit, cost["ours"], other, theirs, rounds=rounds)


def _draw(
    curves: Sequence[_Curve],
    costs: Sequence[Mapping[int, Mapping[str, float]]],
    settings: Settings,
) -> None:
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot, ticker

    figure, axes = pyplot.subplots(2, 3, figsize=(13, 7), layout="constrained")
    for axis, curve, by_number in zip(axes.flat, curves, costs, strict=False):
        for name in next(iter(by_number.values())):
            values = [cost[name] for cost in by_number.values()]
            axis.loglog(list(by_number), np.maximum(values, 1e-3), "o-", label=name)
        axis.set(title=curve.title, ylabel=curve.ylabel)
        axis.set_xticks(list(by_number), [f"{number:,}" for number in by_number], minor=False)
        axis.xaxis.set_minor_locator(ticker.NullLocator())
        axis.title.set_fontsize("small")
        axis.legend(fontsize="small")
        axis.grid(alpha=0.3)
    axes.flat[-1].axis("off")
    figure.savefig(settings.out / "cost.png", dpi=110)
    pyplot.close(figure)

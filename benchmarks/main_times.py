"""Processor time of the main work alone, in turns: what ``make regressions`` compares."""

from collections.abc import Iterator
from functools import partial
from time import process_time

from benchmarks import mixtures
from benchmarks.child import ask
from benchmarks.points import Problem, motions
from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import align_demonstrations, compile_estimate, fit_model, model, skill
from benchmarks.steps import tick, tick_of_one
from benchmarks.timing import (
    Measurement,
    Work,
    in_turns,
    medians,
    per_call,
    per_iteration,
    seconds,
)

__all__ = ["measure"]

# other work on the machine hardly changes processor time
_call, _iteration = (partial(each, clock=process_time) for each in (per_call, per_iteration))

#: The slow ones are measured so many times, if others are measured more often.
FEW = 2


def measure(settings: Settings) -> Iterator[Row]:
    """Measure import, fit, EM, a step and whole skills; plain, and a compiled step."""
    made, shown = fit_model(settings), align_demonstrations(settings)
    given = skill(settings).situations(settings.size(50, 2), settings.seed + 1000)
    problem = Problem.of(motions(settings.size(13_000, 650), seed=settings.seed), 10)
    large = Problem.of(motions(settings.size(1_000_000, 1_300), seed=settings.seed), 10)
    many, calls = settings.size(4096, 8), settings.size(300, 3)
    compiled = compile_estimate(settings, made)
    iterations = settings.iterations(2, 12), settings.iterations(1, 3)
    measurements = {
        "import tpgmm_torch": lambda: ask("start_up", "tpgmm_torch")[0],
        "import of the estimator": lambda: ask("start_up", "tpgmm_torch.estimator")[0],
        "fit of the demo": _once(lambda: model(settings, 30).fit(shown)),
        "EM iteration, 13k points": _iteration(mixtures.ours(problem), *iterations[0]),
        "EM iteration, 1M points": _iteration(mixtures.ours(large), *iterations[1]),
        "step, one robot": _call(tick_of_one(settings, made.step), calls),
        "step, one robot, compiled": _call(tick_of_one(settings, compiled), calls),
        f"step, {many} robots": _call(tick(made, settings, many), 1),
        "predict, one situation": _once(partial(made.predict, given[:1], candidates=False)),
        f"predict, {len(given)} situations": _once(
            partial(made.predict, given, candidates=False)
        ),
    }
    rounds = settings.rounds(5)
    slow = dict.fromkeys(("EM iteration, 1M points", f"predict, {len(given)} situations"), FEW)
    taken = in_turns(measurements, rounds, slow, warm_up=settings.full)
    for name, figure in medians(taken).items():
        yield Row(name, "s", figure, rounds=len(taken[name]))


def _once(work: Work) -> Measurement:
    return partial(seconds, work, process_time)

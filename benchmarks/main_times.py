"""Processor time of the main work alone, in turns: what ``make regressions`` compares."""

from collections.abc import Callable, Iterator
from functools import partial
from time import process_time
from typing import Any

import torch

from benchmarks import mixtures
from benchmarks.batched_step import tick
from benchmarks.child import ask
from benchmarks.points import Problem, motions
from benchmarks.rows import Row
from benchmarks.settings import Settings
from benchmarks.skill import align_demonstrations, fit_model, model, skill
from benchmarks.timing import (
    Measurement,
    Work,
    in_turns,
    medians,
    per_call,
    per_iteration,
    seconds,
)
from tpgmm_torch.skills.compiled import compile_skill

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
    # at tiny sizes, what is asked is only whether it runs
    backend = "inductor" if settings.full else "aot_eager"
    compiled = compile_skill(made.skill, backend=backend).estimate
    iterations = settings.iterations(2, 12), settings.iterations(1, 3)
    measurements = {
        "import tpgmm_torch": lambda: ask("start_up", "tpgmm_torch")[0],
        "import of the estimator": lambda: ask("start_up", "tpgmm_torch.estimator")[0],
        "fit of the demo": _once(lambda: model(settings, 30).fit(shown)),
        "EM iteration, 13k points": _iteration(mixtures.ours(problem), *iterations[0]),
        "EM iteration, 1M points": _iteration(mixtures.ours(large), *iterations[1]),
        "step, one robot": _call(_one_robot(settings, made.step), calls),
        "step, one robot, compiled": _call(_one_robot(settings, compiled), calls),
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


def _one_robot(settings: Settings, step: Callable[..., Any]) -> Work:
    """Make a tick of a robot that has caught up with the skill, 3 s after it began."""
    [situation] = skill(settings).situations(1, settings.seed + 2000)
    time, joints = torch.tensor(3.0, dtype=torch.float64), situation.joints
    for _ in range(5):
        joints = step(time, joints, situation.frames).joints

    def work() -> object:
        with torch.inference_mode():
            return step(time, joints, situation.frames)

    return work

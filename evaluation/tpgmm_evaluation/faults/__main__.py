"""Run a controller on random servos with random faults.

    python -m tpgmm_evaluation.faults --half development --runs 100
    python -m tpgmm_evaluation.faults --half development --run 17

The first prints a table with a row for each kind of fault, and the seeds of the worst runs of
each measure (:func:`~tpgmm_evaluation.faults.measures.measure`); the second one run, every
tenth of a second, with references, readings and joints. The run of a seed depends on
``--half``, ``--rates`` and ``--robots``.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from tpgmm_evaluation.faults.drawing import HALVES, Run
from tpgmm_evaluation.faults.measures import Measures, false_status, measure, measure_runs
from tpgmm_evaluation.faults.runs import simulate
from tpgmm_evaluation.faults.skills import ROBOTS

#: Of loops [Hz].
RATES = "25,50,100,200,500,1000"
#: What is printed of a measure of several runs, and what of one run counts as bad.
COLUMNS: Mapping[str, tuple[str, float]] = {
    **dict.fromkeys(("position", "speed", "acceleration", "jerk"), ("sum", 0)),
    "step": ("max", 1.515),
    **dict.fromkeys(("infinite", "raised", "false", "open", "stuck"), ("sum", 0)),
    "mute": ("max", 0.5),
    "late": ("max", 1),
    "gap": ("max", 0.05),
    "runaway": ("max", 0.05),
}


def _table(found: Sequence[tuple[Run, Measures]]) -> str:
    """Tabulate measures in a row for each kind of fault, and for all runs."""
    runs = pd.DataFrame([measures for _, measures in found])
    kinds = [run.labels for run, _ in found]
    by_kind = runs.assign(kind=kinds).explode("kind").groupby("kind")
    head = f"{'':13}{'runs':>5}{'true %':>8}{'ends %':>8}"
    lines = [head + "".join(f"{name[:8]:>9}" for name in COLUMNS)]
    for kind, rows in [*by_kind, ("all", runs)]:
        cells = [f"{rows[name].agg(how):9.3g}" for name, (how, _) in COLUMNS.items()]
        true = 100 - 100 * rows["false"].sum() / rows.ticks.sum()
        ends = 100 * rows.ended.mean()
        lines.append(f"{kind:13}{len(rows):5}{true:8.2f}{ends:8.1f}{''.join(cells)}")
    return "\n".join(lines)


def _worst(found: Sequence[tuple[Run, Measures]]) -> str:
    """List seeds of the worst runs of each measure."""
    lines = []
    for name, (_, most) in COLUMNS.items():
        worst = sorted(((m[name], run.seed) for run, m in found if m[name] > most))[::-1]
        seeds = ", ".join(f"{seed} ({size:.3g})" for size, seed in worst[:8])
        lines.append(f"{name:13}{len(worst):4} runs > {most:g}   {seeds}")
    return "\n".join(lines)


def _show(run: Run) -> None:
    """Print one run, every tenth of a second."""
    with warnings.catch_warnings(action="ignore"):
        [log] = simulate([run])
    ticks, wrong = log.ticks, false_status(log)
    every = max(1, round(run.rate / 10))
    with np.printoptions(precision=3, suppress=True, linewidth=200):
        for k in range(0, len(wrong), every):
            false = "FALSE" if wrong[k : k + every].any() else ""
            when = f"{ticks.time[k]:6.2f} s at {ticks.progress[k]:5.2f} {ticks.status[k]:9}"
            print(f"{when} {false:5}", ticks.reference[k], ticks.reading[k], ticks.joints[k])
    print(run, log.reason, log.error, measure(log), sep="\n")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command line."""
    prog, form = "python -m tpgmm_evaluation.faults", argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog, description=__doc__, formatter_class=form)
    parser.add_argument("--half", choices=HALVES, default=HALVES[0], help="of the seeds")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the first run")
    parser.add_argument("--run", type=int, metavar="SEED", help="show this run alone")
    parser.add_argument("--rates", default=RATES, help="with commas [Hz]")
    parser.add_argument("--robots", default=",".join(ROBOTS), help="with commas")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    given = parser.parse_args(arguments)
    rates, robots = [float(rate) for rate in given.rates.split(",")], given.robots.split(",")
    if given.run is not None:
        _show(Run.draw(given.half, given.run, rates, robots))
        return
    seeds = range(given.seed, given.seed + given.runs)
    runs = [Run.draw(given.half, seed, rates, robots) for seed in seeds]
    found = measure_runs(runs, given.workers)
    print(_table(found), _worst(found), sep="\n")


if __name__ == "__main__":
    main()

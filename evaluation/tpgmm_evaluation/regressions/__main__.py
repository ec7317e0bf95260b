"""``make baseline``, ``make regressions``: measure what must not get worse, and compare.

    python -m tpgmm_evaluation.regressions baseline --small
    python -m tpgmm_evaluation.regressions compare --small --only goldens,demo
    python -m tpgmm_evaluation.regressions sensitivity tpgmm_torch.regression.prior:PRIOR_STD

``baseline`` writes one file for each cell into ``OUT/baseline`` (``OUT/baseline-small``);
``compare`` measures the present code in the same way into ``OUT/now`` (``OUT/now-small``) and
compares. Both go on where they were stopped; remove ``OUT/now`` after a change of code, or
give ``--again``. ``--base`` is another checkout, beside which times are taken in turns.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from tpgmm_evaluation.regressions.comparison import compare_cells, read_pairs, table
from tpgmm_evaluation.regressions.plan import Plan
from tpgmm_evaluation.regressions.sections import SECTIONS, measure, measure_times
from tpgmm_evaluation.regressions.sensitivity import sensitivity


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tpgmm_evaluation.regressions",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=("baseline", "compare", "sensitivity"))
    parser.add_argument("constant", nargs="?", help="MODULE:NAME, for sensitivity")
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    parser.add_argument("--small", action="store_true", help="minutes in place of hours")
    parser.add_argument("--only", help="sections, with commas")
    parser.add_argument("--workers", type=int, default=2, help="processes for rollouts")
    parser.add_argument("--again", action="store_true", help="measure what was measured before")
    parser.add_argument("--base", type=Path, help="checkout to take times beside, in turns")
    parser.add_argument("--rounds", type=int, default=3, help="of times taken in turns")
    given = parser.parse_args(arguments)
    usual = ("goldens", "recordings") if given.what == "sensitivity" else SECTIONS
    given.only = given.only or ",".join(usual)
    if unknown := set(given.only.split(",")) - set(SECTIONS):
        parser.error(f"--only: no such section: {sorted(unknown)}; there are {list(SECTIONS)}")
    return given


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; 1 if something failed or is worse."""
    given = _options(arguments)
    torch.set_num_threads(1)
    return {"baseline": _measure, "compare": _compare, "sensitivity": _vary}[given.what](given)


def _plan(given: argparse.Namespace, folder: str) -> Plan:
    return Plan(given.out / folder, given.small, workers=given.workers)


def _form(given: argparse.Namespace) -> str:
    return "-small" if given.small else ""


def _measure(given: argparse.Namespace, name: str = "baseline", left_out: str = "") -> int:
    """Measure the sections but one; return how many fail."""
    plan = _plan(given, f"{name}{_form(given)}")
    if given.again:
        shutil.rmtree(plan.out, ignore_errors=True)
    sections = [section for section in given.only.split(",") if section != left_out]
    return int(bool(measure(plan, sections)))


def _compare(given: argparse.Namespace) -> int:
    """Measure the present code, and print what changed; 1 if something is worse."""
    sections = given.only.split(",")
    beside = given.base is not None and "times" in sections
    left_out = "times" if beside else ""
    failed = _measure(given, "now", left_out)
    before, now = (_plan(given, f"{name}{_form(given)}") for name in ("baseline", "now"))
    cells = list(read_pairs(before.out, now.out, [s for s in sections if s != left_out]))
    for _ in range(given.rounds if beside else 0):
        usual = measure_times(given.base, given.small)
        cells.append(("times", usual, measure_times(now.root, given.small)))
    rows = compare_cells(cells)
    print(*table(rows), sep="\n")
    return int(failed or any(row.worse for row in rows))


def _vary(given: argparse.Namespace) -> int:
    """Print how much a constant matters."""
    plan = _plan(given, "sensitivity")
    for line in sensitivity(given.constant or "", plan, given.only.split(",")):
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

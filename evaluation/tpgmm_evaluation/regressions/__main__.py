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
from dataclasses import replace
from pathlib import Path

import torch

from tpgmm_evaluation.regressions.comparison import compared, stored, table
from tpgmm_evaluation.regressions.plan import Plan
from tpgmm_evaluation.regressions.sections import SECTIONS, measure, timed
from tpgmm_evaluation.regressions.sensitivity import sensitivity

__all__ = ["main"]


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
    form = "-small" if given.small else ""
    before = given.out / f"baseline{form}"
    plan = Plan(before, given.small, workers=given.workers)
    if given.what == "sensitivity":
        plan = replace(plan, out=given.out / "sensitivity")
        for line in sensitivity(given.constant or "", plan, given.only.split(",")):
            print(line, flush=True)
        return 0
    if given.what == "compare":
        plan = replace(plan, out=given.out / f"now{form}")
    if given.again:
        shutil.rmtree(plan.out, ignore_errors=True)
    sections = given.only.split(",")
    beside = given.what == "compare" and given.base is not None and "times" in sections
    if beside:
        sections.remove("times")
    failures = measure(plan, sections)
    if given.what == "baseline":
        return int(bool(failures))
    cells = list(stored(before, plan.out, sections))
    for _ in range(given.rounds if beside else 0):
        turn = timed(given.base, given.small), timed(plan.root, given.small)
        cells.append(("times", *turn))
    rows = compared(cells)
    print(*table(rows), sep="\n")
    return int(bool(failures) or any(row.worse for row in rows))


if __name__ == "__main__":
    sys.exit(main())

"""Measure how fast the library is: ``make bench``, or ``python -m benchmarks --help``.

Each case measures one kind of work and its competitors in the same run, one after the other in
turns, and writes ``OUT/CASE.json``; the table ``OUT/results.md`` is made from all that are in
OUT, so that a single case can be measured anew.
"""

import argparse
import os
from pathlib import Path

from benchmarks.settings import CASES, Settings

ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    # pomegranate imports a package that compiles functions for seconds; no mixture uses them
    "NUMBA_DISABLE_JIT": "1",
}


def settings() -> tuple[list[str], Settings]:
    """Read the names of cases, and how to measure them, from the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--only", help=f"cases, with commas between: {','.join(CASES)}")
    parser.add_argument("--sizes", choices=("full", "tiny"), default="full")
    parser.add_argument("--out", type=Path, default=Path("out/bench"), metavar="DIR")
    parser.add_argument("--repeat", type=int, help="rounds of every measurement")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    names = given.only.split(",") if given.only else list(CASES)
    if unknown := [name for name in names if name not in CASES]:
        parser.error(f"--only: no such case: {unknown}; there are {list(CASES)}")
    if given.repeat is not None and given.repeat < 1:
        parser.error(f"--repeat must be at least 1, got {given.repeat}")
    return names, Settings(given.sizes == "full", given.out, given.repeat, given.seed)


def main() -> None:
    """Run."""
    names, how = settings()
    # read by the libraries when they are loaded, which is why this import waits
    os.environ.update(ENVIRONMENT)
    from benchmarks.suite import run

    run(names, how)


if __name__ == "__main__":
    main()

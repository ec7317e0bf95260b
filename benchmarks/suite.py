"""Run cases one after the other, and write what they found."""

import json
import os
from collections.abc import Sequence
from importlib import import_module
from time import perf_counter

import torch

from benchmarks.machine import machine
from benchmarks.rows import format_table
from benchmarks.settings import CASES, Settings

__all__ = ["run"]


def run(names: Sequence[str], settings: Settings) -> None:
    """Measure the cases, write a JSON file each, and the table of all that there are.

    Parameters
    ----------
    names : sequence of str
        Keys of ``CASES``.
    settings : Settings
        How to measure.
    """
    torch.set_num_threads(1)
    settings.out.mkdir(parents=True, exist_ok=True)
    for name in names:
        print(f"{name} ...", flush=True)
        began, busy = perf_counter(), _cpu_seconds()
        module, _, function = CASES[name].partition(".")
        measure = getattr(import_module(f"benchmarks.{module}"), function)
        records = [found.record() for found in measure(settings)]
        report = {
            "case": name,
            "sizes": "full" if settings.full else "tiny",
            "seed": settings.seed,
            "seconds": perf_counter() - began,
            "CPU seconds": _cpu_seconds() - busy,
            "rows": records,
            "machine": machine(),
        }
        path = settings.out / f"{name}.json"
        path.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n", "utf-8")
        print(format_table(records), flush=True)
    if set(names) != {"curves"}:
        _write_table(settings)


def _cpu_seconds() -> float:
    """Return the processor time of this process and of children that have ended [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _write_table(settings: Settings) -> None:
    # the points of the curves are in their picture
    files = [settings.out / f"{name}.json" for name in CASES if name != "curves"]
    reports = [json.loads(path.read_text("utf-8")) for path in files if path.is_file()]
    records = [record for report in reports for record in report["rows"]]
    where = max((report["machine"] for report in reports), key=lambda machine: machine["date"])
    versions = ", ".join(f"{name} {v}" for name, v in where["versions"].items() if v)
    heading = (
        f"{where['processor']}, {where['threads']} thread, {where['blas']}, "
        f"{where['instructions']}; Python {where['python']}, {versions}; "
        f"{where['date']}.\n\n"
    )
    path = settings.out / "results.md"
    path.write_text(heading + format_table(records), encoding="utf-8")
    print(f"all rows: {path}")

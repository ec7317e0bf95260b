"""Processor time of imports, in new interpreters."""

import importlib
from collections.abc import Iterator
from statistics import median
from time import process_time

from benchmarks.child import ask
from benchmarks.rows import Row
from benchmarks.settings import Settings

__all__ = ["measure"]

#: What a model needs, in this order: each one's time is without those before it.
MODULES = ("torch", "sklearn.base", "tpgmm_torch.estimator")


def measure(settings: Settings) -> Iterator[Row]:
    """Measure the package alone, which loads the rest when it is asked for, and all."""
    rounds = settings.rounds(5)
    if settings.full:  # from now on, the files are in the system's cache
        ask("start_up", *MODULES)
    package, parts = [], []
    for _ in range(rounds):
        package += ask("start_up", "tpgmm_torch")
        parts.append(ask("start_up", *MODULES))
    torch = median(part[0] for part in parts)
    note = "PyTorch and scikit-learn are loaded when first needed: the next rows"
    asked, beside = settings.target("times", 1.5), ("import torch", torch)
    yield Row(
        "import tpgmm_torch", "s", median(package), *beside, asked, rounds=rounds, note=note
    )
    whole = median(map(sum, parts))
    work = "from tpgmm_torch import TaskParameterizedGMM"
    yield Row(work, "s", whole, *beside, rounds=rounds)
    both = median(part[0] + part[1] for part in parts)
    yield Row(work, "s", whole, "import torch, sklearn.base", both, rounds=rounds)


def answer(*modules: str) -> list[float]:
    """Import modules one after the other; return the seconds of each."""
    taken = []
    for module in modules:
        began = process_time()
        importlib.import_module(module)
        taken.append(process_time() - began)
    return taken

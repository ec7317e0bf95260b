"""Processes that save and are killed, at any moment."""

import os
import signal
import time
import warnings
from collections.abc import Callable

import numpy as np


def forked(function: Callable[[], object]) -> int:
    """Call a function in a process of its own; its number. Exit code 1 says that it raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads: none saves
        pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        function()
        code = 0
    finally:
        os._exit(code)


def exit_code(pid: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def killed_between(
    save: Callable[[int], object], load: Callable[[], int], count: int, seed: int = 0
) -> tuple[int, int]:
    """Save 0, 1, 2, ... each in a process that is killed at a random moment.

    After each kill what is loaded must be the last one that was there, or the new one; what
    cannot be loaded raises.

    Returns
    -------
    old, new : int
        How often which of them was there.
    """
    save(0)
    start = time.perf_counter()
    assert exit_code(forked(lambda: save(1))) == 0
    duration = time.perf_counter() - start
    rng, present, outcome = np.random.default_rng(seed), load(), [0, 0]
    assert present == 1
    for number in range(2, 2 + count):
        pid = forked(lambda number=number: save(number))
        time.sleep(float(rng.uniform(0, 1.3 * duration)))
        os.kill(pid, signal.SIGKILL)
        exit_code(pid)
        found = load()
        assert found in (present, number), f"{found} after {present} and {number}"
        outcome[found == number] += 1
        present = found
    return outcome[0], outcome[1]

"""Independent jobs in processes of their own: one that fails or dies spares the others."""

from __future__ import annotations

import multiprocessing
import os
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

#: Loaded once, in the process from which all jobs fork.
PRELOADED = "tpgmm_evaluation.jobs"


def run_jobs(
    function: Callable[..., None],
    jobs: Sequence[tuple[Any, ...]],
    workers: int,
    logs: Sequence[Path],
) -> Iterator[tuple[int, str | None]]:
    """Call a function for each job, several at a time.

    Parameters
    ----------
    function : callable
        Of a module.
    jobs : sequence of tuple
        Its arguments.
    workers : int
        How many run at a time.
    logs : sequence of Path
        For each job, where the traceback goes if it fails.

    Yields
    ------
    number : int
        Of a job that has ended, in the order in which they end.
    problem : str or None
        In a line, if it failed.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([PRELOADED])
    waiting = list(enumerate(jobs))
    running: dict[Any, tuple[int, Any]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                number, job = waiting.pop(0)
                logs[number].unlink(missing_ok=True)
                arguments = (function, job, logs[number])
                process = context.Process(target=_call, args=arguments, daemon=True)
                process.start()
                running[process.sentinel] = (number, process)
            for sentinel in wait(list(running)):
                number, process = running.pop(sentinel)
                process.join()
                yield number, _problem(process.exitcode, logs[number])
    finally:
        for _, process in running.values():
            process.terminate()


def _call(function: Callable[..., None], job: tuple[Any, ...], log: Path) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        function(*job)
    except BaseException as error:
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_text(traceback.format_exc(), encoding="utf-8")
        if not isinstance(error, Exception):
            raise
        os._exit(1)


def _end_with_parent() -> None:
    """End with a run that was killed, so as not to get in the way of the next."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _problem(code: int | None, log: Path) -> str | None:
    if code == 0:
        return None
    if log.exists():
        return log.read_text(encoding="utf-8").strip().splitlines()[-1]
    return f"its process ended with code {code}"

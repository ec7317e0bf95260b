"""Independent jobs in processes of their own: one that fails or dies spares the others."""

from __future__ import annotations

import multiprocessing
import os
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, cast

#: Loaded once, in the process from which all jobs fork.
PRELOADED = "tpgmm_evaluation.jobs"


def run_jobs(
    function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], workers: int
) -> Iterator[tuple[int, Any, str]]:
    """Call a function for each job, several at a time.

    Parameters
    ----------
    function : callable
        Of a module.
    jobs : sequence of tuple
        Its arguments.
    workers : int
        How many run at a time.

    Yields
    ------
    number : int
        Of a job that has ended, in the order in which they end.
    value : object
        What the function returned.
    problem : str
        The traceback, or how its process ended; empty if nothing failed.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([PRELOADED])
    waiting = list(enumerate(jobs))
    running: dict[Any, tuple[int, Any]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                number, job = waiting.pop(0)
                answer, its = context.Pipe(duplex=False)
                process = context.Process(target=_call, args=(function, job, its), daemon=True)
                process.start()
                its.close()
                running[answer] = number, process
            for ready in wait(list(running)):
                number, process = running.pop(ready)
                try:
                    value, problem = cast(Connection, ready).recv()
                    process.join()
                except EOFError:  # it died
                    process.join()
                    value, problem = None, f"its process ended with code {process.exitcode}"
                yield number, value, problem
    finally:
        for _, process in running.values():
            process.terminate()


def call_all(
    function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], workers: int
) -> list[Any]:
    """Call a function for each job; return the values in the order of the jobs.

    Raises
    ------
    RuntimeError
        If one fails; with its traceback.
    """
    values = {}
    for number, value, problem in run_jobs(function, jobs, workers):
        if problem:
            raise RuntimeError(problem)
        values[number] = value
    return [values[number] for number in range(len(jobs))]


def _call(function: Callable[..., Any], job: tuple[Any, ...], answer: Connection) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        answer.send((function(*job), ""))
    except BaseException:
        answer.send((None, traceback.format_exc()))
        os._exit(1)


def _end_with_parent() -> None:
    """End with a run that was killed, so as not to get in the way of the next."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

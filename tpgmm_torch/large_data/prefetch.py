"""One batch ahead: the next one is read while the last one is used."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator

__all__ = ["prefetched"]


def prefetched[T](source: Iterable[T]) -> Iterator[T]:
    """Walk through ``source`` in a thread of its own, one item ahead of who asks.

    Parameters
    ----------
    source : iterable

    Yields
    ------
    object
        The same items in the same order. At most three are in memory: one in use, one
        waiting, one being read.

    Raises
    ------
    Exception
        What the source raises, itself, with a note of how many items came before it.

    Examples
    --------
    >>> list(prefetched(range(3)))
    [0, 1, 2]
    """
    waiting: queue.Queue[tuple[T] | BaseException | None] = queue.Queue(maxsize=1)
    stopped = threading.Event()

    def put(item: tuple[T] | BaseException | None) -> None:
        while not stopped.is_set():
            try:
                return waiting.put(item, timeout=0.1)
            except queue.Full:
                continue

    def read() -> None:
        count = 0
        try:
            for item in source:
                put((item,))
                count += 1
                if stopped.is_set():
                    return
        except BaseException as error:
            error.add_note(f"while reading ahead, after {count} batches")
            put(error)
        else:
            put(None)

    reader = threading.Thread(target=read, name="tpgmm-reader", daemon=True)
    reader.start()
    try:
        while (item := waiting.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item[0]
    finally:
        stopped.set()
        reader.join()

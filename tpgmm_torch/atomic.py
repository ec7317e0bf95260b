"""Files and folders replaced in one step: there is the old or the new, and never a part."""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["replacing"]

# How Linux and macOS let two names change places: <fcntl.h>, <linux/fs.h>, <sys/stdio.h>.
AT_FDCWD, RENAME_EXCHANGE, RENAME_SWAP = -100, 2, 2


@contextmanager
def replacing(path: str | Path, *, keep: bool = False) -> Iterator[Path]:
    """Write a file or a folder that takes the place of ``path`` when the block ends.

    It is written beside ``path``, brought to the disk, and moved there. If the block raises,
    or the process dies wherever it is, ``path`` is what it was, or all that is new. (Where
    the system or the file system cannot let two folders change places, one that dies in
    between leaves the old one under the name ``.NAME.*.previous``.)

    Parameters
    ----------
    path : str or Path
        What is replaced, if it is there; folders above it are made.
    keep : bool, default=False
        Whether files of the old folder that are not among the new ones stay.

    Yields
    ------
    Path
        Where to write: the block makes a file or a folder of this name.

    Examples
    --------
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for text in ("old", "new"):
    ...         with replacing(Path(folder) / "notes.txt") as file:
    ...             written = file.write_text(text)
    ...     (Path(folder) / "notes.txt").read_text()
    'new'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(
        prefix=f".{path.name}.", dir=path.parent, ignore_cleanup_errors=True
    ) as folder:
        new = Path(folder) / path.name
        yield new
        if keep and path.is_dir():
            _take_over(path, new)
        for item in [*new.rglob("*"), new]:
            _synchronize(item)
        if new.is_dir() and path.exists():
            _exchange(new, path)
        else:
            new.replace(path)
        _synchronize(path.parent)


def _take_over(old: Path, new: Path) -> None:
    """Link what is missing, which takes no time and no space; copy where links cannot be."""
    for source in old.rglob("*"):
        target = new / source.relative_to(old)
        if source.is_dir() and not source.is_symlink():
            target.mkdir(parents=True, exist_ok=True)
        elif not target.exists(follow_symlinks=False):
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(source, target, follow_symlinks=False)
            except OSError:
                shutil.copy2(source, target, follow_symlinks=False)


def _synchronize(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    if os.name == "posix" and not path.is_symlink() and (path.is_file() or path.is_dir()):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _exchange(new: Path, path: Path) -> None:
    """Put ``new`` in the place of ``path``; what was there is removed, or is ``new`` then."""
    if _swap(new, path):
        return
    previous = path.with_name(f"{new.parent.name}.previous")
    path.rename(previous)
    try:
        new.rename(path)
    except BaseException:
        previous.rename(path)
        raise
    shutil.rmtree(previous, ignore_errors=True)


def _swap(one: Path, other: Path) -> bool:
    """Let two names change places in one step; False where that cannot be."""
    names = os.fsencode(one), os.fsencode(other)
    try:
        library = ctypes.CDLL(None, use_errno=True)
        if sys.platform == "darwin":
            failed = library.renamex_np(*names, RENAME_SWAP)
        else:
            failed = library.renameat2(AT_FDCWD, names[0], AT_FDCWD, names[1], RENAME_EXCHANGE)
    except (AttributeError, OSError, TypeError):  # the C library has no such function
        return False
    return not failed

"""Files and folders replaced in one step: there is the old or the new, and never a part."""

from __future__ import annotations

import os
import re
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

#: How a file begins that stands for one which Git LFS has not fetched.
POINTER = b"version https://git-lfs.github.com/spec/"
#: What file managers leave behind.
LEFT_OVER = re.compile(r"\._.*|\.DS_Store|Thumbs\.db|desktop\.ini", re.IGNORECASE)


def contents(folder: Path) -> set[str]:
    """List what is in a folder, without what file managers leave behind."""
    return {item.name for item in folder.iterdir() if not LEFT_OVER.fullmatch(item.name)}


@contextmanager
def replacing(path: str | Path, *, keep: bool = False) -> Iterator[Path]:
    """Write a file or a folder that takes the place of ``path`` when the block ends.

    It is written beside ``path``, brought to the disk, and moved there. If the block raises,
    ``path`` is what it was. If the process dies, it is what it was, or all that is new; where
    an old folder had been moved away and the new one was not there yet, :func:`recover`, which
    readers call, puts it back. Writers of one path wait for each other, so what the block reads
    of the old is still the old at its end.

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

    Raises
    ------
    OSError
        If one of the folders above it is a file, or it cannot be written there.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     for text in ("old", "new"):
    ...         with replacing(Path(folder) / "notes.txt") as file:
    ...             written = file.write_text(text)
    ...     (Path(folder) / "notes.txt").read_text()
    'new'
    """
    path = Path(path)
    if path.name in ("", ".."):  # "." has no name of its own
        path = path.resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    with _alone(path):
        _put_back(path)
        folder = _beside(path, "new")
        shutil.rmtree(folder, ignore_errors=True)  # of a writer that died
        folder.mkdir()
        new = folder / path.name
        try:
            yield new
            if keep and path.is_dir():
                _take_over(path, new)
            for item in [*new.rglob("*"), new]:
                _synchronize(item)
            if new.is_dir() and path.exists():  # a folder replaces none that has files
                path.rename(_beside(path, "previous"))
            new.replace(path)
            _synchronize(path.parent)
        finally:
            _put_back(path)
            shutil.rmtree(folder, ignore_errors=True)


def recover(path: str | Path) -> None:
    """Put back what stood under ``path`` if its writer died between two renames.

    Parameters
    ----------
    path : str or Path
        What is to be read; where it is there, nothing is done.
    """
    path = Path(path)
    if not path.exists() and _beside(path, "previous").exists():
        with _alone(path):
            _put_back(path)


@contextmanager
def open_whole(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file that is there as a whole, for reading.

    Parameters
    ----------
    path : str or Path
        A file, or a link to one.

    Raises
    ------
    OSError
        If it is missing; if it cannot be read to its end, like a pipe without a writer;
        or if Git LFS has not fetched it.
    """
    flags = (getattr(os, name, 0) for name in ("O_NONBLOCK", "O_BINARY"))  # none has both
    descriptor = os.open(path, os.O_RDONLY | sum(flags))
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(f"{path} is not a regular file")
        if file.read(len(POINTER)) == POINTER:
            raise OSError(
                f"{path} is a Git LFS pointer in place of the file: run `git lfs pull` there"
            )
        file.seek(0)
        yield file


def consistent[T](path: str | Path, read: Callable[[], T]) -> T:
    """Read a folder that may be replaced meanwhile.

    Parameters
    ----------
    path : str or Path
        The folder; :func:`recover` is called for it.
    read : callable
        Reads some of its files. It is called again if another folder has taken the place in
        between, of which the second file may have come; its errors count where none has.
    """
    path = Path(path)
    while True:
        recover(path)
        before = _identity(path)
        try:
            result = read()
        except Exception:
            if _identity(path) == before:
                raise
            continue
        if _identity(path) == before:
            return result


def _identity(path: Path) -> tuple[int, ...] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    # the number of a folder that is gone is soon given to another: its times are not
    return found.st_dev, found.st_ino, found.st_mtime_ns, found.st_ctime_ns


def read_whole(path: str | Path) -> bytes:
    """Read the bytes of a file.

    Parameters
    ----------
    path : str or Path
        As for :func:`open_whole`, whose errors are raised.
    """
    with open_whole(path) as file:
        return file.read()


def _beside(path: Path, kind: str) -> Path:
    """Return the "new", the "previous" or the "lock" of ``path``."""
    return path.with_name(f".{path.name}.{kind}")


def _put_back(path: Path) -> None:
    """Let the previous folder go, or put it back where no new one took its place."""
    previous = _beside(path, "previous")
    if path.exists():
        shutil.rmtree(previous, ignore_errors=True)
    elif previous.exists():
        previous.rename(path)


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keep other writers of ``path`` waiting, by a lock that goes with the process."""
    try:
        import fcntl
    except ImportError:  # on Windows, where nothing can be renamed that is in use
        yield
        return
    lock = _beside(path, "lock")
    while True:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        with suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.fstat(descriptor).st_nlink:  # else the writer before has removed this file
            break
        os.close(descriptor)
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(descriptor)


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

"""Files as they come from failing disks, broken copies and hands: changed, cut, exchanged.

``TPGMM_FUZZ=full`` (``make fuzz``) asks for thousands of them in place of a few, from the seed
``TPGMM_FUZZ_FIRST`` on.
"""

import copy
import hashlib
import json
import os
import resource
import shutil
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from safetensors.torch import load, save

from tpgmm_torch import persistence
from tpgmm_torch.exceptions import ModelFileError

FULL = os.environ.get("TPGMM_FUZZ") == "full"
#: The first seed of a full run.
FIRST = int(os.environ.get("TPGMM_FUZZ_FIRST", "0"))
#: Files in one test, of which a full run has many.
BLOCK = 500
#: No file takes longer [s], and all together no more memory [bytes].
TIME, MEMORY = 10, 1e9

VALUES = [
    None, 0, -1, 3, 2.5, "x", "deg", True, [], {}, [["a"]], "video", "float64", 1e300, -1e300,
    float("nan"), float("inf"), 10**18, 10**400, "\0", "a" * 10_000, [0] * 1000, 1e-320,
    "data/{chunk_index}/{x}", "../{episode_index}", "{0.__class__}",
    "{chunk_index:099999999d}", [10**12], "cuda", "meta", "/dev/zero", "float16", "int8",
    {"type": "Stack", "operators": []},
]  # fmt: skip

Damage = Callable[[Path, np.random.Generator], str]


def blocks(small: int, full: int) -> list[range]:
    """Seeds of the damaged files, a range for each test."""
    if not FULL:
        return [range(small)]
    starts = range(FIRST, FIRST + full, BLOCK)
    return [range(start, min(start + BLOCK, FIRST + full)) for start in starts]


class Hang(BaseException):
    """Something took too long."""


@contextmanager
def bounded(what: str) -> Iterator[None]:
    """At most so much time and memory."""

    def stop(*_: object) -> None:
        raise Hang(what)

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    handler = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, TIME)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", UserWarning)
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    assert grown < MEMORY, f"{grown / 1e9:.1f} GB for {what}"


def files(root: Path, suffix: str = "") -> list[Path]:
    return sorted(path for path in root.rglob(f"*{suffix}") if path.is_file())


def one(items: list, rng: np.random.Generator):
    return items[int(rng.integers(len(items)))]


def flip_bytes(root: Path, rng: np.random.Generator) -> str:
    path = one(files(root), rng)
    content = bytearray(path.read_bytes())
    for _ in range(int(rng.integers(1, 4))):
        content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(content))
    return f"bytes flipped in {path.name}"


def truncate(root: Path, rng: np.random.Generator) -> str:
    path = one(files(root), rng)
    content = path.read_bytes()
    path.write_bytes(content[: int(rng.integers(len(content)))])
    return f"{path.name} truncated"


def lengthen(root: Path, rng: np.random.Generator) -> str:
    path = one(files(root), rng)
    content, at = path.read_bytes(), int(rng.integers(path.stat().st_size))
    more = one([b"\0" * 100, b"[" * 100_000, content, b"9" * 5000], rng)
    path.write_bytes(content[:at] + more + content[at:])
    return f"{len(more)} bytes put into {path.name}"


def remove_file(root: Path, rng: np.random.Generator) -> str:
    path = one(files(root), rng)
    path.unlink()
    return f"{path.name} removed"


def other_kind(root: Path, rng: np.random.Generator) -> str:
    """A pipe, a folder, a link to itself, or what Git LFS leaves, in place of a file."""
    path, kind = one(files(root), rng), one(["pipe", "folder", "loop", "pointer"], rng)
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    else:
        path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    return f"a {kind} in place of {path.name}"


def exchange_files(root: Path, rng: np.random.Generator) -> str:
    """One file has the content of another."""
    a, b = one(files(root), rng), one(files(root), rng)
    a.write_bytes(b.read_bytes())
    return f"{a.name} replaced by {b.name}"


def edit_json(root: Path, rng: np.random.Generator) -> str:
    """An entry is another value or gone, has another name or place, is shorter or longer."""
    path = one(files(root, ".json"), rng)
    content = [json.loads(path.read_text())]
    # settings, and by chance what is deep in them
    places = list(_entries(content))
    holder, key = one(places[: len(places) if rng.random() < 0.5 else 40], rng)
    kind = one(["value", "value", "gone", "name", "place", "text", "longer"], rng)
    other, there = one(places, rng)
    if kind == "name" and isinstance(holder, dict):
        holder[str(there)] = holder.pop(key)
    elif kind == "gone" and holder is not content:
        del holder[key]
    elif kind == "place" and isinstance(holder[key], str | int | float | None):
        holder[key] = copy.deepcopy(other[there])
    elif kind == "text":
        holder[key] = str(holder[key])
    elif kind == "longer" and isinstance(holder[key], list):
        holder[key] = holder[key][1:] if rng.random() < 0.5 else 2 * holder[key]
    else:
        holder[key] = one(VALUES, rng)
    path.write_text(json.dumps(content[0]))
    return f"{key} edited in {path.name}: {kind}"


def _entries(holder: list | dict) -> Iterator[tuple[list | dict, int | str]]:
    for key in list(holder) if isinstance(holder, dict) else range(len(holder)):
        yield holder, key
        if isinstance(holder[key], dict | list):
            yield from _entries(holder[key])


def change_tensor(root: Path, rng: np.random.Generator) -> str:
    """A tensor of a model is another one, of another shape or dtype, or holds no numbers."""
    path = one(files(root, ".safetensors"), rng)
    tensors = load(path.read_bytes())
    name, other = one(sorted(tensors), rng), one(sorted(tensors), rng)
    changed, numbers = tensors[name], tensors[name].flatten().clone()
    numbers[int(rng.integers(len(numbers)))] = one(
        [np.nan, np.inf, -1.0, 0.0, 1e30, 1e-30], rng
    )
    kinds = {
        "numbers": numbers.view(changed.shape),
        "dtype": changed.to(one([torch.float16, torch.float32, torch.int64, torch.bool], rng)),
        "shape": one([changed[None], changed[1:], changed[:0], changed.flatten()], rng),
        "huge": torch.zeros(100_000, dtype=changed.dtype),
        "place": tensors[other],
    }
    kind = one([*kinds, "numbers", "gone"], rng)
    tensors |= {name: kinds.get(kind, changed).clone()}
    if kind == "gone":
        del tensors[name]
    path.write_bytes(save({key: each.contiguous() for key, each in tensors.items()}))
    return f"tensor {name}: {kind}"


def signed_again(damage: Damage) -> Damage:
    """The damage as of somebody who knows the digests of models and policies."""

    def done(root: Path, rng: np.random.Generator) -> str:
        what = damage(root, rng)
        for file in root.rglob("config.json"):
            config = json.loads(file.read_text())
            if isinstance(config, dict) and "digest" in config:
                blob = (file.parent / persistence.TENSORS).read_bytes()
                config["tensors_sha256"] = hashlib.sha256(blob).hexdigest()
                config["digest"] = persistence._digest(config)
                file.write_text(json.dumps(config))
        with suppress(ModelFileError):  # of files that no digest is made of
            from lerobot_policy_tpgmm import policy_files  # `make oldest` is without LeRobot

            if (root / policy_files.DIGESTS).exists():
                digests = {n: policy_files._digest(root / n) for n in policy_files.COMPARED}
                (root / policy_files.DIGESTS).write_text(json.dumps(digests))
        return what

    return done


def change_text(root: Path, rng: np.random.Generator) -> str:
    """A cell of a table is another word, a line is doubled or gone, separators are others."""
    path = one(files(root, ".csv"), rng)
    lines = [line.split(",") for line in path.read_text().splitlines()]
    row = int(rng.integers(len(lines))) if rng.random() < 0.7 else 0
    column, kind = int(rng.integers(len(lines[0]))), one(["cell", "cell", "line", "again"], rng)
    if kind == "cell":
        lines[row][column] = str(one([*VALUES, '"', "1,5", "2024-01-01", "", *lines[0]], rng))
    elif kind == "line":
        del lines[row]
    else:
        lines.insert(row, lines[row])
    separator = one([",", ",", ",", ";", "\t", ", "], rng)
    path.write_text("\n".join(map(separator.join, lines)))
    return f"{kind} {column} of line {row}"


def flip_footer(root: Path, rng: np.random.Generator) -> str:
    path = one(files(root, ".parquet"), rng)
    content = bytearray(path.read_bytes())
    length = int.from_bytes(content[-8:-4], "little") + 8
    content[-int(rng.integers(1, length + 1))] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(content))
    return f"a bit flipped in the footer of {path.name}"


def change_table(root: Path, rng: np.random.Generator) -> str:
    """Columns and rows dropped, doubled, renamed, exchanged, or numbers set to extremes."""
    path = one(files(root, ".parquet"), rng)
    table = pq.read_table(path)
    name = one(table.column_names, rng)
    column, at = table[name], table.column_names.index(name)
    rows = list(range(len(table)))
    row = int(rng.integers(len(table)))
    kind = one(["drop", "double", "rename", "row", "again", "swap", "extreme", "type"], rng)
    if kind == "extreme" and not pa.types.is_primitive(column.type):
        kind = "type"
    if kind == "drop":
        table = table.drop_columns([name])
    elif kind == "double":
        table = table.append_column(name, column)
    elif kind == "rename":
        other = one(table.column_names, rng)
        table = table.rename_columns([other if n == name else n for n in table.column_names])
    elif kind == "row":
        table = table.take(pa.array(rows[:row] + rows[row + 1 :], pa.int64()))
    elif kind == "again":
        table = table.take(pa.array([*rows, row], pa.int64()))
    elif kind == "swap":
        other = int(rng.integers(len(table)))
        rows[row], rows[other] = rows[other], rows[row]
        table = table.take(pa.array(rows, pa.int64()))
    elif kind == "extreme":
        values, floating = column.to_pylist(), pa.types.is_floating(column.type)
        values[row] = one(
            [float("nan"), 1e38, -1e38] if floating else [2**63 - 1, -(2**63)], rng
        )
        if pa.types.is_boolean(column.type):
            values[row] = None
        table = table.set_column(at, name, pa.array(values, column.type))
    else:
        table = table.set_column(at, name, pa.array(["text"] * len(table)))
    pq.write_table(table, path)
    return f"{name} of {path.name}: {kind}"


FILES: tuple[Damage, ...] = (
    flip_bytes, truncate, lengthen, remove_file, other_kind, exchange_files,
)  # fmt: skip
WITH_JSON = (*FILES, edit_json, edit_json)
TABLES = (*WITH_JSON, flip_footer, change_table, change_table)
TEXTS = (*FILES, *[change_text] * 6)
SIGNED = tuple(map(signed_again, (edit_json, edit_json, change_tensor)))


@contextmanager
def damaged(
    original: Path, folder: Path, damages: tuple[Damage, ...], seed: int
) -> Iterator[tuple[Path, str]]:
    """A copy of a folder with one of the damages; and what was done to it."""
    copy = folder / str(seed)
    shutil.copytree(original, copy)
    rng = np.random.default_rng(seed)
    what = f"{damages[seed % len(damages)](copy, rng)} (seed {seed})"
    try:
        yield copy, what
    finally:
        shutil.rmtree(copy)

"""Damaged copies of a data set give the right data or a specific error, nothing else.

``TPGMM_MUTATIONS=2000`` in the environment raises the number of copies.
"""

import json
import os
import shutil
import warnings

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from tpgmm_datasets import DatasetError, load_lerobot, save_lerobot
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame

COPIES = int(os.environ.get("TPGMM_MUTATIONS", "300"))


def demonstrations():
    rng = np.random.default_rng(7)
    made = []
    for length in (12, 9, 15):
        quaternion = rng.normal(size=(length, 4))
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        frames = {
            "bottle": Frame(rng.normal(size=3), quaternion[0]),
            "hand": Frame(rng.normal(size=(length, 3)), quaternion),
        }
        joints = rng.normal(size=(length, 3))
        events = {"close": 5 / 50}
        made.append(Demonstration(np.arange(length) / 50, joints, frames, list("abc"), events))
    return made


def same(first, second):
    return len(first) == len(second) and all(map(same_demonstration, first, second))


def same_demonstration(a, b):
    return (
        a.joint_names == b.joint_names
        and dict(a.events) == dict(b.events)
        and torch.equal(a.time, b.time)
        and torch.equal(a.joints, b.joints)
        and list(a.frames) == list(b.frames)
        and all(
            torch.equal(a.frames[name].position, b.frames[name].position)
            and torch.equal(a.frames[name].orientation, b.frames[name].orientation)
            for name in a.frames
        )
    )


def files(root):
    return sorted(path for path in root.rglob("*") if path.is_file())


def flip_bytes(root, rng):
    path = files(root)[rng.integers(len(files(root)))]
    content = bytearray(path.read_bytes())
    for _ in range(int(rng.integers(1, 4))):
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(content))
    return f"bytes flipped in {path.name}"


def flip_footer(root, rng):
    path = parquet_file(root, rng)
    content = bytearray(path.read_bytes())
    length = int.from_bytes(content[-8:-4], "little") + 8
    content[-int(rng.integers(1, length + 1))] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(content))
    return f"a bit flipped in the footer of {path.name}"


def truncate(root, rng):
    path = files(root)[rng.integers(len(files(root)))]
    content = path.read_bytes()
    path.write_bytes(content[: rng.integers(len(content))])
    return f"{path.name} truncated"


def remove_file(root, rng):
    path = files(root)[rng.integers(len(files(root)))]
    path.unlink()
    return f"{path.name} removed"


def parquet_file(root, rng):
    found = [path for path in files(root) if path.suffix == ".parquet"]
    return found[rng.integers(len(found))]


def drop_column(root, rng):
    path = parquet_file(root, rng)
    table = pq.read_table(path)
    name = table.column_names[rng.integers(table.num_columns)]
    pq.write_table(table.drop_columns([name]), path)
    return f"{name} dropped from {path.name}"


def drop_rows(root, rng):
    path = parquet_file(root, rng)
    table = pq.read_table(path)
    row = int(rng.integers(len(table)))
    keep = [i for i in range(len(table)) if i != row]
    pq.write_table(table.take(pa.array(keep, pa.int64())), path)
    return f"row {row} dropped from {path.name}"


def swap_rows(root, rng):
    path = parquet_file(root, rng)
    table = pq.read_table(path)
    order = np.arange(len(table))
    a, b = rng.integers(len(table), size=2)
    order[[a, b]] = order[[b, a]]
    pq.write_table(table.take(order), path)
    return f"rows {a} and {b} swapped in {path.name}"


def edit_json(root, rng):
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    holder, key = info, list(info)[rng.integers(len(info))]
    while isinstance(holder[key], (dict, list)) and holder[key] and rng.random() < 0.9:
        holder = holder[key]
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        key = keys[rng.integers(len(keys))]
    values = [None, 0, -1, 3, 2.5, "x", "deg", True, [], {}, [["a"]], "video", "float64", 1e300]
    values += [float("nan"), "data/{chunk_index}/{x}", "../{episode_index}", "{0.__class__}"]
    if rng.random() < 0.2:
        del holder[key]
    else:
        holder[key] = values[rng.integers(len(values))]
    path.write_text(json.dumps(info))
    return f"{key} edited in info.json"


MUTATIONS = [
    flip_bytes,
    flip_footer,
    truncate,
    remove_file,
    drop_column,
    drop_rows,
    swap_rows,
    edit_json,
]


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    root = tmp_path_factory.mktemp("original") / "set"
    half = demonstrations()
    save_lerobot(half[:2], root, fps=50, task="reach", robot_type="arm")
    return save_lerobot(half[2:], root, fps=50, task="shake", append=True)


@pytest.mark.parametrize("mutate", MUTATIONS, ids=lambda mutate: mutate.__name__)
def test_damage_gives_the_right_data_or_a_specific_error(mutate, original, tmp_path):
    expected = load_lerobot(original)
    refused = 0
    for seed in range(COPIES // len(MUTATIONS)):
        copy = tmp_path / str(seed)
        shutil.copytree(original, copy)
        what = mutate(copy, np.random.default_rng(seed))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                found = load_lerobot(copy)
        except DatasetError as error:
            refused += 1
            assert str(error)
        else:
            assert same(found, expected), f"wrong data after: {what} (seed {seed})"
        shutil.rmtree(copy)
    assert refused > 0

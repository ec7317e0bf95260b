"""Small data sets for the tests of the reader, and ways to change them."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from tpgmm_datasets import DatasetError, load_lerobot, save_lerobot
from tpgmm_torch import quaternions
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame

FPS = 50
NAMES = ("left_elbow", "right_elbow", "gripper")
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def demonstration(seed, length):
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-1, 1)
    orientation = [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
    return Demonstration(
        np.arange(length) / FPS,
        np.cumsum(rng.normal(size=(length, 3)), axis=0) * 0.1,
        {"bottle": Frame(rng.normal(size=3), orientation)},
        NAMES,
        {"close": 5 / FPS},
    )


def write(root, lengths=(12, 9, 15), tasks=("reach", "shake", "reach")):
    written = [demonstration(seed, length) for seed, length in enumerate(lengths)]
    save_lerobot(written, root, fps=FPS, task=list(tasks), dtype="float64", robot_type="arm")
    return written


def change_info(root, change):
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def change_table(root, file, change):
    """Rewrite a parquet file; what this project's writer left in its footer is dropped."""
    table = change(pq.read_table(root / file)).replace_schema_metadata(None)
    pq.write_table(table, root / file)


def set_column(table, name, values):
    """``values`` is an array, or a function of the present one."""
    column = table[name].combine_chunks()
    if callable(values):
        flat = column.flatten() if pa.types.is_fixed_size_list(column.type) else column
        present = flat.to_numpy(zero_copy_only=False).copy().reshape(len(table), -1)
        flat = pa.array(np.asarray(values(present)).reshape(-1), flat.type)
        width = present.shape[1]
        values = flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
    return table.set_column(table.column_names.index(name), name, values)


def add_feature(root, name, values, names=None):
    """A float64 feature of shape (rows, width), declared and stored."""
    width = values.shape[1]
    flat = pa.array(values.reshape(-1), pa.float64())
    column = flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
    change_table(root, DATA, lambda table: table.append_column(name, column))
    entry = {"dtype": "float64", "shape": [width], "names": names}
    change_info(root, lambda info: info["features"].__setitem__(name, entry))


def to_v21(root, target):
    """The same set in layout v2.1: one file per episode, JSON lines, nested names."""
    info = json.loads((root / "meta" / "info.json").read_text())
    info["codebase_version"] = "v2.1"
    info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info["features"]["observation.state"]["names"] = [list(NAMES)]
    info["features"]["camera"] = {"dtype": "video", "shape": [4, 4, 3], "names": None}
    info["chunks_size"] = 2
    (target / "meta").mkdir(parents=True)
    (target / "meta" / "info.json").write_text(json.dumps(info))
    table = pq.read_table(root / DATA).replace_schema_metadata(None)
    lines = []
    for row in pq.read_table(root / EPISODES).to_pylist():
        index, start = row["episode_index"], row["dataset_from_index"]
        file = target / info["data_path"].format(episode_chunk=index // 2, episode_index=index)
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table.slice(start, row["length"]), file)
        lines.append({key: row[key] for key in ("episode_index", "tasks", "length")})
    tasks = [{"task_index": i, "task": task} for i, task in enumerate(("reach", "shake"))]
    for name, content in (("episodes", lines), ("tasks", tasks)):
        text = "\n".join(map(json.dumps, content))
        (target / "meta" / f"{name}.jsonl").write_text(text + "\n")
    return target


class Arm:
    """A robot as the reader sees one: its link is at (first joint, second joint, 0)."""

    def __init__(self, *joint_names):
        self.joint_names = joint_names

    def state(self, joints):
        position = torch.cat((joints[..., :2], torch.zeros_like(joints[..., :1])), dim=-1)
        orientation = quaternions.exp(torch.tensor([0.0, 0.0, 0.5], dtype=joints.dtype))
        return SimpleNamespace(
            position=lambda link: position, orientation=lambda link: orientation
        )


def joints_of(demonstrations):
    return [demonstration.joints for demonstration in demonstrations]


def assert_equal(found, expected):
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


def spoil(row, place, value):
    def change(values):
        values[row, place] = value
        return values

    return change


def in_data(name, change):
    return lambda root: change_table(root, DATA, lambda t: set_column(t, name, change))


def in_info(**changes):
    return lambda root: change_info(root, lambda info: info.update(changes))


def later(values):
    values[15:21] += 0.1
    return values


def stuck(values):
    values[15] = values[14]
    return values


def undeclared(root, factor):
    """The joints multiplied, measured and commanded, and no units in the metadata."""
    for feature in ("observation.state", "action"):
        change_table(root, DATA, lambda t, f=feature: set_column(t, f, lambda x: x * factor))
        change_info(root, lambda i, f=feature: i["features"][f].pop("info"))


def assert_refused(root, check, file=None, episode=None, column=None):
    """The set cannot be read, and the error says what failed and where."""
    with pytest.raises(DatasetError) as caught:
        load_lerobot(root)
    error = caught.value
    where = file, episode, column
    assert (error.check, error.file, error.episode, error.column) == (check, *where)
    for part in filter(None, where):
        assert str(part) in str(error)

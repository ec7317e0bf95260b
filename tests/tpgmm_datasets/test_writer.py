"""Data sets written: the identity with reading, growing, and what is refused."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.lerobot_sets import to_v21
from tests.support.written_sets import FPS, assert_same, demonstration, unit
from tpgmm_datasets import DatasetError, load_lerobot, save_lerobot
from tpgmm_datasets.writer import add_frames
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame


def read_info(root):
    return json.loads((root / "meta" / "info.json").read_text())


NAMES = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), min_size=1, max_size=9)


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
@settings(deadline=None, max_examples=25)
@given(
    lengths=st.lists(st.integers(1, 40), min_size=1, max_size=5),
    names=st.one_of(st.none(), st.lists(NAMES, min_size=3, max_size=3, unique=True)),
    frames=st.lists(NAMES, max_size=3, unique=True),
    fps=st.integers(1, 500),
    start=st.sampled_from([0.0, 3.5]),
)
def test_identity_over_lengths_names_and_rates(
    tmp_path_factory, lengths, names, frames, fps, start
):
    rng = np.random.default_rng(sum(lengths))
    written = []
    for length in lengths:
        time, joints = start + np.arange(length) / fps, rng.normal(size=(length, 3))
        poses = {name: Frame(rng.normal(size=3), unit(rng)) for name in frames}
        written.append(Demonstration(time, joints, poses, names))
    root = tmp_path_factory.mktemp("sets") / "set"
    save_lerobot(written, root, fps=fps, task="x", dtype="float64")
    for found, expected in zip(load_lerobot(root), written, strict=True):
        assert_same(found, expected, 1e-12)


def test_actions_are_the_references_that_were_given(tmp_path):
    first = demonstration(0)
    second = demonstration(1).reorder(["joint_2", "joint_0", "joint_1"])
    options = {"fps": FPS, "task": "reach"}
    options["actions"] = [motion.joints + 0.05 for motion in (first, second)]
    root = save_lerobot([first, second], tmp_path / "set", **options)
    for key, shift in (("observation.state", 0.0), ("action", 0.05)):
        found = load_lerobot(root, joints=key)
        for read, written in zip(found, (first, second), strict=True):
            expected = written.reorder(read.joint_names).joints + shift
            torch.testing.assert_close(read.joints, expected, rtol=0, atol=1e-6)


def test_actions_that_do_not_fit_are_refused(tmp_path):
    motion = demonstration()
    unnamed, few = Demonstration(motion.time, motion.joints), motion.joints[:, :2]
    for shown, actions, error, message in (
        (motion, [], ValueError, "actions of 0 and joints of 1"),
        (motion, [few], ValueError, "joint_names needs 2"),
        (motion, [motion.joints[:5]], ValueError, "T = 20"),
        (motion, [motion.joints * np.nan], ValueError, "NaN"),
        (unnamed, [few], DatasetError, "3 joints and actions of 2"),
    ):
        with pytest.raises(error, match=message):
            save_lerobot([shown], tmp_path / "set", fps=FPS, task="reach", actions=actions)
    assert not (tmp_path / "set").exists()


def test_append_adds_episodes_tasks_and_statistics(tmp_path):
    written = [demonstration(seed, length=10 + seed) for seed in range(5)]
    once = save_lerobot(written, tmp_path / "once", fps=FPS, task=["a", "a", "b", "b", "a"])
    root = tmp_path / "twice"
    save_lerobot(written[:2], root, fps=FPS, task="a", append=True)
    save_lerobot(written[2:], root, fps=FPS, task=["b", "b", "a"], append=True)
    for found, expected in zip(load_lerobot(root), written, strict=True):
        assert_same(found, expected, 1e-6)
    assert len(list(root.glob("data/*/*.parquet"))) == 2  # each call's in a file of its own
    assert len(load_lerobot(root, episodes="b")) == 2
    assert read_info(root) == read_info(once)
    both = [json.loads((r / "meta" / "stats.json").read_text()) for r in (root, once)]
    for key, column in both[1].items():
        for name, values in column.items():
            assert both[0][key][name] == pytest.approx(values), (key, name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fps": 25}, "not sampled at 25 Hz"),
        ({"fps": 12.5}, "whole number"),
        ({"task": ["a", "b"]}, "one per demonstration"),
        ({"task": ""}, "not empty"),
        ({"dtype": "float16"}, "dtype"),
    ],
)
def test_wrong_arguments_are_refused_and_leave_nothing(tmp_path, change, message):
    arguments = {"fps": FPS, "task": "reach", **change}
    with pytest.raises(DatasetError, match=message):
        save_lerobot([demonstration()], tmp_path / "set", **arguments)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(DatasetError, match="append=True"):  # the folder exists
        save_lerobot([demonstration()], tmp_path, fps=FPS, task="reach")


@pytest.mark.parametrize(
    ("other", "arguments", "message"),
    [
        (demonstration(n_joints=4), {}, "shape"),
        (demonstration(), {"dtype": "float64"}, "dtype"),
        (demonstration(), {"robot_type": "other"}, "robot_type"),
        (Demonstration(np.arange(9) / FPS, np.zeros((9, 3)), {}, list("abc")), {}, "features"),
    ],
)
def test_append_refuses_what_does_not_fit(tmp_path, other, arguments, message):
    root = save_lerobot([demonstration()], tmp_path / "set", fps=FPS, task="reach")
    before = {p: p.read_bytes() for p in root.rglob("*") if p.is_file()}
    with pytest.raises(DatasetError, match=message):
        save_lerobot([other], root, fps=FPS, task="reach", append=True, **arguments)
    assert {p: p.read_bytes() for p in root.rglob("*") if p.is_file()} == before


STAGES = ("summed.episode_statistics", "write_tables", "kept.feature_table")


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("append", [False, True])
def test_an_interrupted_write_leaves_the_old_set_or_none(tmp_path, monkeypatch, stage, append):
    root = tmp_path / "set"
    old = [demonstration(0)]
    if append:
        save_lerobot(old, root, fps=FPS, task="reach")

    monkeypatch.setattr(f"tpgmm_datasets.writer.{stage}", interrupt)
    with pytest.raises(KeyboardInterrupt):
        save_lerobot([demonstration(1)], root, fps=FPS, task="reach", append=append)
    assert [path.name for path in tmp_path.iterdir()] == (["set"] if append else [])
    if append:
        assert_same(load_lerobot(root)[0], old[0], 1e-6)


@pytest.mark.slow
def test_lerobot_opens_what_is_written_and_the_other_way_round(tmp_path):
    offline = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hub")}
    alone = {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    script = Path(__file__).parents[1] / "support" / "opened_by_lerobot.py"
    command, environment = [sys.executable, str(script), tmp_path], os.environ | offline | alone
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr[-3000:]
    assert "all equal" in result.stdout


def save_in_two_files(written, root):
    """Save a set in two files, with a video beside them."""
    for few in (written[:3], written[3:]):
        save_lerobot(few, root, fps=FPS, task="reach", append=True)
    (root / "videos").mkdir()
    (root / "videos" / "file.mp4").write_text("pictures")
    return root


@pytest.mark.parametrize("kept", [(), ("bottle",), ("bottle", "hand")])
def test_a_set_with_frames_added_is_the_one_that_had_them(tmp_path, kept):
    whole = [demonstration(seed, length=10 + seed) for seed in range(5)]
    few = [replace(one, frames={name: one.frames[name] for name in kept}) for one in whole]
    added = {n: [one.frames[n] for one in whole] for n in ("bottle", "hand") if n not in kept}
    had = save_in_two_files(whole, tmp_path / "had")
    root = save_in_two_files(few, tmp_path / "set")
    before = {file: file.read_bytes() for file in root.rglob("*") if file.is_file()}
    if not added:
        with pytest.raises(DatasetError, match=r"frames \['hand'\] some are in the set"):
            add_frames(root, tmp_path / "copy", {"hand": [Frame([0, 0, 0])] * 5})
        return
    copy = add_frames(root, tmp_path / "copies" / "set", added)
    for found, expected in zip(load_lerobot(copy), load_lerobot(had), strict=True):
        assert_same(found, expected, 0.0)
    assert read_info(copy) == read_info(had)
    for file in (path.relative_to(had) for path in had.rglob("*") if path.is_file()):
        if file.suffix == ".parquet":
            one, other = (pd.read_parquet(folder / file) for folder in (copy, had))
            pd.testing.assert_frame_equal(one[other.columns], other)
        elif file.name == "stats.json":
            stats = [json.loads((folder / file).read_text()) for folder in (copy, had)]
            assert stats[0] == stats[1]
    assert (copy / "videos" / "file.mp4").samefile(root / "videos" / "file.mp4")
    assert not (copy / "meta" / "tasks.parquet").samefile(root / "meta" / "tasks.parquet")
    save_lerobot(whole[:1], copy, fps=FPS, task="reach", append=True)  # it is a set like others
    assert {file: file.read_bytes() for file in root.rglob("*") if file.is_file()} == before


def test_frames_that_cannot_be_added_leave_no_copy(root, tmp_path, monkeypatch):
    given = {"cup": [Frame([0.3, 0, 0])] * 3}
    for frames, message in (
        ({"cup": "hand@close"}, r"table .* or frames by episode .*'hand@close'.*LINK@EVENT"),
        ({"bottle": given["cup"]}, r"frames \['bottle'\] some are in the set"),
        ({}, "by episode can be added, got {}"),
        ({"cup": given["cup"][:2]}, "list of 2 Frame"),
        ({"cup": [Frame(np.zeros((12, 3)))] * 3}, "episode 1: frame 'cup' has 12 poses"),
    ):
        with pytest.raises(DatasetError, match=message):
            add_frames(root, tmp_path / "copy", frames)
    with pytest.raises(DatasetError, match=r"sets of v3\.0, this is v2\.1 .*dataset convert"):
        add_frames(to_v21(root, tmp_path / "old"), tmp_path / "copy", given)
    for stage in STAGES[:2]:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(f"tpgmm_datasets.writer.{stage}", interrupt)
            add_frames(root, tmp_path / "copy", given)
    with pytest.raises(TypeError):  # the last that is written
        add_frames(root, tmp_path / "copy", given, files={"meta/cell.json": None})
    assert not (tmp_path / "copy").exists()
    (root / "meta" / "stats.json").write_text("[")
    with pytest.raises(DatasetError, match=r"meta/stats\.json: no statistics"):
        add_frames(root, tmp_path / "copy", given)
    with pytest.raises(DatasetError, match="old exists; remove it"):
        add_frames(root, tmp_path / "old", given)


def interrupt(*_):
    raise KeyboardInterrupt

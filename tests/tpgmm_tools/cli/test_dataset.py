"""``tpgmm dataset``: data sets looked at, generated and converted."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from tests.support import written_sets
from tests.support.command_line import output, refusal, run
from tests.support.lerobot_sets import (
    DATA,
    FPS,
    assert_equal,
    change_info,
    change_table,
    in_data,
    joints_of,
    set_column,
    to_v21,
    undeclared,
    write,
)
from tpgmm_datasets import describe_lerobot, load_lerobot, resample, save_lerobot
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_datasets.errors import DatasetError, DatasetWarning
from tpgmm_torch import Demonstration

RATE = 10


def generate(path, *more, number=2, seed=0, rate=RATE):
    size = ("--n-demonstrations", number, "--random-state", seed, "--rate", rate)
    return "dataset", "generate", path, *size, *more


@pytest.fixture(scope="module")
def shaking(tmp_path_factory):
    folder = tmp_path_factory.mktemp("generated") / "set"
    output(*generate(folder))
    return folder


@pytest.fixture
def arm(tmp_path):
    """Write a small set of three episodes in layout v3.0, and what is in it."""
    return tmp_path / "arm", write(tmp_path / "arm")


def assert_same(found, expected, tolerance=0.0):
    """Everything: joints and poses to a tolerance, events to the step."""
    for a, b in zip(found, expected, strict=True):
        step = float(a.time[1] - a.time[0])
        assert a.events == pytest.approx(b.events, abs=0.501 * step)
        written_sets.assert_same(replace(a, events={}), replace(b, events={}), tolerance)


def test_generated_demonstrations_are_those_of_the_skill_with_that_seed(tmp_path):
    text = output(*generate(tmp_path / "new" / "set", number=2, seed=3))
    expected = BottleShaking(rate=RATE).demonstrations(2, seed=3)
    assert_same(load_lerobot(tmp_path / "new" / "set"), expected, 1e-6)
    rows = sum(map(len, expected))
    assert text == f"2 episodes, {rows} rows written to {tmp_path / 'new' / 'set'}\n"
    found = describe_lerobot(tmp_path / "new" / "set")
    assert (found.fps, found.robot_type) == (RATE, "upper_body")
    assert found.tasks == ("shake the bottle",)
    assert found.problems == ()


@pytest.mark.parametrize("command", ["generate", "convert"])
def test_a_set_that_exists_is_left_alone_without_append(command, shaking, arm, tmp_path):
    root, written = arm
    words = generate(root) if command == "generate" else ("dataset", "convert", shaking, root)
    assert f"{root} exists; remove it, or" in refusal(*words)
    assert_same(load_lerobot(root), written)


def test_layout_v21_becomes_v30_and_each_episode_keeps_its_task(arm, tmp_path):
    root, written = arm
    output("dataset", "convert", to_v21(root, tmp_path / "old"), tmp_path / "new")
    found = describe_lerobot(tmp_path / "new")
    assert (found.version, found.robot_type, found.cameras) == ("v3.0", "arm", ())
    assert (found.fps, found.problems) == (FPS, ())
    assert_same(load_lerobot(tmp_path / "new"), written, 1e-6)
    joints = joints_of(load_lerobot(tmp_path / "new", episodes="shake"))
    assert_equal(joints, joints_of(load_lerobot(tmp_path / "new"))[1:2])


@pytest.mark.parametrize("rate", [FPS, FPS // 2])
def test_joints_are_stored_in_radians_at_the_rate_that_is_asked_for(tmp_path, rate):
    root = tmp_path / "set"
    written = write(root)
    in_data("observation.state", np.degrees)(root)
    change_info(root, lambda i: i["features"]["observation.state"].pop("info"))
    output("dataset", "convert", root, tmp_path / "new", *("--units", "deg", "--rate", rate))
    for item, demonstration in zip(load_lerobot(tmp_path / "new"), written, strict=True):
        expected = resample(demonstration, rate).joints
        assert item.joints.numpy() == pytest.approx(expected.numpy(), abs=1e-5)


def test_measured_poses_are_added_to_a_copy(arm, tmp_path):
    (tmp_path / "poses.csv").write_text("episode,x,y,z\n0,.3,0,0\n1,.4,0,0\n2,.5,0,0")
    frame = ("--frame", f"cup={tmp_path / 'poses.csv'}")
    text = output("dataset", "add-frames", arm[0], *frame, "--out", tmp_path / "new")
    assert text == f"cup added to the copy {tmp_path / 'new'}\n"
    for n, found in enumerate(load_lerobot(tmp_path / "new")):
        assert list(found.frames) == ["bottle", "cup"]
        assert found.frames["cup"].position[0] == pytest.approx(0.3 + 0.1 * n)
    said = refusal("dataset", "add-frames", arm[0], *frame, "--out", tmp_path / "new")
    assert "exists; remove it" in said


@pytest.mark.parametrize("tasks", [[], ["reach", "shake"]])
def test_an_episode_that_has_not_one_task_of_its_own_needs_to_be_told(arm, tmp_path, tasks):
    root = to_v21(arm[0], tmp_path / "old")
    file = root / "meta" / "episodes.jsonl"
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    rows[1]["tasks"] = tasks
    file.write_text("\n".join(map(json.dumps, rows)))
    words = ("dataset", "convert", root, tmp_path / "new")
    assert f"episode 1 has {len(tasks)} tasks, not one: give --task" in refusal(*words)
    output(*words, "--task", "wave")
    assert len(load_lerobot(tmp_path / "new", episodes="wave")) == 3


def test_joints_of_a_robot_are_chosen_in_its_order(shaking, tmp_path):
    robot = ("--robot", "upper_body", "--robot-joint", "r_*", "--link", "r_hand")
    at = ("--frame", "held=r_hand@grasp")
    output("dataset", "convert", shaking, tmp_path / "new", *robot, *at)
    read, wanted = load_lerobot(tmp_path / "new"), load_lerobot(shaking)
    for found, before in zip(read, wanted, strict=True):
        names = [name for name in before.joint_names if name.startswith("r_")]
        assert list(found.joint_names) == names
        assert_equal([found.joints], [before.reorder(names).joints])
        assert list(found.frames) == ["held"]


PNG = b"\x89PNG"


def test_info_and_plot_show_what_is_in_it(shaking, tmp_path):
    text = output("dataset", "info", shaking)
    for expected in ("v3.0", "10 rows per second", "bottle.qw", "l_shoulder_pitch", "rad"):
        assert expected in text
    output("dataset", "plot", shaking, "--out", tmp_path / "d.png")
    assert (tmp_path / "d.png").read_bytes().startswith(PNG)


def test_check_lists_all_problems_and_fails(tmp_path):
    assert "no problems in 2 episodes" in output("dataset", "check", bad_set(tmp_path / "a", 0))
    result = run("dataset", "check", bad_set(tmp_path / "b", 2))
    assert result.exit_code == 1
    [line] = result.stdout.splitlines()
    assert "episode 0" in line and "observation.state" in line
    assert line.endswith("(and 1 more like it: episode 1)")
    assert "problem: " in output("dataset", "info", tmp_path / "b")


def test_check_tells_what_is_implausible_and_fails_where_it_must(tmp_path, shaking):
    robot = ("--robot", "upper_body", "--link", "l_hand")
    text = output("dataset", "check", shaking, *robot, "--strict")
    assert text.splitlines() == ["no problems in 2 episodes, 261 rows"]
    time = np.arange(10) / 10
    shown = [Demonstration(time, np.sin(time + n)[:, None]) for n in range(3)]
    root = save_lerobot([*shown, shown[0]], tmp_path / "copies", fps=10, task="t")
    assert "unlikely: copies: " in output("dataset", "check", root)
    assert run("dataset", "check", root, "--strict").exit_code == 1
    write(tmp_path / "degrees")
    undeclared(tmp_path / "degrees", 600.0)
    text = output("dataset", "check", tmp_path / "degrees")
    assert "cannot say whether it is plausible: " in text and "not radians" in text
    result = run("dataset", "check", tmp_path / "degrees", "--units", "rad", *robot)
    assert result.exit_code == 2 and "is not among the values" in result.stderr


def test_one_bad_episode_of_several_is_told_and_may_be_left_out(tmp_path, shaking):
    root = tmp_path / "one"
    shutil.copytree(shaking, root)

    def stretch(poses):
        return np.concatenate((poses[:1] * np.repeat([1.0, 1.3], [3, 4]), poses[1:]))

    change_table(root, DATA, lambda t: set_column(t, "observation.environment_state", stretch))
    result = run("dataset", "check", root)
    assert result.exit_code == 1 and "error: left out or not checked: " in result.stdout
    assert "episode 0" in result.stdout
    with pytest.raises(DatasetError, match="norm of a quaternion"):
        load_lerobot(root)
    with pytest.warns(DatasetWarning, match="norm of a quaternion"):
        [second] = load_lerobot(root, relax=["poses"])
    assert_same([second], load_lerobot(shaking)[1:])


def bad_set(folder, wrong):
    """Two episodes, in as many of which as ``wrong`` says there is a NaN."""
    time = np.arange(10) / 10
    joints = np.sin(time)[:, None] * np.ones(2)
    save_lerobot([Demonstration(time, joints)] * 2, folder, fps=10, task="t")
    [file] = folder.glob("data/*/*.parquet")
    table = pd.read_parquet(file)
    for episode in range(wrong):
        state = table["observation.state"][10 * episode + 3].copy()
        state[0] = np.nan
        table.at[10 * episode + 3, "observation.state"] = state
    table.to_parquet(file)
    return folder

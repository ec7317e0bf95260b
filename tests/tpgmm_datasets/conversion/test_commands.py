"""Commands beside measured joints: what is read of actions, and what is left out."""

import json
import math

import numpy as np
import pytest
import torch

from tests.support.lerobot_sets import DATA, Arm, change_info, change_table
from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_datasets.conversion.commands import classify_commands
from tpgmm_torch import Demonstration
from tpgmm_torch.exceptions import PlausibilityWarning
from tpgmm_torch.motion.command_gaps import CommandGaps, episode_gaps

FPS, NAMES = 50, ("lift", "wrist", "gripper")
SAG = torch.tensor([0.05, 0.0, 0.0], dtype=torch.float64)


def shown(shift=0.0):
    """Three joints that move smoothly, the first of which sags."""
    time = torch.arange(150, dtype=torch.float64) / FPS
    joints = torch.stack([(1 + shift) * torch.sin(a * time + shift) for a in (1, 1.4, 0.8)], 1)
    return Demonstration(time, joints, {}, NAMES, commands=joints + SAG)


def write(path, change=None, **options):
    """Two episodes, whose actions are ``change(joints)`` or the commands."""
    episodes = [shown(), shown(0.2)]
    actions = change and [change(one.joints) for one in episodes]
    options = {"fps": FPS, "task": "wave", "dtype": "float64", "actions": actions} | options
    return save_lerobot(episodes, path, **options)


def declare(root, feature, **entry):
    """Change what the metadata say, and forget what the writer left in the file."""
    change_info(root, lambda info: info["features"][feature].update(entry))
    change_table(root, DATA, lambda table: table)


def assert_commands(found, expected):
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.commands, other, rtol=0, atol=1e-9)


def test_commands_come_back_as_they_were_saved(tmp_path):
    root, written = write(tmp_path / "set"), [shown(), shown(0.2)]
    found = load_lerobot(root)
    assert_commands(found, [one.commands for one in written])
    torch.testing.assert_close(found[0].joints, written[0].joints, rtol=0, atol=1e-9)
    gaps = CommandGaps.learn([episode_gaps(one) for one in found], found[0].time)
    assert float(gaps.gap[:, 0].median()) == pytest.approx(0.05, abs=0.01)
    again = load_lerobot(save_lerobot(found, tmp_path / "again", fps=FPS, task="wave"))
    torch.testing.assert_close(again[0].commands, found[0].commands, rtol=0, atol=1e-6)


def test_commands_are_reordered_resampled_and_trimmed_with_the_joints(tmp_path):
    root, first = write(tmp_path / "set"), shown()
    robot = Arm("gripper", "lift")
    for one, written in zip(load_lerobot(root, robot=robot), (first, shown(0.2)), strict=True):
        assert_commands([one], [written.commands[:, [2, 0]]])
    [half, _] = load_lerobot(root, rate=FPS / 2)
    assert_commands([half], [first.commands[::2]])
    resting = Demonstration(
        first.time,
        torch.cat((first.joints[:1].expand(50, 3), first.joints[:100])),
        {},
        NAMES,
    )
    sent = [resting.joints + SAG]
    path = save_lerobot(
        [resting], tmp_path / "rests", fps=FPS, task="t", dtype="float64", actions=sent
    )
    [cut] = load_lerobot(path, trim=0.01)
    assert 95 < len(cut) < 105
    torch.testing.assert_close(cut.commands - cut.joints, SAG.expand(len(cut), 3))


def test_units_and_offsets_are_those_of_the_joints_or_the_actions_own(tmp_path):
    root = write(tmp_path / "set")
    expected = [one.commands for one in (shown(), shown(0.2))]
    assert_commands(load_lerobot(root, units="rad"), expected)

    offset = {"units": ["rad"] * 3, "offsets": [0.1, 0, 0]}
    for name in ("observation.state", "action"):
        declare(root, name, info=offset)
    moved = torch.tensor([0.1, 0, 0], dtype=torch.float64)
    assert_commands(load_lerobot(root), [one + moved for one in expected])
    degrees = write(tmp_path / "degrees", lambda joints: torch.rad2deg(joints + SAG))
    declare(degrees, "action", info={"units": ["deg"] * 3})
    assert_commands(load_lerobot(degrees), expected)


def test_a_calibration_is_for_both(tmp_path):
    ticks = {"range_min": 1024, "range_max": 3072, "homing_offset": 0, "drive_mode": 0}
    motors = {name: {"id": i, **ticks} for i, name in enumerate(NAMES, 1)}
    episodes = [
        Demonstration(one.time, 40 * one.joints, {}, NAMES, commands=40 * one.commands)
        for one in (shown(), shown(0.2))
    ]
    root = save_lerobot(episodes, tmp_path / "set", fps=FPS, task="wave", dtype="float64")
    for name in ("observation.state", "action"):
        declare(root, name, info=None)
    (file := tmp_path / "arm.json").write_text(json.dumps(motors))
    found = load_lerobot(root, calibration=file)
    half = math.tau / 8  # of a motor's range are values of 100
    for one, written in zip(found, episodes, strict=True):
        expected = (written.commands - written.joints)[:, 0] / 100 * half * 2
        torch.testing.assert_close((one.commands - one.joints)[:, 0], expected)


def test_commands_are_found_by_name_and_other_joints_stay_as_measured(tmp_path):
    turned, written = (
        write(tmp_path / "set", lambda q: (q + SAG).flip(1)),
        (shown(), shown(0.2)),
    )
    declare(turned, "action", names=[*NAMES[::-1]])
    assert_commands(load_lerobot(turned), [one.commands for one in written])
    some = write(tmp_path / "some", lambda joints: joints + 0.05)
    declare(some, "action", names=["lift", "a", "b"])
    assert_commands(load_lerobot(some), [one.commands for one in written])
    declare(some, "action", names=["x", "y", "z"])
    with pytest.warns(PlausibilityWarning, match="no postures of the measured joints"):
        assert load_lerobot(some)[0].commands is None


def differences(joints):
    return torch.diff(joints, dim=0, append=joints[-1:])


KINDS = {
    "differences from step to step": differences,
    "velocities": lambda joints: FPS * differences(joints),
    "normalised": lambda joints: joints / math.pi,
    "no postures": lambda joints: torch.sin(17 * torch.arange(len(joints) * 3.0)).reshape(
        -1, 3
    ),
}


@pytest.mark.parametrize(("kind", "change"), KINDS.items())
def test_actions_that_are_no_postures_are_left_out_and_said_once(tmp_path, kind, change):
    root = write(tmp_path / "set", change)
    with pytest.warns(PlausibilityWarning) as caught:
        found = load_lerobot(root)
    assert all(one.commands is None for one in found)
    [said] = [str(one.message) for one in caught]
    assert f"'action' holds {kind}" in said and "left out in episodes 0, 1" in said
    assert "\n" not in said and said.endswith("servos are learned while the robot runs")


@pytest.mark.parametrize("lag", [0.02, 0.1, 0.4])
def test_lags_sags_and_grips_are_postures(lag):
    time = np.arange(0, 4, 0.02)
    commands = np.stack((np.sin(time), 0.5 * np.cos(time), (time < 2) * 1.0), 1)
    joints = commands.copy()
    for now in range(1, len(time)):
        joints[now] += (joints[now - 1] - joints[now]) * math.exp(-0.02 / lag)
    joints[:, 2] = joints[:, 2].clip(0.6)
    assert classify_commands(commands, joints - [0.06, 0, 0]) == ""
    assert classify_commands(commands, np.zeros_like(joints)) == ""

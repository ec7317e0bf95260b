"""Gaps between commands and measured joints, learned from drives that are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.soft_drives import NAMES, demonstrations, learned
from tpgmm_torch import Demonstration, load, save
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.motion.command_gaps import INSTANTS, CommandGaps, episode_gaps

RATE, SAG, GRIP, LAG = 50, -0.05, -0.4, 0.12


def recorded(rate: int = RATE, leaps: bool = False) -> Demonstration:
    """A joint that sags, with a lag, and a gripper that closes on something at 2 s."""
    fine = np.arange(0, 6, 0.001)
    wanted = 0.6 * np.sin(np.clip(fine - 1, 0, 3)) ** 2
    if leaps:
        wanted = np.floor(5 * wanted) / 5
    grip = np.where((fine > 1.9) & (fine < 4), 0.0, 1.0)
    commands, joints = np.stack((wanted, grip), 1), []
    at = speed = np.array([wanted[0] + SAG, 1.0])
    speed = 0 * speed
    for command in commands:
        error = command - at + [SAG, 0.0]
        speed = speed + 0.001 * ((2 / LAG) ** 2 * error - 4 / LAG * speed)
        at = at + 0.001 * speed
        if at[1] < -GRIP:
            at[1], speed[1] = -GRIP, 0.0
        joints.append(at)
    rows = np.arange(0, len(fine), 1000 // rate)
    return Demonstration(
        fine[rows], np.array(joints)[rows], {}, ["lift", "gripper"], commands=commands[rows]
    )


@pytest.mark.parametrize("rate", [10, 30, 100])
@pytest.mark.parametrize("leaps", [False, True])
def test_what_gravity_and_a_grip_take_is_found(rate, leaps):
    shown = recorded(rate, leaps)
    gaps = CommandGaps.learn([episode_gaps(shown)] * 3, shown.time)
    for time, expected in ((0.5, [-SAG, 0.0]), (3.2, [-SAG, GRIP]), (5.7, [-SAG, 0.0])):
        gap, extent = gaps.at(np.array([time]))
        assert gap[0] == pytest.approx(expected, abs=0.015)
        assert (extent[0] >= np.abs(gap[0]) - 1e-3).all()
    # a gripper is pressed from when it has met the object, not while it closes
    assert abs(gaps.at(np.array([1.9]))[0][0, 1]) < 0.15
    assert float(gaps.lag[0]) == pytest.approx(LAG, abs=0.03 if rate > 10 else 0.06)


def test_a_sentence_says_what_was_learned():
    shown = recorded()
    gaps = CommandGaps.learn([episode_gaps(shown)], shown.time)
    said = "gripper is commanded 0.4 rad beyond; lift sags 0.05 rad"
    assert gaps.describe(shown.joint_names) == said
    both = replace(gaps, gap=gaps.gap[:, [0, 1, 1, 0]])
    names = ["left_lift", "left_gripper", "gripper_r", "lift_right"]
    said = "grippers are commanded 0.4 rad beyond; lifts sag 0.05 rad"
    assert both.describe(names) == said
    assert "lifts sag 0.05 m" in both.describe(names, lengths=[0, 3])
    nothing = replace(gaps, gap=0.01 * gaps.gap)
    assert "no joint rests more than 0.02 rad" in nothing.describe(shown.joint_names)


def test_nothing_is_learned_without_commands_or_from_what_follows_exactly():
    shown = recorded()
    assert episode_gaps(replace(shown, commands=None)) is None
    assert CommandGaps.learn([None], shown.time) is None
    late = torch.cat((shown.joints[1:], shown.joints[-1:]))
    exact = episode_gaps(replace(shown, commands=late))
    assert exact.shape == (3, INSTANTS, 2)
    assert CommandGaps.learn([exact], shown.time) is None


def test_commands_go_with_the_joints():
    shown = recorded()
    assert torch.equal(shown.reorder(["gripper"]).commands, shown.commands[:, 1:])
    assert torch.equal(shown.at_steps(slice(5, 20)).commands, shown.commands[5:20])
    late = replace(shown, joints=shown.joints + 0.01, time=1.1 * shown.time)
    aligned = DynamicTimeWarping().fit_transform([shown, late])
    gaps = [(one.commands - one.joints)[-1] for one in aligned]
    assert torch.allclose(gaps[0], gaps[1] + 0.01)
    with pytest.raises(ShapeError, match="commands has the shape of joints"):
        replace(shown, commands=shown.commands[:, :1])


def test_gaps_are_saved_with_the_model(tmp_path):
    model = learned(sag=0.06)
    save(model, tmp_path / "model")
    for made in (load(tmp_path / "model"), load(tmp_path / "model").skill):
        skill = getattr(made, "skill", made)
        time = np.linspace(skill.begin, skill.end, 7)
        for one, other in zip(
            skill.command_gaps(time), model.skill.command_gaps(time), strict=True
        ):
            assert np.array_equal(one, other)
    assert f"{NAMES[1]} sags 0.06 rad" in model.skill.gaps.describe(NAMES)
    assert learned().skill.command_gaps(np.zeros(1)) is None
    assert demonstrations()[0].commands is None

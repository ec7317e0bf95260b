"""The generated skill: shaking a bottle with both hands."""

import numpy as np
import pytest
import torch

from tpgmm_datasets.bottle.skill import HANDS, PHASES, BottleShaking
from tpgmm_tools.paper.sinusoid import sinusoid
from tpgmm_torch import Frame, Situation, quaternions


@pytest.fixture(scope="module")
def skill():
    return BottleShaking(rate=50)


@pytest.fixture(scope="module")
def demonstrations(skill):
    return skill.demonstrations(6, seed=3)


def test_both_hands_are_at_the_grasp_when_the_bottle_is_grasped(skill, demonstrations):
    for d in demonstrations:
        contact = int(torch.searchsorted(d.time, d.events["grasp"]))
        position, orientation = skill.grasp_error(d.joints[contact], d.frames["bottle"])
        assert position < 1e-4
        assert orientation < 1e-3


def test_grasp_error_is_that_of_the_worse_hand(skill, demonstrations):
    d = demonstrations[0]
    joints = d.joints[int(torch.searchsorted(d.time, d.events["grasp"]))].clone()
    joints[skill.robot.joint_names.index("r_wrist_roll")] += 0.1
    position, orientation = skill.grasp_error(joints, d.frames["bottle"])
    assert 0.0069 < position < 0.0071  # the hand is 7 cm beyond the wrist
    assert abs(orientation - 0.1) < 1e-3


def test_a_steady_rhythm_shakes_equally_long_in_demonstrations_of_unequal_length():
    demonstrations = BottleShaking(rate=50, steady_rhythm=True).demonstrations(4, seed=3)
    for d in demonstrations:
        assert d.events["rest"] - d.events["shake"] == pytest.approx(PHASES["shake"])
    assert np.ptp([d.duration for d in demonstrations]) > 2


def test_shaking_leaves_the_hands_where_they_are_on_the_bottle(skill, demonstrations):
    for d in demonstrations:
        held = d.time > d.events["grasp"]
        state = skill.robot.state(d.joints[held])
        left, right = (state.position(hand) for hand in HANDS)
        turn = quaternions.conjugate(state.orientation(HANDS[0]))
        between = quaternions.rotate(turn, right - left)
        assert (between - between[0]).abs().max() < 1e-3


def test_the_shoulders_shake_in_step_with_the_given_amplitude(skill, demonstrations):
    for d in demonstrations:
        start, end = d.events["shake"], d.events["rest"]
        window = (d.time > start + (end - start) / 8) & (d.time < end - (end - start) / 8)
        fits = [sinusoid(d.time[window], side[window]) for side in skill.shoulders(d).T]
        for fit in fits:
            assert fit.frequency == pytest.approx(skill.cycles / (end - start), rel=0.02)
            assert fit.amplitude == pytest.approx(skill.amplitude, rel=0.08)
        assert abs(fits[0].phase - fits[1].phase) < 0.05


def test_situations_start_within_limits_and_have_the_bottle_within_the_box(skill):
    for situation in skill.situations(20, seed=5):
        assert isinstance(situation, Situation)
        assert bool((situation.joints >= skill.robot.lower).all())
        x, y, z = situation.frames["bottle"].position.tolist()
        assert 0.24 <= x <= 0.32
        assert abs(y) <= 0.05
        assert 0.10 <= z <= 0.20


def test_the_nominal_path_is_the_same_skill_without_its_spread(skill):
    situations = skill.situations(2, seed=5)
    paths = skill.nominal(situations)
    for path, situation in zip(paths, situations, strict=True):
        assert path.duration == 13.0
        assert path.events == pytest.approx({"grasp": 4.25, "shake": 8.0, "rest": 12.5})
        torch.testing.assert_close(path.joints[0], situation.joints)
        bottle = path.frames["bottle"]
        position, _ = skill.grasp_error(path.joints[round(4.25 * skill.rate)], bottle)
        assert position < 1e-4
        steady = slice(round(8.6 * skill.rate), round(11.9 * skill.rate))
        for column in skill.shoulders(path)[steady].T:
            assert sinusoid(path.time[steady], column).amplitude == pytest.approx(
                skill.amplitude, rel=0.01
            )


@pytest.mark.parametrize(
    ("position", "yaw", "usual"),
    [
        ((0.24, -0.05, 0.10), -20, True),
        ((0.32, 0.05, 0.20), 20, True),
        ((0.33, 0.0, 0.15), 0, False),
        ((0.28, 0.0, 0.09), 0, False),
        ((0.28, 0.0, 0.15), 21, False),
    ],
)
def test_where_bottles_usually_stand(skill, position, yaw, usual):
    half = np.radians(yaw) / 2
    assert skill.usual(Frame(position, [np.cos(half), 0, 0, np.sin(half)])) == usual
    lying = Frame(position, [np.cos(0.1), np.sin(0.1), 0, 0])
    assert not skill.usual(lying)

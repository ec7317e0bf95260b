"""The generated skill: shaking a bottle with both hands."""

import numpy as np
import pytest
import torch

from tpgmm_datasets.bottle.skill import HANDS, PHASES, BottleShaking
from tpgmm_torch import Situation, quaternions
from tpgmm_torch.metrics import largest_velocity, sinusoid


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


def test_demonstrations_keep_the_robots_limits(skill, demonstrations):
    for d in demonstrations:
        assert bool((d.joints >= skill.robot.lower).all())
        assert bool((d.joints <= skill.robot.upper).all())
        assert largest_velocity(d) < 4.0


def test_durations_differ_by_more_than_fifteen_per_cent_both_ways(demonstrations):
    nominal = sum(PHASES.values())
    durations = [d.duration for d in demonstrations]
    assert nominal == 13.0
    assert min(durations) < 0.85 * nominal
    assert max(durations) > 1.15 * nominal


def test_a_steady_rhythm_shakes_equally_long_in_demonstrations_of_unequal_length():
    demonstrations = BottleShaking(rate=50, steady_rhythm=True).demonstrations(4, seed=3)
    for d in demonstrations:
        assert d.events["rest"] - d.events["shake"] == pytest.approx(PHASES["shake"])
    assert np.ptp([d.duration for d in demonstrations]) > 2


def test_phases_take_different_shares_of_the_time(demonstrations):
    shares = [d.events["grasp"] / d.duration for d in demonstrations]
    assert np.ptp(shares) > 0.02


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


def test_the_same_seed_gives_the_same_and_another_seed_other_demonstrations(skill):
    a, b, c = (skill.demonstrations(2, seed)[0] for seed in (1, 1, 2))
    assert torch.equal(a.joints, b.joints)
    assert len(a) != len(c) or not torch.equal(a.joints, c.joints)


def test_situations_start_within_limits_and_have_the_bottle_within_the_box(skill):
    for situation in skill.situations(20, seed=5):
        assert isinstance(situation, Situation)
        assert bool((situation.joints >= skill.robot.lower).all())
        x, y, z = situation.frames["bottle"].position.tolist()
        assert 0.24 <= x <= 0.32
        assert abs(y) <= 0.05
        assert 0.10 <= z <= 0.20

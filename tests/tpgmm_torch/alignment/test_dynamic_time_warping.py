"""Laws of dynamic time warping, on demonstrations whose true phase is known."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.motions import (
    DEMONSTRATIONS,
    EVENTS,
    NOMINAL,
    PHASES,
    Arm,
    motion,
    random_clock,
)
from tests.support.refusals import refused
from tests.support.worlds import upper_body
from tpgmm_datasets.bottle.skill import CHEST, BottleShaking
from tpgmm_torch.alignment import DynamicTimeWarping, LinearTimeNormalization
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, UnknownNameError


def spread_of_shake(paths):
    """Standard deviation between demonstrations of the shake's phase [rad], worst instant."""
    reached = [
        np.interp(path, one.time, phase)
        for path, one, phase in zip(paths, DEMONSTRATIONS, PHASES, strict=True)
    ]
    shaking = np.all([(s > 8.2) & (s < 11.8) for s in reached], axis=0)
    assert shaking.sum() > 100
    return 2 * np.pi * np.std(reached, axis=0)[shaking].max()


def spread_of_events(aligned):
    return {name: np.std([d.events[name] for d in aligned]) for name in EVENTS}


@pytest.fixture(scope="module")
def linear():
    transformer = LinearTimeNormalization()
    return transformer, transformer.fit_transform(DEMONSTRATIONS)


@pytest.fixture(scope="module", params=["joints", "robot", "barycenter"])
def warped_pair(request):
    transformer = DynamicTimeWarping(
        "barycenter" if request.param == "barycenter" else "medoid",
        robot=Arm() if request.param == "robot" else None,
    )
    return transformer, transformer.fit_transform(DEMONSTRATIONS)


def test_warping_lowers_the_spread_of_the_shake_tenfold(linear, warped_pair):
    before, after = spread_of_shake(linear[0].paths_), spread_of_shake(warped_pair[0].paths_)
    assert after < before / 10


def test_events_of_the_motion_come_together(linear, warped_pair):
    before, after = spread_of_events(linear[1]), spread_of_events(warped_pair[1])
    # of the spread at the grasp the barycentre leaves 0.25, the medoid 0.15
    assert all(after[name] < 0.3 * before[name] for name in EVENTS)
    assert after["shake"] < 0.05 and after["rest"] < 0.05


def test_all_results_share_one_increasing_clock(warped_pair):
    transformer, aligned = warped_pair
    assert all(torch.equal(d.time, transformer.time_) for d in aligned)
    assert (transformer.time_.diff() > 0).all()
    assert transformer.time_.dtype == torch.float64


def test_paths_increase_and_keep_both_ends(warped_pair):
    for path, demonstration in zip(warped_pair[0].paths_, DEMONSTRATIONS, strict=True):
        assert (np.diff(path) > 0).all()
        assert path[[0, -1]] == pytest.approx(demonstration.time[[0, -1]].numpy(), abs=1e-9)


def test_transform_repeats_what_fit_transform_gave(warped_pair):
    transformer, aligned = warped_pair
    for one, other in zip(transformer.transform(DEMONSTRATIONS[:3]), aligned, strict=False):
        torch.testing.assert_close(one.joints, other.joints, rtol=0, atol=1e-12)


def test_the_reference_is_recovered_exactly():
    transformer = DynamicTimeWarping(reference=2, robot=Arm())
    aligned = transformer.fit_transform(DEMONSTRATIONS[:4])
    own = DEMONSTRATIONS[2]
    assert transformer.reference_index_ == 2
    torch.testing.assert_close(aligned[2].joints, own.joints, rtol=0, atol=1e-11)
    assert torch.equal(aligned[2].time, own.time)
    assert dict(aligned[2].events) == pytest.approx(dict(own.events), abs=1e-9)


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.floats(0.6, 1.6), st.sampled_from([60.0, 100.0]))
def test_a_time_warped_copy_is_recovered(seed, scale, rate):
    rng = np.random.default_rng(seed)
    start, goal = rng.uniform(-0.3, 0.3, 5), rng.uniform(0.5, 1.0, 5)
    even = np.linspace(0, NOMINAL, 1301)
    original = Demonstration(even, motion(even, start, goal))
    time, phase = random_clock(rng, NOMINAL * scale, rate)
    copy = Demonstration(time, motion(phase, start, goal))
    # copies match exactly in joint space; directions and penalty are for those that do not
    transformer = DynamicTimeWarping(reference=0, features=["joints"], penalty=0.0)
    aligned = transformer.fit_transform([original, copy])[1]
    assert (aligned.joints - original.joints).abs().max() < 0.02
    moving = ((even > 0.8) & (even < 2.2)) | ((even > 8.4) & (even < 11.6))
    reached = np.interp(transformer.paths_[1], time, phase)
    assert np.abs(reached - even)[moving].max() < 0.05


def test_the_barycenter_runs_on_the_average_clock():
    family = DEMONSTRATIONS[:3]
    time = DynamicTimeWarping("barycenter").fit(family).time_
    assert time[0] == 0
    assert float(time[-1]) == pytest.approx(np.mean([one.duration for one in family]), rel=1e-9)


def test_the_medoid_is_the_one_in_the_middle():
    even = np.linspace(0, 1, 80)
    family = [
        Demonstration(even, np.stack((np.sin(5 * even) + c * even, even), 1))
        for c in (-1.0, 1.0, 0.0, 2.0, -2.0)
    ]
    assert DynamicTimeWarping().fit(family).reference_index_ == 2


def test_units_do_not_decide():
    # a power of two: where nothing moves, rounding decides
    family = DEMONSTRATIONS[:3]
    milli = [Demonstration(d.time, d.joints * 1024, d.frames) for d in family]
    paths = [DynamicTimeWarping(0).fit(x).paths_[1] for x in (family, milli)]
    np.testing.assert_allclose(*paths, rtol=0, atol=1e-9)


@pytest.mark.parametrize("reference", ["medoid", "barycenter", 0, -1])
def test_one_demonstration_alone_stays_itself(reference):
    own = DEMONSTRATIONS[0]
    [aligned] = DynamicTimeWarping(reference).fit_transform([own])
    torch.testing.assert_close(aligned.joints, own.joints, rtol=0, atol=1e-9)


@pytest.mark.parametrize("parameters, error, message", [
    ({"features": ["elbow"]}, UnknownNameError, "'elbow' is not in the features; it has"),
    ({"reference": 7}, DataError, "reference 7 is out of range: there are 2"),
    ({"reference": "mean"}, ValueError, "reference"),
    ({"max_slope": 1.5}, ValueError, "max_slope"),
    ({"min_gain": "linear"}, ValueError, "min_gain"),
])  # fmt: skip
def test_errors_say_what_is_wrong_with_the_parameters(parameters, error, message):
    refused(lambda: DynamicTimeWarping(**parameters).fit(DEMONSTRATIONS[:2]), error, message)


@pytest.mark.parametrize("reference", [0, "barycenter"])
def test_when_a_clock_starts_does_not_matter(reference):
    family = DEMONSTRATIONS[1:4]
    later = [
        Demonstration(d.time + shift, d.joints, d.frames, d.joint_names)
        for d, shift in zip(family, (0.0, 7.0, -3.0), strict=True)
    ]
    same, shifted = (DynamicTimeWarping(reference).fit(x) for x in (family, later))
    for one, other in zip(same.transform(family), shifted.transform(later), strict=True):
        # where nothing moves, rounding decides what is matched
        torch.testing.assert_close(one.joints, other.joints, rtol=0, atol=5e-3)
    moved = DynamicTimeWarping(reference).fit([later[1], *later[::2]])
    start = 0.0 if reference == "barycenter" else 7.0
    assert float(moved.time_[0]) == pytest.approx(start)


def test_smoothing_covers_its_seconds_on_both_sides():
    even = np.linspace(0, 4, 401)
    halting = np.minimum(even, 2) + np.maximum(even - 3, 0)  # waits from 2 s to 3 s
    waiting = Demonstration(even, halting[:, None])
    steady = Demonstration(np.linspace(0, 3, 301), np.linspace(0, 3, 301)[:, None])
    # a wait, that the other does not have, is steeper than any usual bound
    options = {"features": ["joints"], "penalty": 0.0, "max_slope": 60, "min_gain": None}
    sharp, smooth = (
        DynamicTimeWarping(0, smoothing=s, **options).fit([waiting, steady]).paths_[1]
        for s in (0.0, 0.5)
    )
    np.testing.assert_allclose(sharp, halting, rtol=0, atol=0.02)
    far = (abs(even - 2) > 0.52) & (abs(even - 3) > 0.52)
    np.testing.assert_allclose(smooth[far], sharp[far], rtol=0, atol=0.02)
    near = (abs(even - 2) < 0.3) | (abs(even - 3) < 0.3)
    assert np.abs(smooth - sharp)[near].max() > 0.05


@cache
def reaching_to_either_side():
    """Two demonstrations to bottles on either side, timed alike, that directions confuse."""
    skill = BottleShaking(rate=25, steady_rhythm=True)
    rng = np.random.default_rng(0)
    n = 110  # drawn together, of which these are the first two
    bottles, starts = skill.bottle_poses(n, rng)[:2], skill.start_postures(n, rng)[:2]
    ends = skill._phase_ends(n, rng)[:2]
    amplitudes = skill.amplitude * torch.from_numpy(rng.uniform(0.95, 1.05, n))[:2]
    chests = Frame((CHEST + rng.uniform(-0.005, 0.005, (n, 3)))[:2])
    pair = skill._demonstrations(bottles, chests, starts, ends, amplitudes)
    lifts = dict(zip(skill.phases, ends.T.tolist(), strict=True))["hold"]
    return [
        replace(one, events={"grasp": one.events["grasp"], "lift": lift})
        for one, lift in zip(pair, lifts, strict=True)
    ]


def apart(aligned, event):
    return abs(aligned[0].events[event] - aligned[1].events[event])


@pytest.mark.parametrize("robot", [None, upper_body()], ids=["joints", "robot"])
@pytest.mark.parametrize("order", [1, -1])
def test_a_grasp_and_a_lift_stay_together_that_directions_confuse(robot, order):
    pair = reaching_to_either_side()[::order]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PlausibilityWarning)  # linear time is right too
        aligned = DynamicTimeWarping(robot=robot).fit_transform(pair)
    assert apart(aligned, "grasp") < 0.3 and apart(aligned, "lift") < 0.3


@pytest.mark.parametrize("max_slope", [1, 2, 4])
def test_no_second_of_a_warp_is_steeper_or_flatter_than_allowed(max_slope):
    fitted = DynamicTimeWarping(0, features=["joints"], max_slope=max_slope, min_gain=None)
    for path in fitted.fit(DEMONSTRATIONS[:4]).paths_:
        steps = round(1.0 / float(fitted.time_[1]))
        share = (path - path[0]) / (path[-1] - path[0])
        slopes = (share[steps:] - share[:-steps]) * (len(path) - 1) / steps
        # a segment that is cut by the ends of the second belongs to it in part
        assert slopes.max() < max_slope * 1.05 and slopes.min() > 0.95 / max_slope


def linear_path(transformer, one):
    return np.linspace(*one.time[[0, -1]].tolist(), len(transformer.time_))


@pytest.mark.parametrize("reference", [0, "barycenter"])
def test_what_warping_does_not_bring_nearer_stays_linear_with_a_warning(reference):
    family = list(DEMONSTRATIONS[:3])
    turned = family[1].joints.flip(0)  # the same motion backwards
    family[1] = Demonstration(family[1].time, turned, family[1].frames, family[1].joint_names)
    transformer = DynamicTimeWarping(reference)
    with pytest.warns(PlausibilityWarning, match=r"demonstration 1: .*directions") as caught:
        aligned = transformer.fit_transform(family)
    assert len(caught) == 1
    assert list(transformer.fallback_) == [1]
    np.testing.assert_allclose(transformer.paths_[1], linear_path(transformer, family[1]))
    assert len({len(one) for one in aligned}) == 1
    with pytest.warns(PlausibilityWarning, match="linear time"):
        [again] = transformer.transform(family[1:2])
    torch.testing.assert_close(again.joints, aligned[1].joints)


def test_demonstrations_on_one_clock_need_no_warping_and_no_warning():
    time = np.linspace(0, 8, 400)
    family = [Demonstration(time, motion(time, np.full(5, c), np.ones(5))) for c in (0.0, 0.1)]
    fitted = DynamicTimeWarping(0).fit(family)
    assert fitted.fallback_ == {}
    assert np.abs(fitted.paths_[1] - linear_path(fitted, family[1])).max() < 0.02 * 8

"""Where a skill has parts: planted boundaries are found, rhythms and noise are none."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.pipeline import make_pipeline

from tests.support.errands import HAND, motion
from tests.support.refusals import refused
from tpgmm_torch import Demonstration, Frame, Situation
from tpgmm_torch.alignment import EventAlignment
from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.events import find_boundaries, find_stops
from tpgmm_torch.exceptions import NotFittedError
from tpgmm_torch.structure.segmentation import Segmentation


def pick_and_place(n=5, seed=0, noise=0.0, names=("hand.x", "hand.y", "hand.z", "gripper")):
    """Go somewhere, close a gripper, rest elsewhere, put down; and when that is."""
    rng, shown, truth = np.random.default_rng(seed), [], []
    for _ in range(n):
        lengths = np.array([2.0, 1.0, 2.0, 0.6, 1.5, 1.0, 1.0]) * rng.uniform(0.85, 1.15, 7)
        ends = lengths.cumsum()
        time = np.arange(0, ends[-1], 0.04)
        signs = [[1, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, 1, -1]]
        places = rng.uniform(0.2, 0.4, (4, 3)) * signs
        legs = [(0, ends[0]), (ends[1], ends[2]), (ends[3], ends[4]), (ends[5], ends[6])]
        path = motion(time, [(*leg, place) for leg, place in zip(legs, places, strict=True)])
        path += noise * rng.normal(size=path.shape)
        closes, opens = ends[0] + 0.6 * lengths[1], ends[4] + 0.5 * lengths[5]
        u = np.clip((time - closes) / 0.2 + 0.5, 0, 1) - np.clip(
            (time - opens) / 0.2 + 0.5, 0, 1
        )
        joints = np.column_stack([path, 1 - u])
        shown.append(Demonstration(time, joints, joint_names=names))
        truth.append([closes, (ends[2] + ends[3]) / 2, opens])
    return shown, np.array(truth)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 0.001])
def test_planted_boundaries_are_found(seed, noise):
    shown, truth = pick_and_place(seed=seed, noise=noise)
    found = Segmentation().fit(shown)
    assert found.n_parts_ == 4
    assert found.reasons_ == ("gripper closes, stop", "stop", "gripper opens, stop")
    duration = np.array([one.duration for one in shown])[:, None]
    assert (abs(found.boundaries_ - truth) / duration).max() < 0.03
    assert (found.shares_ == 1).all()
    np.testing.assert_allclose(
        found.progress_, np.median(found.boundaries_ / duration, axis=0), atol=0.01
    )


def test_boundaries_are_one_within_a_shift_and_events_happen_at_stops_within_a_margin():
    shown, _ = pick_and_place(seed=1)
    assert Segmentation(shift=1e-4, agreement=1.0).fit(shown).n_parts_ == 1
    near, exact = (find_boundaries(shown[0], margin=margin) for margin in (0.2, 0.0))
    assert len(near) <= len(exact)
    assert len(find_stops(shown[0], rest=0.01)) <= len(find_stops(shown[0])) == 3


def test_a_rhythm_has_no_parts_whatever_its_period():
    time = np.arange(0, 10, 0.04)
    for period in (0.8, 2.0, 4.0):
        swing = Demonstration(time, np.sin(2 * np.pi * time / period)[:, None])
        assert find_stops(swing) == []
        turns = [stop.time for stop in find_stops(swing, dwell=0.0)]
        wanted = np.arange(period / 4, 10, period / 2)
        assert np.abs(np.array(turns)[:, None] - wanted).min(axis=1).max() < 0.03
        assert len(wanted) - 2 <= len(turns) <= len(wanted)  # at the ends there is half a turn


@pytest.mark.parametrize("rest", [0.0, 0.5, 2.0])
def test_motions_that_meet_at_rest_are_two(rest):
    time = np.arange(0, 5 + rest, 0.04)
    legs = [(0, 2, [0.3, 0, 0]), (2 + rest, 5 + rest, [0.3, 0.4, 0])]
    [stop] = find_stops(Demonstration(time, motion(time, legs)))
    assert stop.time == pytest.approx(2 + rest / 2, abs=0.1)
    assert stop.end - stop.begin == pytest.approx(rest, abs=0.8)


def test_rest_at_the_ends_and_standing_still_are_no_boundaries():
    time = np.arange(0, 6, 0.04)
    assert find_boundaries(Demonstration(time, motion(time, [(2, 4, [0.3, 0, 0])]))) == []
    assert find_boundaries(Demonstration(time, np.zeros((len(time), 2)))) == []
    assert find_boundaries(Demonstration(time[:3], np.zeros((3, 2)))) == []


def test_a_gripper_that_only_opens_prepares():
    """It was closed from the start and opens on the way: no part ends."""
    time = np.arange(0, 4, 0.04)
    path = motion(time, [(0, 3, [0.3, 0.2, 0])])
    opening = np.clip((time - 1) / 0.4, 0, 1)
    names = ("x", "y", "z", "gripper")
    shown = Demonstration(time, np.column_stack([path, opening]), joint_names=names)
    assert find_boundaries(shown) == []
    closing = Demonstration(time, np.column_stack([path, 1 - opening]), joint_names=names)
    assert [one.reason for one in find_boundaries(closing)] == ["gripper closes"]


def test_what_is_carried_is_taken_and_let_go():
    time = np.arange(0, 9, 0.04)
    legs = [(0, 2, [0.3, 0, 0]), (3, 5, [0.3, 0.4, 0]), (6, 8, [0, 0, 0.2])]
    hand = motion(time, legs)
    cup = np.where((time < 2.5)[:, None], [0.3, 0, 0], hand)
    cup = np.where((time > 5.5)[:, None], [0.3, 0.4, 0], cup)
    shown = Demonstration(time, hand, {"cup": Frame(cup)}, HAND.joint_names)
    first, second = find_boundaries(shown, HAND)
    assert first.reason == "cup is taken, stop" and 2 <= first.time <= 3
    assert second.reason == "cup is let go, stop" and 5 <= second.time <= 6


def test_a_demonstration_that_lacks_a_boundary_has_it_in_proportion():
    shown, truth = pick_and_place(6)
    one = shown[3]
    joints = as_array(one.joints).copy()
    time = as_array(one.time)
    rest = (time > truth[3, 1] - 1.0) & (time < truth[3, 1] + 1.0)
    ends = joints[rest][[0, -1], :3]
    share = np.linspace(0, 1, rest.sum())[:, None]
    joints[rest, :3] = ends[0] + share * (ends[1] - ends[0])  # it goes on through
    shown[3] = Demonstration(one.time, joints, joint_names=one.joint_names)
    found = Segmentation().fit(shown)
    assert found.n_parts_ == 4 and found.shares_[1] == pytest.approx(5 / 6)
    assert abs(found.boundaries_ - truth)[3, 1] < 0.05 * one.duration
    assert Segmentation(agreement=0.9).fit(shown).n_parts_ == 3


def test_parts_are_events_at_which_demonstrations_can_be_aligned():
    shown, _ = pick_and_place()
    steps = make_pipeline(Segmentation(), EventAlignment(["part *"]))
    aligned = steps.fit_transform(shown)
    assert list(aligned[0].events) == ["part 2", "part 3", "part 4"]
    for one in aligned[1:]:
        for name, at in aligned[0].events.items():
            assert one.events[name] == pytest.approx(at, abs=1e-3)
    again = Segmentation().fit(aligned)
    assert np.ptp(again.boundaries_, axis=0).max() < 0.25
    situation = Situation([0.0] * 4)
    assert steps.transform([situation]) == [situation]


def test_other_events_stay_and_new_demonstrations_are_served():
    shown, _ = pick_and_place(8)
    found = Segmentation().fit(shown[:5])
    named = found.transform(
        [
            Demonstration(
                one.time,
                one.joints,
                joint_names=one.joint_names,
                events={"here": 1.0, "part 9": 2.0},
            )
            for one in shown
        ]
    )
    assert list(named[7].events) == ["here", "part 2", "part 3", "part 4"]
    times = [[one.events[f"part {k}"] for k in (2, 3, 4)] for one in named[:5]]
    np.testing.assert_allclose(times, found.boundaries_, atol=0.02)


def test_clones_and_what_is_refused():
    found = clone(Segmentation(agreement=0.9))
    assert found.agreement == 0.9
    refused(lambda: found.transform([]), NotFittedError, "call fit")
    refused(lambda: found.report(), NotFittedError, "call fit")
    with pytest.raises(ValueError, match="agreement"):
        Segmentation(agreement=2).fit(pick_and_place(2)[0])

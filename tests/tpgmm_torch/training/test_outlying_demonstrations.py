"""Demonstrations that are unlike the others are found, told of, and not learned from."""

import warnings
from dataclasses import replace
from itertools import batched

import pytest
import torch

from tests.support.skills import HANDLING, HANDS, handlings, hands_model, waves
from tpgmm_torch import Canonical, Frame
from tpgmm_torch.exceptions import PlausibilityWarning
from tpgmm_torch.robots.kinematics import JointSpace
from tpgmm_torch.training.outlying_demonstrations import drop_outliers, outlying_demonstrations


def misplace(demonstration, shift=0.3):
    """The cup was seen in a wrong place."""
    cup = demonstration.frames["cup"]
    there = cup.position + torch.tensor([0.0, shift, 0.0], dtype=torch.float64)
    return replace(demonstration, frames={"cup": Frame(there, cup.orientation)})


def test_a_frame_a_hand_s_breadth_beside_its_place_is_found():
    # as one that was taken from the hand at a wrong instant, shortly before it closes
    shown = [misplace(d, 0.1) if i in (3, 8) else d for i, d in enumerate(handlings(10))]
    assert episodes(shown) == [3, 8]


def some_misplaced(n, wrong):
    shown = handlings(n)
    return [misplace(d) if index in wrong else d for index, d in enumerate(shown)]


def episodes(shown):
    return [one.episode for one in outlying_demonstrations(shown, HANDLING, HANDS)]


@pytest.mark.parametrize("n", [5, 8, 20])
def test_what_is_like_the_others_is_kept(n):
    assert episodes(handlings(n)) == []
    assert outlying_demonstrations(waves(n), [Canonical()], JointSpace(("a", "b", "c"))) == ()


@pytest.mark.parametrize(
    ("n", "wrong"), [(5, [2]), (10, [0, 9]), (15, [3, 4, 11]), (20, [1, 6, 11, 16])]
)
def test_a_fifth_of_wrong_frames_is_found(n, wrong):
    shown = some_misplaced(n, wrong)
    assert episodes(shown) == wrong
    for one in outlying_demonstrations(shown, HANDLING, HANDS):
        assert "cup" in one.operator.references() and one.ratio > 6
        assert shown[0].time[0] <= one.time <= shown[0].time[-1]


def test_how_far_and_how_long_is_the_caller_s_choice():
    shown = some_misplaced(8, [5])
    [ratio] = [one.ratio for one in outlying_demonstrations(shown, HANDLING, HANDS)]
    for threshold, kept in ((0.99 * ratio, 7), (1.01 * ratio, 8)):
        with warnings.catch_warnings(action="ignore"):
            assert len(drop_outliers(shown, HANDLING, HANDS, threshold=threshold)) == kept
    lasts = float(shown[0].time[-1] - shown[0].time[0])
    short, long = (
        outlying_demonstrations(shown, HANDLING, HANDS, duration=share * lasts)
        for share in (0.05, 0.5)
    )
    assert short[0].ratio > (long[0].ratio if long else 0.0)


def test_one_turned_frame_is_found():
    shown = handlings(6)
    cup = shown[2].frames["cup"]
    turned = cup.orientation[[1, 0, 3, 2]]
    shown[2] = replace(shown[2], frames={"cup": Frame(cup.position, turned)})
    assert episodes(shown) == [2]


def test_the_unit_of_lengths_does_not_matter():
    def in_millimetres(demonstration):
        joints = demonstration.joints.clone()
        joints[:, [0, 1, 2, 7, 8, 9]] *= 1000
        cup = demonstration.frames["cup"]
        return replace(
            demonstration,
            joints=joints,
            frames={"cup": Frame(1000 * cup.position, cup.orientation)},
        )

    for wrong in ([], [4]):
        assert episodes(list(map(in_millimetres, some_misplaced(8, wrong)))) == wrong


def test_four_are_too_few_and_two_ways_are_no_mistake():
    assert episodes(some_misplaced(4, [1])) == []
    assert episodes(some_misplaced(10, [1, 3, 5, 7])) == []


def test_demonstrations_of_other_lengths_are_compared_at_equal_phase():
    shown = some_misplaced(8, [5])
    cut = zip(shown, range(30, 0, -1), strict=False)
    shown = [replace(d, time=d.time[:n], joints=d.joints[:n]) for d, n in cut]
    assert episodes(shown) == [5]


def test_they_are_dropped_with_one_warning_that_says_where():
    shown = some_misplaced(8, [5])
    with pytest.warns(PlausibilityWarning) as caught:
        kept = drop_outliers(shown, HANDLING, HANDS)
    [told] = [w for w in caught if issubclass(w.category, PlausibilityWarning)]
    assert told.filename == __file__ and "1 of 8 are unlike the others" in str(told.message)
    assert "demonstration 5 (" in str(told.message) and "@cup at " in str(told.message)
    assert kept == [*shown[:5], *shown[6:]]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(drop_outliers(kept, HANDLING, HANDS)) == 7


def test_fit_learns_from_all_and_warns():
    shown = some_misplaced(8, [5])
    with pytest.warns(PlausibilityWarning, match=r"demonstration 5 .*drop_outliers\("):
        everyone = hands_model().fit(shown)
    robust, good = hands_model().fit([*shown[:5], *shown[6:]]), handlings(9)[8:]
    assert robust.score(good) > everyone.score(good) + 5


@pytest.mark.parametrize("responsibilities", ["instant", "point"])
def test_demonstrations_of_all_batches_are_compared(responsibilities):
    shown = some_misplaced(8, [6])
    with pytest.warns(PlausibilityWarning, match="1 of 8 are unlike the others.*n 6 "):
        hands_model(responsibilities=responsibilities).fit(list(map(list, batched(shown, 3))))

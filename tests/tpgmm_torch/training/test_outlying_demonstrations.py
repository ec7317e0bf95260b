"""Demonstrations that are unlike the others are found, told of, and not learned from."""

import warnings
from dataclasses import replace

import pytest
import torch
from sklearn.model_selection import KFold

from tests.support.skills import HANDLING, HANDS, canonical, handlings, hands_model, same, waves
from tpgmm_torch import Canonical, Frame
from tpgmm_torch.exceptions import PlausibilityError, PlausibilityWarning
from tpgmm_torch.model_selection import fit_folds
from tpgmm_torch.robots.joint_space import JointSpace
from tpgmm_torch.training import training_rows
from tpgmm_torch.training.outlying_demonstrations import outlying_demonstrations


def misplaced(demonstration, shift=0.3):
    """The cup was seen in a wrong place."""
    cup = demonstration.frames["cup"]
    there = cup.position + torch.tensor([0.0, shift, 0.0], dtype=torch.float64)
    return replace(demonstration, frames={"cup": Frame(there, cup.orientation)})


def test_a_frame_a_hand_s_breadth_beside_its_place_is_found():
    # as one that was taken from the hand at a wrong instant, shortly before it closes
    shown = [misplaced(d, 0.1) if i in (3, 8) else d for i, d in enumerate(handlings(10))]
    assert episodes(shown) == [3, 8]


def some_misplaced(n, wrong):
    shown = handlings(n)
    return [misplaced(d) if index in wrong else d for index, d in enumerate(shown)]


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
    shown = [
        replace(d, time=d.time[: 30 - m], joints=d.joints[: 30 - m])
        for m, d in enumerate(shown)
    ]
    assert episodes(shown) == [5]


def test_they_are_left_out_with_one_warning_that_says_where():
    shown = some_misplaced(8, [5])
    with pytest.warns(PlausibilityWarning) as caught:
        model = hands_model().fit(shown)
    [told] = [w for w in caught if issubclass(w.category, PlausibilityWarning)]
    assert "left out: 1 of 8 are unlike the others" in str(told.message)
    assert "demonstration 5 (" in str(told.message) and "@cup at " in str(told.message)
    assert model.demonstration_weights_.tolist() == [1, 1, 1, 1, 1, 0, 1, 1]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rest = hands_model().fit([*shown[:5], *shown[6:]])
    same(model, rest, 1e-12)
    assert model.summary_ == rest.summary_


def test_all_are_learned_from_if_asked():
    shown = some_misplaced(8, [5])
    everyone = hands_model(robust=False, plausibility="ignore").fit(shown)
    assert everyone.demonstration_weights_.tolist() == [1] * 8
    robust = hands_model(plausibility="ignore").fit(shown)
    good = handlings(9)[8:]
    assert robust.score(good) > everyone.score(good) + 5
    with pytest.raises(PlausibilityError, match="demonstration 5"):
        hands_model(plausibility="error").fit(shown)


@pytest.mark.parametrize("wrong", [[5], [0, 6]])
@pytest.mark.parametrize("longer", [0, 3])
def test_batches_are_looked_at_together(wrong, longer):
    shown = some_misplaced(8, wrong)
    if longer:  # not on one grid: by points
        time = torch.cat((shown[7].time, shown[7].time[-1] + shown[7].time[1 : 1 + longer]))
        joints = torch.cat((shown[7].joints, shown[7].joints[-longer:]))
        shown[7] = replace(shown[7], time=time, joints=joints)
    told = [
        rf"{len(wrong)} of 8 are unlike the others",
        *(f"demonstration {i} " for i in wrong),
    ]
    with pytest.warns(PlausibilityWarning) as caught:
        model = hands_model().fit([shown[:3], shown[3:4], shown[4:]])
    said = str(caught.pop(PlausibilityWarning).message)
    assert all(each in said for each in told)
    weights = [float(i not in wrong) for i in range(8)]
    assert model.demonstration_weights_.tolist() == weights
    good = [one for one, weight in zip(shown, weights, strict=True) if weight]
    rest = hands_model(robust=False, plausibility="ignore").fit([good[:4], good[4:]])
    same(model, rest, 1e-9)
    assert model.summary_ == rest.summary_


def test_many_demonstrations_are_thinned_out(monkeypatch):
    monkeypatch.setattr(training_rows, "LARGEST_TABLE", 1)
    shown = some_misplaced(15, [3, 4, 11])
    model = hands_model(plausibility="ignore").fit([shown[:7], shown[7:]])
    assert (model.demonstration_weights_ == 0).nonzero()[:, 0].tolist() == [3, 4, 11]


def test_weights_are_not_saved_with_a_model(tmp_path):
    model = hands_model().fit(handlings(6))
    model.save(tmp_path / "model")
    assert type(model).load(tmp_path / "model").demonstration_weights_ is None


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_folds_leave_out_what_each_would_alone():
    shown = some_misplaced(12, [5])
    folds = [train for train, _ in KFold(2).split(shown)]
    models = fit_folds(hands_model(), shown, folds)
    for model, fold in zip(models, folds, strict=True):
        own = [shown[index] for index in fold]
        same(model, hands_model().fit(own), 1e-7)
        assert model.demonstration_weights_.sum() == 6 - (5 in fold)
    assert fit_folds(canonical(), waves(6), folds[:0]) == []

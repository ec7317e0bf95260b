"""Learning goes on: with more demonstrations, with fewer, and from a file."""

import warnings

import pytest
import torch

from tests.support.planted import HAND, NAMES, PlantedTask
from tests.support.skills import handlings, hands_model, wave, waves
from tpgmm_torch import Canonical, Demonstration, Situation, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, DegenerateComponentWarning, UnknownNameError
from tpgmm_torch.operators.text import parse_operator

SHOWN = waves(6, 60)


def model(**options):
    return TaskParameterizedGMM(**{"n_components": 4, "robust": False, **options})


def assert_equal(one, other, tolerance=1e-10):
    pairs = zip(
        (one.weights_, *one.means_, *one.covariances_),
        (other.weights_, *other.means_, *other.covariances_),
        strict=True,
    )
    for a, b in pairs:
        assert torch.allclose(a, b, rtol=0, atol=tolerance)


def ragged(demonstrations):
    """On clocks of their own."""
    return [
        Demonstration(d.time * (1 + 0.01 * m), d.joints, d.frames, d.joint_names)
        for m, d in enumerate(demonstrations)
    ]


@pytest.mark.parametrize("covariance_type", ["full", "diag", "tied"])
@pytest.mark.parametrize("shrinkage", ["auto", 0.0, 0.5])
def test_it_is_a_warm_start_on_all_demonstrations(covariance_type, shrinkage):
    options = {"covariance_type": covariance_type, "covariance_shrinkage": shrinkage}
    went_on = model(**options).fit(SHOWN[:4]).partial_fit(SHOWN[4:])
    whole = model(**options, warm_start=True).fit(SHOWN[:4]).fit(SHOWN)
    assert_equal(went_on, whole)
    assert went_on.lower_bound_ == pytest.approx(whole.lower_bound_)


def test_so_it_is_where_each_point_has_its_own_responsibility():
    shown = ragged(SHOWN)
    went_on = model().fit(shown[:4]).partial_fit(shown[4:])
    assert_equal(went_on, model(warm_start=True).fit(shown[:4]).fit(shown))


def test_one_component_is_that_of_any_fit():
    assert_equal(model(n_components=1).fit(SHOWN[:2]).partial_fit(SHOWN[2:]),
                 model(n_components=1).fit(SHOWN))  # fmt: skip


def test_links_and_frames_go_on_too():
    shown = handlings(5)
    options = {"robust": False, "plausibility": "ignore"}
    went_on = hands_model(**options).fit(shown[:4]).partial_fit(shown[4:])
    whole = hands_model(**options, warm_start=True).fit(shown[:4]).fit(shown)
    assert_equal(went_on, whole, 1e-8)
    assert went_on.summary_.n_demonstrations == 5


def test_what_is_forgotten_was_not_learned():
    fitted = model().fit(SHOWN)
    fitted.partial_fit(forget=2).partial_fit(forget=[4])
    assert fitted.demonstration_weights_.tolist() == [0, 0, 1, 1, 0, 1]
    left = [SHOWN[i] for i in (2, 3, 5)]
    warm = model(warm_start=True).fit(SHOWN).fit(SHOWN[2:]).fit(left)
    assert_equal(fitted, warm)


@pytest.mark.parametrize("forget", [0, 1])
def test_components_keep_their_data_when_a_demonstration_is_added(forget):
    """However many more coordinates there are than demonstrations."""
    task = PlantedTask(0, 1)
    operators = [parse_operator(f"pose:hand@{name}") for name in NAMES[:4]]
    shown = task.demonstrations(5)
    fitted = TaskParameterizedGMM(6, [*operators, Canonical()], HAND, robust=False)
    fitted.fit(shown[:4])
    with warnings.catch_warnings():
        warnings.simplefilter("error", DegenerateComponentWarning)
        fitted.partial_fit(shown[4:], forget=forget)
    assert fitted.weights_.min() > 0.5 / 6


def test_one_that_was_left_out_stays_out():
    odd = Demonstration(SHOWN[0].time, SHOWN[0].joints + 3.0, joint_names=("a", "b", "c"))
    with pytest.warns(UserWarning, match="unlike"):
        fitted = TaskParameterizedGMM(n_components=4).fit([*SHOWN, odd])
    without = model(warm_start=True).fit(SHOWN)
    more = waves(3, 60)[1:2]
    fitted.partial_fit(more)
    assert fitted.demonstration_weights_.tolist() == [1] * 6 + [0] + [1]
    assert_equal(fitted, without.fit([*SHOWN, *more]))


def test_of_a_segment_only_what_it_shows_counts():
    segment = Demonstration(
        SHOWN[0].time[20:40], SHOWN[0].joints[20:40] + 0.5, joint_names=("a", "b", "c")
    )
    fitted = model(n_components=10).fit(SHOWN)
    start = Situation(joints=SHOWN[2].joints[0])
    [before] = fitted.predict([start])
    [after] = fitted.partial_fit([segment]).predict([start])
    moved = (after.joints - before.joints).abs().amax(-1)
    assert float(moved[25:35].min()) > 0.04 and float(moved.max()) < 0.12  # a seventh of 0.5
    assert float(moved[:10].max()) < 0.02 and float(moved[50:].max()) < 0.02


def test_a_segment_comes_at_its_own_rate():
    time = torch.linspace(0.5, 1.5, 173, dtype=torch.float64)
    fitted = model().fit(SHOWN)
    fitted.partial_fit([Demonstration(time, wave(time), joint_names=("a", "b", "c"))])
    assert len(fitted.demonstration_weights_) == 7


def test_a_file_keeps_what_is_needed(tmp_path):
    fitted = model().fit(SHOWN[:4])
    fitted.save(tmp_path / "small")
    fitted.save(tmp_path / "whole", demonstrations=True)
    loaded = TaskParameterizedGMM.load(tmp_path / "whole")
    assert loaded.demonstration_weights_.tolist() == [1] * 4
    assert_equal(loaded.partial_fit(SHOWN[4:]), fitted.partial_fit(SHOWN[4:]))
    with pytest.raises(DataError, match="demonstrations=True"):
        TaskParameterizedGMM.load(tmp_path / "small").partial_fit(SHOWN[4:])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"X": [Demonstration([5.0, 6.0], [[0.0] * 3] * 2)]}, DataError, "in_skill_time"),
        ({"forget": 6}, DataError, "0 to 5"),
        ({"forget": [7]}, DataError, r"\[7\]"),
        ({"forget": [0, 1, 2, 3, 4, 5]}, DataError, "left"),
    ],
)
def test_what_does_not_fit_changes_nothing(arguments, error, message):
    fitted = model(plausibility="ignore").fit(SHOWN)
    means, weights = fitted.means_, fitted.demonstration_weights_.clone()
    with pytest.raises(error, match=message):
        fitted.partial_fit(**arguments)
    assert fitted.means_ is means
    assert torch.equal(fitted.demonstration_weights_, weights)


def test_frames_that_are_missing_are_refused():
    shown = handlings()
    fitted = hands_model().fit(shown)
    bare = Demonstration(shown[0].time, shown[0].joints, {}, shown[0].joint_names)
    with pytest.raises(UnknownNameError, match="cup"):
        fitted.partial_fit([bare])


def test_via_points_stay():
    fitted = model().fit(SHOWN[:4]).with_via_points(["1.0:canonical=a:0.5"])
    before = fitted.means_
    assert fitted.partial_fit(SHOWN[4:]).via_points_
    assert fitted.means_ is not before

"""Parts chained in one mixture: each its own, and from one to the next without a jump."""

import numpy as np
import pytest
import torch
from sklearn.base import clone
from sklearn.pipeline import make_pipeline

from tests.support.errands import HAND, errands
from tests.support.skills import (
    HANDLING,
    canonical,
    handlings,
    hands_model,
    new_handling,
    same,
    waves,
)
from tpgmm_torch import (
    AbsolutePosition,
    Canonical,
    Frame,
    RelativePosition,
    Segmentation,
    Situation,
    Stack,
    TaskParameterizedGMM,
)
from tpgmm_torch.alignment import EventAlignment
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, UnknownNameError
from tpgmm_torch.model_selection import fit_folds
from tpgmm_torch.structure.component_selection import ComponentSelection
from tpgmm_torch.structure.parts import check_cuts, components_of_parts, united

CUP, TRAY = RelativePosition("hand", "cup"), RelativePosition("hand", "tray")
IN_PARTS = [[CUP, Canonical()], [CUP, TRAY, Canonical()]]


def model(**options):
    settings = {"n_components": 8, "operators": [CUP, TRAY, Canonical()], "robot": HAND}
    return TaskParameterizedGMM(**{**settings, "blend": 0.0, **options})


@pytest.fixture(scope="module")
def fitted():
    return model(parts="auto", operators="auto").fit(errands())


def test_one_part_is_the_plain_model_bit_for_bit():
    plain = canonical().fit(waves())
    for parts in ((), [], Segmentation()):
        found = canonical(parts=parts).fit(waves())
        same(found, plain)
        assert found.parts_ == ()
    assert found.segmentation_.n_parts_ == 1 and plain.segmentation_ is None
    more = waves(6)[4:]
    same(found.partial_fit(more), plain.partial_fit(more))


def test_each_part_is_learned_from_what_it_shows():
    """Weights are shares of time, and the components those of the rows alone."""
    shown = waves(length=40)
    found = canonical(parts=[0.5]).fit(shown)
    first, second = found.parts_
    assert (first.begin, first.end, second.end) == (0.0, 0.5, 2.0)
    assert [first.n_components, second.n_components] == [2, 4]
    inside = shown[0].time < 0.5
    assert float(found.weights_[:2].sum()) == pytest.approx(float(inside.double().mean()))
    alone = canonical(n_components=2, reg_covar=0).fit([d.at_steps(inside) for d in shown])
    free = canonical(parts=[0.5], reg_covar=0).fit(shown)
    torch.testing.assert_close(free.means_[0][:2], alone.means_[0], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(
        free.covariances_[0][:2], alone.covariances_[0], rtol=1e-4, atol=1e-6
    )


def test_what_matters_is_found_part_by_part(fitted):
    assert [part.reason for part in fitted.parts_] == ["the beginning", "stop"]
    first, second = (set(part.operators) for part in fitted.parts_)
    assert CUP in first and TRAY not in first
    assert TRAY in second and CUP in second  # it begins at the cup
    assert Canonical() in first & second
    assert len(fitted.operator_selection_) == 2
    assert fitted.frame_names_ == ("cup", "tray")


def test_operators_of_parts_can_be_given():
    """The tray says nothing of the way to the cup, wherever it stands."""
    shown = errands()
    given = model(parts=["taken"], operators=[[CUP, Canonical()], [CUP, TRAY, Canonical()]])
    given.fit(shown)
    assert given.operators_ == (CUP, Canonical(), TRAY)
    assert given.parts_[0].operators == (CUP, Canonical())
    far = Frame([0.4, -5.0, 0.0])  # nobody's tray
    near = errands(1, seed=7)[0]
    paths = []
    for tray in (near.frames["tray"], far):
        frames = {"cup": near.frames["cup"], "tray": tray}
        situation = Situation([0.0, 0.0, 0.0], frames, np.linspace(0, 2.2, 45))
        given.plausibility = "ignore"
        paths.append(given.predict([situation])[0].joints)
    plain = model(parts=["taken"], plausibility="ignore").fit(shown)
    situation = Situation([0.0, 0.0, 0.0], frames, np.linspace(0, 2.2, 45))
    pulled = (
        plain.predict([situation])[0].joints
        - plain.predict([Situation([0.0, 0.0, 0.0], near.frames, np.linspace(0, 2.2, 45))])[
            0
        ].joints
    )
    assert float((paths[0] - paths[1]).abs().max()) < 0.005
    assert float((paths[0] - paths[1]).abs().max()) < 0.1 * float(pulled.abs().max())


def test_it_reproduces_and_goes_smoothly_from_part_to_part(fitted):
    plain = model().fit(errands())
    for new in errands(4, seed=5):
        frames, start = new.frames, new.joints[0]
        situation = Situation(start, frames, np.linspace(0, 6, 601))
        paths = [one.predict([situation])[0].joints for one in (fitted, plain)]
        at = [float((path[300] - frames["cup"].position).norm()) for path in paths]
        ends = [float((path[-1] - frames["tray"].position).norm()) for path in paths]
        assert at[0] < 0.005 and at[0] < at[1] + 0.001 and ends[0] < ends[1] + 0.001
        jumps = [float(path.diff(dim=0).diff(dim=0).abs().max()) for path in paths]
        assert jumps[0] < 1.5 * jumps[1]


def test_a_controller_goes_through_all_parts_and_knows_where_it_is(fitted):
    new = errands(1, seed=8)[0]
    controller = fitted.controller(new.joints[0], new.frames)
    joints, times = new.joints[0], []
    for _ in range(300):
        command = controller.step(0.02, joints=joints)
        joints = command.reference
        times.append(float(command.time))
    assert np.abs(np.array(times) - 0.02 * np.arange(1, 301)).max() < 0.05
    assert float((joints - new.frames["tray"].position).norm()) < 0.02


def test_it_is_saved_whole(fitted, tmp_path):
    kept = clone(fitted).fit(errands())
    kept.save(tmp_path / "model", demonstrations=True)
    again = TaskParameterizedGMM.load(tmp_path / "model")
    same(again, fitted)
    assert again.parts_ == fitted.parts_ and again.parts == "auto"
    more = errands(2, seed=3)
    same(again.partial_fit(more), kept.partial_fit(more), 1e-9)
    assert again.parts_ == fitted.parts_


def test_learning_goes_on_within_the_parts(fitted):
    """As if all had been there from the start, where one component leaves nothing to chance."""
    shown = errands(8)
    settings = {"n_components": 2, "parts": [3.0], "robust": False, "plausibility": "ignore"}
    few, every = model(**settings).fit(shown[:5]), model(**settings).fit(shown)
    few.partial_fit(shown[5:])
    for one, other in zip(few.means_, every.means_, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-8)
    for one, other in zip(few.covariances_, every.covariances_, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-7)
    given = model(**settings, operators=[[CUP, Canonical()], [TRAY, Canonical()]]).fit(shown)
    wide = given.covariances_[given.operators_.index(TRAY)][0]
    again = given.partial_fit(forget=1).covariances_[given.operators_.index(TRAY)][0]
    assert float(wide[1, 1]) > 1 and float(again[1, 1]) > 1


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.ConvergenceWarning")
def test_components_are_found_part_by_part():
    found = canonical(n_components=ComponentSelection([1, 2, 3]), parts=[0.8])
    found.fit(waves(length=40))
    numbers = [part.n_components for part in found.parts_]
    assert [one.n_components_ for one in found.component_selection_] == numbers
    assert found.n_components_ == sum(numbers) == len(found.weights_)


def test_operators_are_weighed_by_what_is_shown_of_each_part():
    """What does not matter in a part has no say in how much the others do."""
    settings = {"n_components": 2, "parts": [3.0], "operator_weights": "held-out"}
    shown = errands()
    found = model(**settings, operators=IN_PARTS).fit(shown)
    alone = model(**settings, operators=[[CUP, Canonical()]] * 2).fit(shown)
    stacked = [[CUP, Canonical()], [Stack(CUP, TRAY), Canonical()]]
    together = model(**settings, operators=stacked).fit(shown)
    weights = found.operator_weights_
    assert weights.shape == (2, 3) and float(weights[0, 2]) == 1.0  # the tray says nothing
    assert bool((weights[0, :2] < 1).all() and (weights[1] < 1).all())
    for other in (alone, together):
        torch.testing.assert_close(
            other.operator_weights_[0], weights[0, :2], rtol=1e-3, atol=1e-3
        )
    plain = model(**settings | {"operator_weights": "equal"}, operators=IN_PARTS).fit(shown)
    given_time, before = (
        torch.stack([c.covariance for c in one.regression().conditionals], 1)
        for one in (found, plain)
    )
    expected = before / weights[:, :, None, None]
    torch.testing.assert_close(given_time, expected, rtol=1e-8, atol=1e-14)


def test_what_matters_in_every_part_can_have_priority():
    new, gaps = errands(1, seed=7)[0], []
    for priorities in ([1, 0, 0], None):
        one = model(parts=[3.0], operators=IN_PARTS, priorities=priorities).fit(errands())
        [path] = one.predict([Situation(new.joints[0], new.frames, np.linspace(0, 6, 121))])
        gaps.append(float((path.joints - path.candidates[0].mean).abs().max()))
    assert gaps[0] < 0.1 * gaps[1]


def test_folds_find_their_own_parts():
    shown = errands()
    [fold] = fit_folds(model(parts="auto"), shown, [[0, 1, 2, 3]])
    same(fold, model(parts="auto").fit(shown[:4]))


def test_two_hands_and_quaternions_are_served():
    found = hands_model(parts=[0.9]).fit(handlings())
    situation, wanted = new_handling()
    [path] = found.predict([situation])
    assert float((path.joints - wanted).abs().max()) < 0.03
    lists = [[HANDLING[0], Canonical()], [*HANDLING, Canonical()]]
    found = hands_model(parts=[0.9], operators=lists).fit(handlings())
    [path] = found.predict([situation])
    assert float((path.joints - wanted)[15:].abs().max()) < 0.03


def test_what_is_not_in_step_is_told():
    late = errands(shift=0.35)
    with pytest.warns(PlausibilityWarning, match="beginnings of parts"):
        model(parts="auto").fit(late)
    steps = make_pipeline(
        Segmentation(HAND), EventAlignment(["part *"], robot=HAND), model(parts="auto")
    )
    found = steps.fit(late)[-1]
    assert len(found.parts_) == 2


def test_the_union_of_operators_has_each_once():
    both = Stack(CUP, TRAY)
    assert united([[CUP, Canonical()], [Canonical(), TRAY]]) == (CUP, Canonical(), TRAY)
    assert united([[CUP], [both]]) == (both,)
    assert united([[both], [Stack(CUP, TRAY, AbsolutePosition("hand"))]]) == (
        Stack(CUP, TRAY, AbsolutePosition("hand")),
    )


@pytest.mark.parametrize("number", [4, 5, 9, 30])
def test_every_part_has_components_and_all_are_given(number):
    counts = components_of_parts(number, [100, 3, 40, 1])
    assert sum(counts) == number and min(counts) >= 1
    assert counts[0] >= counts[2] >= counts[1]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"parts": [3.0, 2.0]}, DataError, "2 s at 2 s is not after 3 s at 3 s"),
        ({"parts": [7.0]}, DataError, "the end at 6 s is not after 7 s"),
        ({"parts": ["thrown"]}, UnknownNameError, "event 'thrown' is not in"),
        ({"parts": [1, 2, 3], "n_components": 3}, DataError, "4 parts need a component each"),
        ({"parts": [3.0], "operators": [[CUP]]}, DataError, "2 sequences of operators"),
        ({"operators": [[CUP], [TRAY]]}, DataError, "1 parts give operators"),
        ({"parts": [3.0], "warm_start": True}, DataError, "no one state of EM"),
        (
            {"parts": [3.0], "operators": IN_PARTS, "priorities": [0, 0, 1]},
            DataError,
            "matters in part 1, from 0 to 3 s: name it in every part, or give it .* 0",
        ),
    ],
)
def test_what_cannot_be_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        model(**options).fit(errands(3))


def test_batches_are_refused():
    with pytest.raises(DataError, match="parts, operators="):
        canonical(parts=[1.0]).fit([waves(2), waves(2)])


def test_events_say_where_by_name_or_pattern():
    shown = Segmentation().fit(errands()).transform(errands())
    [named] = check_cuts(["part *"], shown)
    assert named == pytest.approx(3.0, abs=0.1)
    assert check_cuts([1, "taken"], shown) == [1.0, 3.0]

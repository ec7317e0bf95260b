"""A skill of several ways: a model for each, the one that suits, and changing it."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from sklearn.base import clone

from tests.support.skills import canonical, handlings, hands_model, new_handling, waves
from tests.support.two_ways import (
    Handles,
    Obstacle,
    another_handle_each,
    fitted,
    reach_of_one_handle,
    shown,
    tip,
)
from tpgmm_torch import (
    Frame,
    ModeSelection,
    MultimodalTaskParameterizedGMM,
    TaskParameterizedGMM,
)
from tpgmm_torch.exceptions import (
    DataError,
    ModelFileError,
    NotFittedError,
    ShapeError,
    UnknownNameError,
)

FAR = "ignore:.*one thing is implausible"  # too far away to reach one of the handles


@pytest.mark.parametrize("task", [Obstacle, Handles])
def test_each_way_succeeds_where_the_mean_of_both_does_not(task):
    situations = task().situations(10, 0)
    single = task().model().set_params(robust=False).fit(shown(task)[0])
    done = {
        name: sum(
            task().succeeded(trajectory, situation)
            for trajectory, situation in zip(
                model.predict(situations, candidates=False), situations, strict=True
            )
        )
        for name, model in (("single", single), ("modes", fitted(task)))
    }
    assert done["modes"] == 10
    assert done["single"] <= 5


def test_one_way_is_the_plain_model_bit_for_bit():
    demonstrations = handlings(4)
    model = MultimodalTaskParameterizedGMM(hands_model()).fit(demonstrations)
    plain = hands_model().fit(demonstrations)
    situation, _ = new_handling()
    assert model.n_modes_ == 1
    [ours], [theirs] = model.predict([situation]), plain.predict([situation])
    assert torch.equal(ours.joints, theirs.joints)
    assert torch.equal(ours.covariance, theirs.covariance)
    assert model.score(demonstrations) == plain.score(demonstrations)
    [choice] = model.choose([situation])
    assert choice.mode == 0 and choice.probabilities == [1.0]
    ours, theirs = (m.controller(situation.joints, situation.frames) for m in (model, plain))
    for _ in range(5):
        ours.step(0.1), theirs.step(0.1)
    assert torch.equal(ours.reference, theirs.reference)


def test_the_order_of_demonstrations_does_not_matter():
    demonstrations, _ = shown(Handles)
    order = np.random.default_rng(1).permutation(len(demonstrations))
    model = fitted(Handles)
    other = clone(model).fit([demonstrations[i] for i in order])
    names = [model.labels_[order][other.labels_ == k][0] for k in range(2)]
    np.testing.assert_allclose(other.weights_, model.weights_[names])
    situations = Handles().situations(3, 0)
    for a, b in zip(model.predict(situations), other.predict(situations), strict=True):
        torch.testing.assert_close(a.joints, b.joints, rtol=0, atol=2e-3)


@pytest.mark.filterwarnings(FAR)
def test_the_mode_is_one_that_the_robot_can_do():
    model, situations = fitted(Handles), reach_of_one_handle(3)
    for situation, choice in zip(situations, model.choose(situations), strict=True):
        each = [
            Handles().succeeded(mode.predict(situation, candidates=False)[0], situation)
            for mode in model.models_
        ]
        assert each[choice.mode] and not each[1 - choice.mode]
        assert choice.misfit[1 - choice.mode] > choice.misfit[choice.mode]
        assert choice.probabilities[choice.mode] > 0.9
        assert str(choice).startswith(f"mode {choice.mode} (mode 0: p = ")
        biased = copy.copy(model)  # what was shown more often does not help the arm to reach
        biased.weights_ = np.where(np.arange(2) == choice.mode, 0.01, 0.99)
        assert biased.choose(situation)[0].mode == choice.mode


def test_the_mode_is_one_that_was_shown_in_situations_like_this():
    """Objects within reach stand as far from the demonstrations of one mode as you like."""
    model, [situation] = fitted(Handles), Handles().situations(1, 5)
    for mode in (0, 1):
        moved = copy.copy(model)
        moved.models_ = [copy.copy(one) for one in model.models_]
        shown_by_it = moved.models_[mode].summary_
        frames = {
            name: replace(
                frame, place=replace(frame.place, mean=[x + 5 for x in frame.place.mean])
            )
            for name, frame in shown_by_it.frames.items()
        }
        moved.models_[mode].summary_ = replace(shown_by_it, frames=frames)
        assert moved.choose(situation)[0].mode == 1 - mode


def test_what_was_chosen_is_reproduced_without_choosing_again():
    model, situations = fitted(Handles), Handles().situations(2, 1)
    choices = model.choose(situations)
    for a, b in zip(
        model.predict(situations), model.predict(situations, choices=choices), strict=True
    ):
        assert torch.equal(a.joints, b.joints)
    other = [replace(choice, mode=1 - choice.mode) for choice in choices]
    for situation, choice, done in zip(
        situations, other, model.predict(situations, choices=other), strict=True
    ):
        [alone] = model.models_[choice.mode].predict(situation)
        torch.testing.assert_close(done.joints, alone.joints)
    with pytest.raises(DataError, match="1 choices for 2 situations"):
        model.predict(situations, choices=choices[:1])
    with pytest.raises(DataError, match=r"the modes \[2\], but there are 2"):
        model.predict(situations[0], choices=[replace(choices[0], mode=2)])


def test_a_saved_model_is_the_same(tmp_path):
    model, situations = fitted(Handles), Handles().situations(2, 1)
    model.save(tmp_path / "model")
    model.save(tmp_path / "model")  # over itself
    again = MultimodalTaskParameterizedGMM.load(tmp_path / "model")
    for a, b in zip(model.predict(situations), again.predict(situations), strict=True):
        assert torch.equal(a.joints, b.joints)
    for a, b in zip(model.choose(situations), again.choose(situations), strict=True):
        assert a.mode == b.mode
        np.testing.assert_array_equal(a.probabilities, b.probabilities)
    np.testing.assert_array_equal(model.labels_, again.labels_)
    assert again.mode_selection_ is None
    again.save(tmp_path / "copy")
    one = TaskParameterizedGMM.load(tmp_path / "model" / "mode_1")
    assert torch.equal(one.weights_, model.models_[1].weights_)
    with pytest.raises(ModelFileError, match="holds a model of several ways"):
        TaskParameterizedGMM.load(tmp_path / "model")


def test_files_that_are_no_such_model_are_refused_and_left_alone(tmp_path):
    model = fitted(Handles)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes").write_text("mine")
    with pytest.raises(ModelFileError, match="no saved model of several ways"):
        model.save(tmp_path / "other")
    assert (tmp_path / "other" / "notes").read_text() == "mine"
    with pytest.raises(ModelFileError, match="is not a saved modes"):
        MultimodalTaskParameterizedGMM.load(tmp_path / "other")
    model.save(tmp_path / "model")
    (tmp_path / "model" / "mode_1" / "config.json").unlink()
    with pytest.raises(ModelFileError, match="mode_1 is not a saved model"):
        MultimodalTaskParameterizedGMM.load(tmp_path / "model")


def test_score_is_that_of_a_mixture():
    model, (demonstrations, _) = fitted(Handles), shown(Handles)
    lengths = np.array([len(one) for one in demonstrations])
    each = np.array([mode.score_samples(demonstrations) for mode in model.models_])
    likeliest = (lengths * each + np.log(model.weights_)[:, None]).max(0) / lengths
    np.testing.assert_allclose(model.score_samples(demonstrations), likeliest, rtol=1e-9)
    assert model.score(demonstrations) > max(m.score(demonstrations) for m in model.models_)


def test_parameters_reach_the_modes():
    model = fitted(Handles)
    assert clone(model).set_params(model__n_components=4).model.n_components == 4
    two = MultimodalTaskParameterizedGMM(model.model, ModeSelection(n_modes=2))
    two.fit(shown(Handles)[0])
    np.testing.assert_array_equal(two.labels_, model.labels_)
    with pytest.raises(NotFittedError):
        clone(model).predict([])


def run(controller, situation, moved=None, at=0.8):
    """References of a skill during which an object is moved; and the largest jump in speed."""
    velocity, largest = torch.zeros(3).double(), 0.0
    for _ in range(90):
        before = moved is None or controller.time < at
        frames = situation.frames if before else moved.frames
        command = controller.step(0.05, controller.reference, frames)
        largest = max(largest, float((command.velocity - velocity).abs().max()))
        velocity = command.velocity
        if controller.finished:
            break
    return largest


@pytest.mark.filterwarnings(FAR)
def test_while_both_are_open_the_way_is_changed_without_a_jump():
    model, switched, gaps = fitted(Handles, 2), 0, []
    for situation, moved in zip(
        Handles().situations(3, 4), reach_of_one_handle(3, 5), strict=True
    ):
        controller = model.controller(situation.joints, situation.frames)
        first = controller.mode
        largest = run(controller, situation, moved)
        plain = [m.controller(situation.joints, situation.frames) for m in model.models_]
        assert largest <= 1.25 * max(run(one, situation, moved) for one in plain)
        gap = tip(controller.reference) - Handles().handles(moved.frames["object"])
        gaps.append(float(gap.norm(dim=-1).min()))
        switched += controller.mode != first
    assert switched >= 1
    assert max(gaps) < 0.015


def test_who_is_left_alone_stays_on_the_way_that_was_chosen():
    model = fitted(Handles)
    for situation in Handles().situations(2, 4):
        controller = model.controller(situation.joints, situation.frames)
        plain = model.models_[controller.mode].controller(situation.joints, situation.frames)
        run(controller, situation), run(plain, situation)
        assert controller.mode == model.choose(situation)[0].mode
        assert torch.equal(controller.reference, plain.reference)


@pytest.mark.parametrize(("seed", "number"), [(100, 15), (214, 23)])
def test_an_unlikely_moment_of_the_way_is_no_reason_to_leave_it(seed, number):
    """Novelty is 1.4 and 1.1: the way itself is less likely there than what was shown."""
    model = fitted(Obstacle, seed)
    situation = Obstacle().situations(50, seed)[number]
    controller = model.controller(situation.joints, situation.frames)
    first, modes = controller.mode, set()
    while not controller.finished:
        controller.step(3 / 59, controller.reference, situation.frames)
        modes.add(controller.mode)
    assert modes == {first}


def test_a_robot_that_is_moved_over_goes_on_the_other_way():
    model, [situation] = fitted(Handles), Handles().situations(1, 6)
    controller = model.controller(situation.joints, situation.frames)
    first = controller.mode
    while controller.time < 2.0:
        controller.step(0.05, controller.reference, situation.frames)
    [over] = model.models_[1 - first].predict(situation, candidates=False)
    there = over.joints[int((over.time - controller.time).abs().argmin())]
    for _ in range(6):
        controller.step(0.05, there, situation.frames)
    assert controller.mode == 1 - first


@pytest.mark.filterwarnings(FAR)
def test_each_robot_of_a_batch_goes_its_own_way():
    model, situations = fitted(Handles), another_handle_each()
    starts = torch.stack([one.joints for one in situations])
    frames = {"object": Frame.stack([one.frames["object"] for one in situations])}
    together = model.controller(starts, frames)
    alone = [model.controller(one.joints, one.frames) for one in situations]
    assert torch.equal(together.reference, starts) and together.command is None
    assert together.modes.tolist() == [1, 0]
    for tick in range(70):
        # each one's time passes by itself
        passed = torch.tensor([0.05, 0.04 if tick % 2 else 0.06]).double()
        told = together.reference.clone()
        told[1, 0] = torch.nan if 20 < tick < 24 else told[1, 0]
        command = together.step(passed, told, frames)
        for robot, one in enumerate(alone):
            wanted = one.step(float(passed[robot]), told[robot], situations[robot].frames)
            for name in ("reference", "velocity", "time", "codes", "covariance", "novelty"):
                assert torch.equal(getattr(command, name)[robot], getattr(wanted, name)), name
            assert command.reason(robot) == wanted.reason()
    assert together.finished == all(one.finished for one in alone)
    assert together.modes.tolist() == [one.mode for one in alone]
    with pytest.raises(ShapeError, match="began with robots of shape"):
        together.step(0.05, starts[:1], frames)
    poses = torch.cat((frames["object"].position, frames["object"].orientation), dim=-1)
    with pytest.raises(ShapeError, match="frame 'object' now has another"):
        together.step(0.05, starts, {"object": poses.expand(3, 2, 7)})


@pytest.mark.filterwarnings(FAR)
def test_who_looks_ahead_stays_on_the_way_and_goes_on_from_there():
    model, situations = fitted(Handles), another_handle_each()
    starts = torch.stack([one.joints for one in situations])
    frames = {"object": Frame.stack([one.frames["object"] for one in situations])}
    one, other = model.controller(starts, frames), model.controller(starts, frames)
    one.step(0.05, starts), other.step(0.05, starts)
    before, ahead, moments = one.reference, one.ahead(), []
    for _ in range(10):
        ahead.step(0.05)
        other.step(0.05, other.reference)
        moments.append(ahead.copy())
        torch.testing.assert_close(ahead.reference, other.reference, rtol=0, atol=1e-9)
    assert torch.equal(one.reference, before)
    one = one.resumed(moments[-1], 0.5, ahead.reference, frames)
    for _ in range(10):
        one.step(0.05, one.reference), other.step(0.05, other.reference)
        torch.testing.assert_close(one.reference, other.reference, rtol=0, atol=1e-9)
    # what is seen counts again: its object is where the other robot's was
    swapped = {"object": frames["object"][[1, 0]]}
    for _ in range(8):
        one.step(0.05, one.reference, swapped), ahead.step(0.05)
    assert one.modes[0] == 0
    assert ahead.modes.tolist() == [1, 0]


def test_joints_that_cannot_be_believed_change_no_way():
    model, [situation] = fitted(Handles), Handles().situations(1, 6)
    [over] = model.models_[1 - model.choose(situation)[0].mode].predict(situation)
    for wrong in (torch.full((3,), torch.nan).double(), over.joints[40]):
        controller = model.controller(situation.joints, situation.frames)
        first = controller.mode
        for tick in range(40):
            # told of every second tick, at which the modes are compared
            told = wrong if tick > 30 and tick % 2 else controller.reference
            controller.step(0.05, told, situation.frames)
        assert controller.mode == first


@pytest.mark.filterwarnings(FAR)
@pytest.mark.parametrize("share", [0.5, 0.7])
def test_who_begins_in_the_middle_goes_on_in_the_way_that_he_is_in(share):
    model = fitted(Obstacle)
    for situation in Obstacle().situations(2, 7):
        for mode, one in enumerate(model.models_):
            [motion] = one.predict(situation, candidates=False)
            there = motion.joints[int(share * len(motion.time))]
            controller = model.controller(
                there, situation.frames, clock="localizing:initial=anywhere"
            )
            assert controller.mode == mode
            first, last = controller.reference, float(one.time_[-1])
            assert float(controller.time) > 0.4 * last
            run(controller, situation)
            assert controller.mode == mode
            gap = tip(controller.reference) - situation.frames["goal"].position
            assert float(gap.norm()) < 0.01 and torch.equal(first, there)


def test_a_model_is_put_together_from_its_ways():
    model = fitted(Handles)
    parts = [model.models_, model.weights_, model.limits_, model.labels_]
    again = MultimodalTaskParameterizedGMM.from_models(*parts)
    [situation] = Handles().situations(1, 3)
    assert torch.equal(again.predict(situation)[0].joints, model.predict(situation)[0].joints)
    assert again.frame_names_ == ("object",) and again.joint_names_ == model.joint_names_
    for place, wrong, message in (
        (0, model.models_[:1], "1 models with 2 weights and 2 limits"),
        (0, [model.models_[0], canonical().fit(waves())], "of different robots"),
        (1, [0.0, 1.0], r"weights positive: got \[0. 1.\]"),
        (2, [1.0, np.nan], r"weights and limits are finite.* \[ 1. nan\]"),
        (3, [0, 2], r"labels \[0, 2\] are no numbers of 2 ways"),
    ):
        given = [*parts[:place], wrong, *parts[place + 1 :]]
        with pytest.raises(DataError, match=message):
            MultimodalTaskParameterizedGMM.from_models(*given)


def test_a_situation_has_to_tell_every_frame():
    model, situation = fitted(Handles), Handles().situations(1, 0)[0]
    with pytest.raises(UnknownNameError, match="object"):
        model.controller(situation.joints)

"""Bad input: every refusal is of its class, and says what was given and what exists."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from sklearn.exceptions import NotFittedError as SklearnNotFittedError
from sklearn.utils._param_validation import InvalidParameterError

from tests.support.skills import (
    HANDS,
    JOINT_NAMES,
    few_bottles,
    handlings,
    hands,
    hands_model,
    pose,
    small_bottle,
    wave,
    waves,
)
from tests.support.worlds import upper_body
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativePosition,
    Robot,
    Situation,
    TaskParameterizedGMM,
)
from tpgmm_torch.exceptions import (
    DataError,
    DegenerateComponentWarning,
    NotFittedError,
    ShapeError,
    TPGMMError,
    UnknownNameError,
)

TIME = torch.linspace(0, 2, 30, dtype=torch.float64)


def canonical(**options) -> TaskParameterizedGMM:
    return TaskParameterizedGMM(**{"n_components": 4, "blend": 0.0, **options})


def refused(call, error, *parts: str) -> None:
    """``call`` raises ``error``, a TPGMMError and a builtin, whose message has all parts."""
    builtin = KeyError if issubclass(error, KeyError) else ValueError
    assert issubclass(error, TPGMMError) and issubclass(error, builtin)
    with pytest.raises(error) as caught:
        call()
    assert type(caught.value) is error
    missing = [part for part in parts if part not in str(caught.value)]
    assert not missing, f"{missing} not in {caught.value}"


# Data


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["time", "joints", "position", "orientation"])
def test_values_that_are_no_numbers_are_refused(bad, where):
    parts = {
        "time": np.linspace(0, 1, 5),
        "joints": np.zeros((5, 3)),
        "position": np.zeros(3),
        "orientation": np.array([1.0, 0, 0, 0]),
    }
    parts[where].flat[-1] = bad
    refused(
        lambda: Demonstration(
            parts["time"],
            parts["joints"],
            {"cup": Frame(parts["position"], parts["orientation"])},
        ),
        DataError,
        where,
        str(bad),
        f"index {[n - 1 for n in parts[where].shape]}",
    )


def test_quaternions_off_unit_norm_are_refused():
    refused(lambda: Frame([0, 0, 0], [1.1, 0, 0, 0]), DataError, "unit quaternion", "0.1")


@pytest.mark.parametrize("times", [[0.0, 1.0, 1.0], [0.0, 2.0, 1.0]])
def test_time_that_does_not_increase_is_refused(times):
    refused(lambda: Demonstration(times, np.zeros((3, 2))), DataError, "increase", "index 2")


def test_wrong_shapes_are_refused():
    refused(lambda: Demonstration(TIME, np.zeros((29, 3))), ShapeError, "30", "(29, 3)")
    refused(lambda: Frame([0.0, 1.0]), ShapeError, "(..., 3)", "(2,)")
    other = Demonstration(TIME, np.zeros((30, 2)))
    refused(lambda: canonical().fit([*waves(names=None), other]), ShapeError, "has 2", "has 3")


@pytest.mark.parametrize("method", ["fit", "score"])
@pytest.mark.parametrize(
    ("given", "parts"),
    [
        (None, ["list", "NoneType"]),
        (7, ["list", "int"]),
        ([], ["empty"]),
        (waves(1)[0], ["[demonstration]"]),
        ([waves(1)[0], 3], ["item 1", "int"]),
        (np.zeros((5, 2)), ["item 0", "ndarray"]),
        ([Situation([0.0, 0.0, 0.0])], ["item 0", "Situation"]),
    ],
    ids=str,
)
def test_what_is_no_list_of_demonstrations_is_refused(method, given, parts):
    model = canonical().fit(waves())
    refused(lambda: getattr(model, method)(given), DataError, *parts)


def test_other_joint_names_are_refused():
    others = [*waves(2), replace(waves(1)[0], joint_names=("a", "b", "z"))]
    named = "demonstration 2", "('a', 'b', 'z')", "('a', 'b', 'c')"
    refused(lambda: canonical().fit(others), DataError, *named)
    model = canonical().fit(waves())
    refused(lambda: model.predict(others[2:]), UnknownNameError, "joint 'c'", "'z'")


def test_nameless_demonstrations_are_trusted_and_never_hide_an_order():
    nameless, [first] = waves(2, names=None), waves(1)
    turned = replace(first, joints=first.joints[:, [2, 1, 0]], joint_names=("c", "b", "a"))
    mixed = canonical().fit([nameless[0], first, turned])
    assert mixed.kinematics_.joint_names == JOINT_NAMES
    same = canonical().fit([nameless[0], first, first])
    assert torch.equal(mixed.means_[0], same.means_[0])


def test_other_frames_are_refused():
    strange = replace(handlings(1)[0], frames={"mug": Frame([0, 0, 0])})
    refused(lambda: hands_model().fit([*handlings(), strange]), DataError, "mug", "cup")


# Operators and robots


def test_unknown_frames_are_named():
    model = hands_model(operators=[pose("left", "mug")])
    refused(lambda: model.fit(handlings()), UnknownNameError, "frame 'mug'", "['cup']")


def test_unknown_links_are_named():
    model = hands_model(operators=[pose("middle", "cup")])
    refused(
        lambda: model.fit(handlings()), UnknownNameError, "link 'middle'", "['left', 'right']"
    )
    refused(
        lambda: Robot.from_urdf(upper_body_urdf(), links=("third_hand",)),
        UnknownNameError,
        "third_hand",
        "l_hand",
    )


def test_names_of_links_and_frames_may_not_collide():
    both = [replace(d, frames={"left": d.frames["cup"]}) for d in handlings()]
    model = hands_model(operators=[pose("right", "left")])
    refused(lambda: model.fit(both), UnknownNameError, "'left'", "rename the frame")


def test_joints_missing_in_the_urdf_are_named():
    refused(
        lambda: Robot.from_urdf(upper_body_urdf(), links=("l_hand",), joints=("tail",)),
        UnknownNameError,
        "joint 'tail'",
        "l_elbow",
    )


def test_demonstrations_of_another_robot_are_refused():
    model = TaskParameterizedGMM(3, [Canonical()], upper_body())
    refused(lambda: model.fit(waves(names=None)), ShapeError, "has 3 joints", "has 17")
    refused(lambda: model.fit(waves()), ShapeError, "has 3 joints", "17", "waist_yaw")
    demonstration = few_bottles()[0]
    names = tuple(f"{name}_" for name in demonstration.joint_names)
    renamed = replace(demonstration, joint_names=names)
    refused(lambda: model.fit([renamed]), UnknownNameError, "is not in", "waist_yaw_")


def test_a_robot_that_is_missing_is_asked_for():
    model = TaskParameterizedGMM(3, [RelativePosition("left", "cup")])
    refused(lambda: model.fit(handlings()), DataError, "['left']", "Robot.from_urdf", "Poses(")


@pytest.mark.parametrize("operators", [["Canonical"], [Canonical], [Canonical(), None]])
def test_operators_that_are_none_are_named(operators):
    refused(
        lambda: canonical(operators=operators).fit(waves()),
        DataError,
        "Operator objects",
        repr(operators[-1]),
    )


BAD = {
    "n_components": [0, -3, 2.5, "ten", None],
    "operators": [Canonical(), "Canonical", 3],
    "robot": ["robot.urdf", 3],
    "covariance_type": ["block", None],
    "reg_covar": [-1e-6, "small"],
    "tol": [-1.0],
    "max_iter": [0, 1.5],
    "n_init": [0],
    "init_params": ["zeros"],
    "responsibilities": ["shared"],
    "fusion": ["product"],
    "activation": ["space"],
    "epsilon": [-1e-4],
    "prior_std": [0.0, -1.0],
    "negligible": [-1e-9, 1.0],
    "blend": [-0.1],
    "keep_limits": ["yes", 2],
    "random_state": ["seed", -1],
    "warm_start": ["no"],
    "dtype": ["float16", torch.float32],
    "device": [3],
    "verbose": [-1, "loud"],
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in BAD.items() for value in values]
)
def test_bad_parameters_are_refused_when_fitting(name, value):
    assert set(BAD) == set(TaskParameterizedGMM().get_params())
    with pytest.raises(InvalidParameterError, match=f"'{name}' parameter") as caught:
        canonical(**{name: value}).fit(waves())
    assert isinstance(caught.value, ValueError)


# Too little data


def test_fewer_points_than_components_are_refused():
    few = [Demonstration(TIME[:5], wave(TIME[:5]))]
    refused(lambda: canonical(n_components=6).fit(few), DataError, "6", "5")


def test_more_components_than_instants_are_reported_or_refused():
    few = [Demonstration(TIME[:5], wave(TIME[:5], shift)) for shift in (0.0, 0.1, 0.2)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises((DataError, DegenerateComponentWarning)):
            canonical(n_components=9).fit(few)


def test_one_instant_is_not_enough():
    one = [Demonstration(TIME[:1], wave(TIME[:1]))]
    with pytest.raises(ValueError, match="1 sample"):
        canonical(n_components=1).fit(one)


def test_instants_need_a_common_grid():
    uneven = [*waves(2), *waves(1, length=25)]
    model = canonical(responsibilities="instant")
    refused(lambda: model.fit(uneven), DataError, "'instant'", "time grid", "align")


# Asking a model


@pytest.mark.parametrize(
    "ask",
    [
        lambda m: m.predict([Situation([0.0, 0.0, 0.0])]),
        lambda m: m.step(0.0, [0.0, 0.0, 0.0]),
        lambda m: m.sample(Situation([0.0, 0.0, 0.0])),
        lambda m: m.score(waves()),
        lambda m: m.score_samples(waves()),
        lambda m: m.bic(waves()),
        lambda m: m.aic(waves()),
        lambda m: m.save("nowhere"),
    ],
    ids=["predict", "step", "sample", "score", "score_samples", "bic", "aic", "save"],
)
def test_an_unfitted_model_says_so(ask):
    refused(lambda: ask(canonical()), NotFittedError, "not fitted yet", "fit(demonstrations)")
    assert issubclass(NotFittedError, SklearnNotFittedError)


def start(**frames: Frame) -> Situation:
    return Situation(handlings(1)[0].joints[0], frames)


def test_situations_without_the_frame_are_refused():
    refused(lambda: hands().predict([start()]), UnknownNameError, "frame 'cup'", "[]")
    mug = start(mug=Frame([0, 0, 0]))
    refused(lambda: hands().predict([mug]), UnknownNameError, "frame 'cup'", "['mug']")
    refused(lambda: hands().step(0.0, start().joints, {}), UnknownNameError, "'cup'", "'left'")


def test_frames_that_move_need_the_model_s_grid():
    moving = start(cup=Frame(np.zeros((7, 3))))
    refused(lambda: hands().predict([moving]), ShapeError, "'cup'", "(7,)", "(30,)")


def test_start_postures_of_other_robots_are_refused():
    cup = {"cup": Frame([0, 0, 0])}
    refused(
        lambda: hands().predict([Situation(np.zeros(3), cup)]), ShapeError, "3 joints", "14"
    )
    refused(lambda: hands().step(0.0, np.zeros(3), cup), ShapeError, "(..., 14)", "(3,)")
    nan = np.full(17, np.nan)
    refused(lambda: small_bottle().step(0.0, nan, cup), DataError, "NaN")
    refused(lambda: Situation(nan, cup), DataError, "start posture", "NaN")


@pytest.mark.parametrize("given", [None, 3, [None], [np.zeros(3)], "situation"])
def test_what_is_no_situation_is_refused(given):
    model = canonical().fit(waves())
    refused(lambda: model.predict(given), DataError, "Situation")


@pytest.mark.parametrize("now", [np.nan, np.inf])
def test_times_that_are_no_numbers_are_refused(now):
    model = canonical().fit(waves())
    refused(lambda: model.step(now, np.zeros(3)), DataError, "time", str(now))


@pytest.mark.parametrize("n_samples", [0, -1, 2.5, "many"])
def test_numbers_of_samples_that_are_none_are_refused(n_samples):
    model = canonical().fit(waves())
    refused(lambda: model.sample(Situation(np.zeros(3)), n_samples), DataError, repr(n_samples))


def test_poses_have_all_their_columns():
    narrow = [replace(d, joints=d.joints[:, :7], joint_names=None) for d in handlings()]
    refused(lambda: hands_model().fit(narrow), ShapeError, "has 7 joints", "14")
    assert HANDS.n_joints == 14

"""The estimator: what it learns from demonstrations."""

import copy
import inspect
import pickle
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal, multivariate_t, norm
from sklearn.base import clone
from sklearn.exceptions import NotFittedError as SklearnNotFittedError
from sklearn.model_selection import GridSearchCV, KFold
from sklearn.utils.validation import check_is_fitted

from tests.support import oracles, refusals, skills
from tests.support.carrying import (
    PLACES,
    at_first,
    carries,
    carrying_model,
    held_carries,
    operators,
)
from tests.support.mixtures import CASES
from tests.support.skills import (
    HANDLING,
    HANDS,
    JOINT_NAMES,
    LAST,
    apart,
    bottle,
    bottle_demonstrations,
    bottle_model,
    canonical,
    few_bottles,
    handlings,
    hands,
    hands_model,
    new_handling,
    pose,
    same,
    small_bottle,
    tensors,
    wave,
    waves,
)
from tests.support.worlds import MOVED, OBJECT, OnPoses, OnRobot, moved, upper_body
from tpgmm_control import Controller
from tpgmm_control.loop.rollout import rollout
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    Hold,
    RelativePosition,
    Situation,
    TaskParameterizedGMM,
    save,
)
from tpgmm_torch.exceptions import (
    DataError,
    InvalidParameterError,
    NotFittedError,
    PlausibilityWarning,
    ShapeError,
    UnknownNameError,
)
from tpgmm_torch.metrics import reproduction_scorer
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.motion.demonstrated_peaks import joint_peaks, typical_peaks
from tpgmm_torch.persistence import load_model
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, InformationFusion
from tpgmm_torch.robots.kinematics import JointSpace
from tpgmm_torch.training.hold_detection import with_holds
from tpgmm_torch.training.local_data import local_data


def test_without_operators_and_robot_it_learns_the_joints():
    model = canonical().fit(waves())
    assert model.operators_ == (Canonical(),)
    assert model.kinematics_ == JointSpace(skills.JOINT_NAMES)
    [trajectory] = model.predict([Situation([0.0, 1.0, 0.0])])
    assert trajectory.joint_names == skills.JOINT_NAMES
    assert apart(trajectory.joints, wave(trajectory.time)) < 0.08  # 0.057 measured


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_the_grid_is_that_of_the_demonstration_of_median_duration():
    short, middle, long = (
        Demonstration(torch.linspace(0, end, 20), torch.rand(20, 1)) for end in (1.0, 2.0, 5.0)
    )
    assert torch.equal(canonical().fit([long, middle, short]).time_, middle.time.double())


@pytest.mark.parametrize("moves", [False, True], ids=["standing", "moving"])
def test_hands_are_reproduced_about_a_cup_never_seen(moves):
    model = hands_model(n_components=10).fit(handlings(moves=moves))
    situation, wanted = new_handling(moves)
    [trajectory] = model.predict([situation])
    assert apart(trajectory.joints, wanted) < 2e-3  # 0.8e-3 measured; noise of 1e-3
    [seen] = model.predict(handlings(moves=moves)[:1])
    assert apart(seen.joints, handlings(moves=moves)[0].joints) < 3e-3  # 1.2e-3 measured


def test_a_bottle_never_seen_is_grasped():
    situations = skills.generator().situations(8, seed=99)
    trajectories = skills.bottle().predict(situations, candidates=False)
    event = skills.bottle_demonstrations()[0].events["grasp"]
    at = int(torch.searchsorted(trajectories[0].time, event))
    for trajectory, situation in zip(trajectories, situations, strict=True):
        position, turn = skills.generator().grasp_error(
            trajectory.joints[at], situation.frames["bottle"]
        )
        assert float(position) < 2e-3  # at most 0.43 mm measured
        assert float(turn) < np.radians(1)


def test_instants_are_learned_by_the_mixture_of_groups():
    model = hands_model(covariance_shrinkage=0).fit(handlings(3))
    rows = local_data(handlings(3), HANDLING, HANDS)
    interleaved = torch.stack([row[t] for t in range(30) for row in rows]).numpy()
    assert model.mixture_.group_size == 3
    mixture = BlockGaussianMixture(**model.mixture_.get_params()).fit(interleaved)
    same(model, mixture, 1e-8)


def test_different_grids_are_learned_point_by_point():
    uneven = [*waves(2), *waves(1, length=25)]
    model = canonical().fit(uneven)
    assert model.mixture_.group_size == 1
    same(model, canonical(responsibilities="point").fit(uneven))


def test_the_same_random_state_gives_the_same_model():
    models = [canonical(init_params="random", random_state=n, tol=0.1) for n in (3, 3, 4)]
    fits = [model.fit(waves()) for model in models]
    same(fits[0], fits[1])
    assert not torch.equal(fits[0].means_[0], fits[2].means_[0])


def test_order_of_joints_does_not_matter():
    order = (2, 0, 1)
    names = tuple(skills.JOINT_NAMES[i] for i in order)
    shuffled = [
        replace(item, joints=item.joints[:, order], joint_names=names) for item in waves()
    ]
    model = canonical().fit(waves())
    same(canonical().fit([waves()[0], *shuffled[1:]]), model)
    on_robot = canonical(robot=JointSpace(skills.JOINT_NAMES)).fit(shuffled)
    same(on_robot, model)
    assert on_robot.score(shuffled) == model.score(waves())
    [a], [b] = on_robot.predict(shuffled[:1]), model.predict(waves()[:1])
    assert torch.equal(a.joints, b.joints)


def test_single_precision_agrees_with_double():
    operators = [*HANDLING, Canonical()]
    double, single = (
        hands_model(operators=operators, dtype=name).fit(handlings())
        for name in ("float64", "float32")
    )
    assert {t.dtype for t in (single.weights_, *single.means_)} == {torch.float32}
    [wanted], [found] = double.predict(handlings()[:1]), single.predict(handlings()[:1])
    assert found.joints.dtype == found.covariance.dtype == torch.float32
    assert apart(found.joints, wanted.joints) < 2e-3
    assert single.score(handlings()) == pytest.approx(double.score(handlings()), rel=1e-2)


def test_nothing_given_is_modified():
    demonstrations, (situation, _) = handlings(moves=True), new_handling(moves=True)
    state = situation.joints.clone()
    given = [*demonstrations, situation]
    before, raw = tensors(given), state.clone()
    model = hands_model().fit(demonstrations)
    model.predict([situation, demonstrations[0]])
    model.score(demonstrations)
    model.sample(situation, 2, random_state=0)
    model.step(0.3, state, {"cup": situation.frames["cup"][4]})
    assert all(torch.equal(a, b) for a, b in zip(before, tensors(given), strict=True))
    assert torch.equal(state, raw)


def test_coordinates_that_vary_by_rounding_alone_do_not_become_certain():
    # a cup and hands that turn about one axis: two of the quaternions' columns are rounding
    rng = np.random.default_rng(0)
    exact = handlings()
    noisy = [
        replace(item, joints=item.joints + 1e-17 * torch.from_numpy(rng.standard_normal(14)))
        for item in exact
    ]
    model = hands_model(operators=[HANDLING[0], Canonical()]).fit(noisy)
    deviations = model.covariances_[0].diagonal(dim1=1, dim2=2).sqrt()
    assert float(deviations.min()) > 1e-7


TIME = torch.linspace(0, 2, 30, dtype=torch.float64)


def joints_only(**options) -> TaskParameterizedGMM:
    return TaskParameterizedGMM(**{"n_components": 4, **options})


def refused(call, error, *parts: str) -> None:
    """Hold that the message has all parts, to the letter."""
    refusals.refused(call, error, *map(re.escape, parts))


# Data


def changed(**fields) -> list[Demonstration]:
    return [replace(one, **fields) for one in handlings()]


def on_robot() -> TaskParameterizedGMM:
    return TaskParameterizedGMM(3, [Canonical()], upper_body())


def carrier(**settings) -> TaskParameterizedGMM:
    return clone(carrying_model()).set_params(**settings)


MUG, CUP, LEFT = ({name: Frame([0, 0, 0])} for name in ("mug", "cup", "left"))
NARROW = {"joints": np.tile(np.eye(7)[3], (30, 1))}
REFUSED_BY_FIT = [  # a model and what it cannot learn from
    (lambda: (joints_only(), [*waves(names=None), Demonstration(TIME, np.zeros((30, 2)))]),
     ShapeError, ["has 2", "has 3"]),
    (lambda: (hands_model(), [*handlings(), changed(frames=MUG)[0]]),
     DataError, ["mug", "cup"]),
    (lambda: (hands_model(operators=[pose("left", "mug")]), handlings()),
     UnknownNameError, ["frame 'mug'", "['cup']"]),
    (lambda: (hands_model(operators=[pose("middle", "cup")]), handlings()),
     UnknownNameError, ["link 'middle'", "['cup', 'left', 'right']"]),
    (lambda: (hands_model(operators=[pose("right", "left")]), changed(frames=LEFT)),
     UnknownNameError, ["'left'", "rename the frame"]),
    (lambda: (hands_model(), changed(**NARROW, joint_names=None)),
     ShapeError, ["has 7 joints", "14"]),
    (lambda: (on_robot(), waves(names=None)), ShapeError, ["has 3 joints", "has 17"]),
    (lambda: (on_robot(), waves()), UnknownNameError, ["is not in the demonstration"]),
    (lambda: (TaskParameterizedGMM(3, [RelativePosition("left", "cup")]), handlings()),
     DataError, ["['left']", "Robot.from_urdf", "Poses("]),
    (lambda: (joints_only(operators=["Canonical"]), waves()),
     DataError, ["Operator objects", "'Canonical'"]),
    (lambda: (joints_only(operators=[Canonical(), None]), waves()),
     DataError, ["Operator objects", "None"]),
    (lambda: (joints_only(n_components=6), [Demonstration(TIME[:5], wave(TIME[:5]))]),
     DataError, ["6", "5"]),
    (lambda: (joints_only(responsibilities="instant"), [*waves(2), *waves(1, length=25)]),
     DataError, ["'instant'", "time grid", "align"]),
    (lambda: (carrier(), with_holds(carries(), [Hold("cup", "l_hand")])),
     UnknownNameError, ["frame 'cup'", "['bottle', 'tray']"]),
    (lambda: (carrier(), with_holds(carries(), [Hold("tray", "tail")])),
     UnknownNameError, ["link 'tail'", "['l_hand', 'r_hand']"]),
    (lambda: (carrier(), with_holds(carries(), ["bottle@l_hand"])), DataError, ["Hold.parse"]),
    (lambda: (carrier(fusion=CovarianceFusion()), held_carries()),
     DataError, ["['bottle']", "InformationFusion"]),
    (lambda: (carrier(operators=operators(["pose:cup@tray"])), held_carries()),
     UnknownNameError, ["link 'cup' is not in the robot or the frames"]),
]  # fmt: skip


@pytest.mark.parametrize(("given", "error", "parts"), REFUSED_BY_FIT)
@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_what_a_model_cannot_learn_from_is_refused(given, error, parts):
    def fit():
        model, shown = given()
        model.fit(shown)

    refused(fit, error, *parts)


@pytest.mark.parametrize("method", ["fit", "score"])
@pytest.mark.parametrize(("given", "parts"), [
    (None, ["list", "NoneType"]),
    (7, ["list", "int"]),
    ([], ["empty"]),
    (waves(1)[0], ["[demonstration]"]),
    ([waves(1)[0], 3], ["item 1", "int"]),
    (np.zeros((5, 2)), ["item 0", "ndarray"]),
    ([Situation([0.0, 0.0, 0.0])], ["item 0", "Situation"]),
], ids=str)  # fmt: skip
def test_what_is_no_list_of_demonstrations_is_refused(method, given, parts):
    model = joints_only().fit(waves())
    refused(lambda: getattr(model, method)(given), DataError, *parts)


def test_other_joint_names_are_refused():
    others = [*waves(2), replace(waves(1)[0], joint_names=("a", "b", "z"))]
    named = "demonstration 2", "('a', 'b', 'z')", "('a', 'b', 'c')"
    refused(lambda: joints_only().fit(others), DataError, *named)
    model = joints_only().fit(waves())
    refused(lambda: model.predict(others[2:]), UnknownNameError, "joint 'c'", "'z'")


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_nameless_demonstrations_are_trusted_and_never_hide_an_order():
    nameless, [first] = waves(2, names=None), waves(1)
    turned = replace(first, joints=first.joints[:, [2, 1, 0]], joint_names=("c", "b", "a"))
    mixed = joints_only().fit([nameless[0], first, turned])
    assert mixed.kinematics_.joint_names == JOINT_NAMES
    same = joints_only().fit([nameless[0], first, first])
    assert torch.equal(mixed.means_[0], same.means_[0])


# Operators and robots


BAD = {
    "n_components": [0, -3, 2.5, "ten", None],
    "operators": [Canonical(), "Canonical", 3],
    "robot": ["robot.urdf", 3],
    "covariance_type": ["block", None],
    "reg_covar": [-1e-6, "small"],
    "covariance_shrinkage": [-0.1, 1.1, "oas", None],
    "tol": [-1.0],
    "max_iter": [0, 1.5],
    "n_init": [0],
    "init_params": ["zeros"],
    "responsibilities": ["shared"],
    "fusion": ["information", 1],
    "random_state": ["seed", -1],
    "dtype": ["float16", torch.float32],
    "device": [3],
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in BAD.items() for value in values]
)
def test_bad_parameters_are_refused_when_fitting(name, value):
    assert set(BAD) == set(TaskParameterizedGMM().get_params())
    wrong = joints_only(**{name: value})
    refused(lambda: wrong.fit(waves()), InvalidParameterError, f"'{name}' parameter")


# Too little data


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_one_instant_is_not_enough():
    one = [Demonstration(TIME[:1], wave(TIME[:1]))]
    refused(lambda: joints_only(n_components=1).fit(one), ValueError, "1 sample")


# Asking a model


@pytest.mark.parametrize("ask", [
    lambda m: m.predict([Situation([0.0, 0.0, 0.0])]),
    lambda m: m.step(0.0, [0.0, 0.0, 0.0]),
    lambda m: m.sample(Situation([0.0, 0.0, 0.0])),
    lambda m: m.score(waves()),
    lambda m: m.score_samples(waves()),
    lambda m: m.skill,
    lambda m: save(m, "nowhere"),
], ids=["predict", "step", "sample", "score", "score_samples", "skill", "save"])  # fmt: skip
def test_an_unfitted_model_says_so(ask):
    refused(lambda: ask(joints_only()), NotFittedError, "not fitted yet", "fit(demonstrations)")
    assert issubclass(NotFittedError, SklearnNotFittedError)


def start(**frames: Frame) -> Situation:
    return Situation(handlings(1)[0].joints[0], frames)


NAN = np.full(17, np.nan)
REFUSED_WHEN_ASKED = [
    (lambda: hands().predict([start()]), UnknownNameError, ["frame 'cup'", "[]"]),
    (lambda: hands().predict([start(**MUG)]), UnknownNameError, ["frame 'cup'", "['mug']"]),
    (lambda: hands().step(0.0, start().joints, {}), UnknownNameError, ["'cup'", "'left'"]),
    (lambda: hands().predict([start(cup=Frame(np.zeros((7, 3))))]),
     ShapeError, ["'cup'", "(7,)", "(30,)"]),
    (lambda: hands().predict([Situation(np.zeros(3), CUP)]), ShapeError, ["3 joints", "14"]),
    (lambda: hands().step(0.0, np.zeros(3), CUP), ShapeError, ["(..., 14)", "(3,)"]),
    (lambda: small_bottle().step(0.0, NAN, CUP), DataError, ["NaN"]),
    *((lambda given=given: hands().predict(given), DataError, ["Situation"])
      for given in (None, 3, [None], [np.zeros(3)], "situation")),
    *((lambda now=now: hands().step(now, start().joints, CUP), DataError, ["time", str(now)])
      for now in (np.nan, np.inf)),
    *((lambda n=n: hands().sample(start(**CUP), n), DataError, [repr(n)])
      for n in (0, -1, 2.5, "many")),
]  # fmt: skip


@pytest.mark.parametrize(("ask", "error", "parts"), REFUSED_WHEN_ASKED)
def test_what_a_model_cannot_answer_is_refused(ask, error, parts):
    refused(ask, error, *parts)


def test_a_demonstration_s_own_time_is_not_taken_along():
    [shown] = handlings(1, moves=True)
    half = len(shown) // 2
    cut = Demonstration(
        shown.time[:half] * 1.7,
        shown.joints[:half],
        {"cup": shown.frames["cup"][:half]},
        shown.joint_names,
    )
    [found], [same] = hands().predict(cut), hands().predict(Situation.of(cut))
    assert torch.equal(found.time, hands().time_)
    assert torch.equal(found.joints, same.joints)
    # the cup moves when it did, and stands still where no more is known
    cup = cut.frames["cup"].resample(cut.time, hands().time_)
    [expected] = hands().predict(Situation(cut.joints[0], {"cup": cup}, hands().time_))
    torch.testing.assert_close(found.joints, expected.joints, rtol=0, atol=1e-12)


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_what_lies_beyond_the_skill_is_held():
    longer = torch.cat((hands().time_, LAST + torch.tensor([0.1, 1.0, 10.0]).double()))
    [shown] = handlings(1)
    [own], [found] = hands().predict(shown), hands().predict(Situation.of(shown, longer))
    assert torch.equal(found.time, longer)
    torch.testing.assert_close(found.joints[:30], own.joints, rtol=0, atol=1e-12)
    assert torch.equal(found.joints[30:], found.joints[29:30].expand(3, -1))
    shares = found.candidates[0].share
    torch.testing.assert_close(shares[31:], shares[30:31].expand(2, -1))


def test_joints_of_a_situation_go_by_name():
    [shown] = handlings(1)
    named = dict(zip(HANDS.joint_names, shown.joints[0].tolist(), strict=True))
    shuffled = dict(sorted(named.items())) | {"wheel": 3.0}
    [expected] = hands().predict(shown)
    [found] = hands().predict(Situation(shuffled, shown.frames))
    assert torch.equal(found.joints, expected.joints)
    shuffled.pop("left.qw")
    refused(
        lambda: hands().predict(Situation(shuffled, shown.frames)),
        UnknownNameError, "joint 'left.qw'", "the situation", "'left.qx'",
    )  # fmt: skip


def test_a_model_of_known_parameters_takes_arrays():
    model, [shown] = hands(), handlings(1)
    known = TaskParameterizedGMM.from_parameters(
        model.weights_.numpy(),
        [mean.tolist() for mean in model.means_],
        [covariance.numpy() for covariance in model.covariances_],
        model.time_.numpy(),
        operators=model.operators_,
        robot=HANDS,
    )
    assert torch.equal(known.predict(shown)[0].joints, model.predict(shown)[0].joints)
    assert known.summary_ is None  # nor how many demonstrations there were
    normal = copy.copy(model).set_params(covariance_shrinkage=0)
    assert known.score([shown]) == normal.score([shown])
    assert (known.n_iter_, known.n_components) == (0, 6)
    refused(
        lambda: TaskParameterizedGMM.from_parameters(
            [np.nan], [np.zeros((1, 2))], [np.eye(2)[None]], [0.0], robot=JointSpace(["a"])
        ),
        DataError, "weights", "NaN",
    )  # fmt: skip


SETTINGS = {
    "n_components": 7,
    "operators": [Canonical()],
    "robot": HANDS,
    "covariance_type": "tied",
    "reg_covar": 1e-3,
    "covariance_shrinkage": 0.25,
    "tol": 1e-2,
    "max_iter": 50,
    "n_init": 2,
    "init_params": "kmeans",
    "responsibilities": "point",
    "fusion": CovarianceFusion(1e-5, "product"),
    "random_state": 1,
    "dtype": "float32",
    "device": "cpu",
}


def test_settings_of_em_reach_the_mixture():
    others = (
        "operators", "robot", "reg_covar", "covariance_shrinkage", "responsibilities", "fusion",
        "device",
    )  # fmt: skip
    settings = {name: value for name, value in SETTINGS.items() if name not in others}
    given = TaskParameterizedGMM(**settings).fit(waves()).mixture_.get_params()
    assert {name: given[name] for name in settings} == settings


def search(grid, **options) -> GridSearchCV:
    return GridSearchCV(hands_model(), grid, cv=KFold(2), error_score="raise", **options)


def test_the_constructor_only_stores():
    assert set(SETTINGS) == set(inspect.signature(TaskParameterizedGMM).parameters)
    model = TaskParameterizedGMM(**SETTINGS)
    assert set(vars(model)) == set(SETTINGS)
    assert all(vars(model)[name] is value for name, value in SETTINGS.items())
    nonsense = {name: object() for name in SETTINGS}
    assert vars(TaskParameterizedGMM(**nonsense)) == nonsense


def test_fitting_changes_no_parameter():
    model = hands_model()
    before = dict(model.get_params())
    model.fit(handlings())
    assert all(model.get_params()[name] is value for name, value in before.items())
    check_is_fitted(model)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
@pytest.mark.parametrize("model", [small_bottle, hands], ids=["robot", "poses"])
def test_copies_answer_the_same(copied, model):
    model = model()
    given = few_bottles()[:1] if model is small_bottle() else handlings()[:1]
    other = copied(model)
    [a], [b] = model.predict(given), other.predict(given)
    assert torch.equal(a.joints, b.joints)
    assert torch.equal(a.candidates[0].covariance, b.candidates[0].covariance)
    assert other.score(given) == model.score(given)
    assert other.operators == model.operators and other.robot == model.robot


def test_a_new_fit_replaces_the_old_model():
    model = copy.deepcopy(hands())
    model.predict(handlings()[:1])
    model.set_params(n_components=3).fit(handlings())
    [a] = model.predict(handlings()[:1])
    [b] = hands_model(n_components=3).fit(handlings()).predict(handlings()[:1])
    assert torch.equal(a.joints, b.joints)


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_operators_are_searched_by_the_error_of_reproduction():
    choices = [[HANDLING[0], HANDLING[1]], [Canonical()]]
    found = search({"operators": choices}, scoring=reproduction_scorer).fit(handlings())
    # joints alone cannot follow the cup
    assert found.best_params_["operators"] == choices[0]
    about_the_cup, alone = found.cv_results_["mean_test_score"]
    assert alone < 10 * about_the_cup < 0


def test_it_says_that_samples_are_no_rows():
    tags = TaskParameterizedGMM().__sklearn_tags__()
    assert tags.input_tags.two_d_array is False
    assert tags.target_tags.required is False


@pytest.mark.parametrize(
    "fusion",
    [InformationFusion(negligible=0.0), CovarianceFusion(), CovarianceFusion(1e-4, "product")],
    ids=["information", "covariance", "product"],
)
def test_a_fitted_model_answers_as_table_i_says(fusion):
    model = bottle_model(8, tol=1e-2, fusion=fusion)
    model.fit(few_bottles())
    demonstration = few_bottles()[1]
    state = model.kinematics_.state(demonstration.joints[12])
    at = OnRobot().at(state, {OBJECT: demonstration.frames["bottle"]})
    mixtures = [
        oracles.Local(mean.numpy(), covariance.numpy())
        for mean, covariance in zip(model.means_, model.covariances_, strict=True)
    ]
    # four demonstrations let the joints give way
    mixtures[1] = oracles.with_wider_rest(mixtures[1], np.full(len(at.joints), 5 / 3))
    # the oracle knows no signs of quaternions
    here = model.operators_[0].coordinates(state, demonstration.frames)
    for start in (3, 10):
        assert bool((model.means_[0][:, 1:][:, start : start + 4] @ here[start:][:4] > 0).all())
    answer = oracles.regress(
        float(demonstration.time[12]),
        at.joints,
        CASES["the paper's"].rows(at),
        mixtures,
        model.weights_.numpy(),
        activation=getattr(fusion, "activation", "time"),
        epsilon=getattr(fusion, "epsilon", None),
    )
    estimate = model.step(
        demonstration.time[12], state, {"bottle": demonstration.frames["bottle"]}
    )
    assert apart(estimate.joints, torch.from_numpy(answer.mean)) < 1e-5
    assert apart(estimate.activation, torch.from_numpy(answer.activation)) < 1e-5


def test_joints_of_few_demonstrations_give_way():
    model = small_bottle()
    assert model.skill.n_samples == 4
    # who says how covariances are shrunk is taken at the word
    for number in (0, 0.1):
        said = bottle_model(4, tol=1e-1, covariance_shrinkage=number).fit(few_bottles())
        assert said.skill.n_samples is None


def test_predict_is_step_after_step():
    model = small_bottle()
    demonstration = few_bottles()[2]
    [trajectory] = rollout(model.skill, [demonstration], candidates=True)
    joints = demonstration.joints[0]
    for k, now in enumerate(trajectory.time):
        estimate = model.step(now, joints, demonstration.frames, candidates=True)
        joints = estimate.joints
        torch.testing.assert_close(trajectory.joints[k], joints, rtol=0, atol=1e-9)
        for whole, one in zip(trajectory.candidates, estimate.candidates, strict=True):
            torch.testing.assert_close(whole.mean[k], one.mean, rtol=0, atol=1e-8)


def test_a_batch_of_robots_steps_as_each_of_them():
    model, batch = small_bottle(), few_bottles()
    joints = torch.stack([item.joints[9] for item in batch])
    frames = [item.frames["bottle"] for item in batch]
    together = Frame(
        torch.stack([f.position for f in frames]), torch.stack([f.orientation for f in frames])
    )
    times = torch.tensor([2.0, 2.5, 3.0, 3.5], dtype=torch.float64)
    estimate = model.step(times, joints, {"bottle": together}, candidates=True)
    for i in range(4):
        single = model.step(times[i], joints[i], {"bottle": frames[i]})
        torch.testing.assert_close(estimate.joints[i], single.joints, rtol=0, atol=1e-7)


def test_moving_the_world_moves_the_reproduction():
    world = OnPoses()
    there = [
        replace(
            item,
            joints=world.moved_answer(item.joints),
            frames={name: moved(frame) for name, frame in item.frames.items()},
        )
        for item in handlings()
    ]
    situation, _ = new_handling()
    elsewhere = Situation(
        world.moved_answer(situation.joints),
        {"cup": moved(situation.frames["cup"])},
        situation.time,
    )
    assert apart(MOVED.position, torch.zeros(3)) > 0.5
    [here] = hands().predict([situation])
    [there] = hands_model().fit(there).predict([elsewhere])
    torch.testing.assert_close(there.joints, world.moved_answer(here.joints), rtol=0, atol=1e-6)


def test_signs_of_recorded_quaternions_mean_nothing():
    flipped = [
        replace(
            item,
            joints=OnPoses().flipped_answer(item.joints),
            frames={n: Frame(f.position, -f.orientation) for n, f in item.frames.items()},
        )
        for item in handlings()
    ]
    model = hands()
    np.testing.assert_allclose(
        model.score_samples(flipped), model.score_samples(handlings()), rtol=1e-9
    )
    mixed = hands_model().fit([*handlings()[:2], *flipped[2:]])
    same(mixed, model, 1e-9)
    [a], [b] = model.predict(flipped[:1]), model.predict(handlings()[:1])
    torch.testing.assert_close(OnPoses().flipped_answer(a.joints), b.joints)


def test_a_score_is_the_mean_over_all_time_steps():
    uneven = [*waves(2), *waves(1, length=12)]
    model = canonical(covariance_shrinkage=0).fit(waves())
    values = model.score_samples(uneven)
    assert values.shape == (3,)
    assert model.score(uneven) == pytest.approx(values @ [30, 30, 12] / 72)
    rows = torch.cat(model.rows(uneven)).numpy()
    # with one operator, time counts once in the mixture, too
    assert model.score(uneven) == pytest.approx(model.mixture_.score(rows))


def test_time_counts_once_however_many_operators_there_are():
    model, [shown] = hands_model(covariance_shrinkage=0).fit(handlings()), handlings(1)
    rows = local_data([shown], model.operators_, HANDS, model.skill.expect)[0].numpy()
    sides, component = np.split(rows, 2, axis=1), []
    for k in range(len(model.weights_)):
        logs = [np.log(float(model.weights_[k]))]
        for j, side in enumerate(sides):
            mean, covariance = model.means_[j][k].numpy(), model.covariances_[j][k].numpy()
            logs.append(multivariate_normal(mean, covariance).logpdf(side))
            if j:  # time again
                time = multivariate_normal(mean[0], covariance[0, 0]).logpdf(side[:, 0])
                logs.append(-time)
        component.append(sum(logs))
    expected = np.logaddexp.reduce(component).mean()
    assert model.score([shown]) == pytest.approx(expected, rel=1e-9)


def test_the_score_is_the_predictive_density_of_one_more_demonstration():
    model, [shown] = canonical(n_components=3).fit(waves()), waves(1)
    count, component = len(waves()), []
    for k, part in enumerate(zip(model.means_[0], model.covariances_[0], strict=True)):
        mean, covariance = (each.numpy() for each in part)
        gain = covariance[1:, 0] / covariance[0, 0]
        given = covariance[1:, 1:] - np.outer(gain, covariance[0, 1:])
        scale = given * (count + 1) / (count - 1)
        logs = norm(mean[0], np.sqrt(covariance[0, 0])).logpdf(shown.time.numpy())
        for t, (time, joints) in enumerate(zip(shown.time, shown.joints, strict=True)):
            expected = mean[1:] + gain * (float(time) - mean[0])
            logs[t] += multivariate_t(expected, scale, df=count - 1).logpdf(joints.numpy())
        component.append(float(model.weights_[k].log()) + logs)
    expected = np.logaddexp.reduce(component).mean()
    assert model.score([shown]) == pytest.approx(expected, rel=1e-9)


def test_samples_have_the_law_of_the_reproduction_at_every_instant():
    model = canonical(n_components=4).fit(waves())
    situation = Situation([0.0, 1.0, 0.0])
    [mean] = model.predict([situation])
    n = 4000
    samples = torch.stack([s.joints for s in model.sample(situation, n, random_state=0)])
    for at in (0, 11, 29):
        spread = mean.covariance[at].diagonal().sqrt()
        error = (samples[:, at].mean(0) - mean.joints[at]) / spread
        assert float(error.abs().max()) < 5 / np.sqrt(n)
        covariance = torch.cov(samples[:, at].T)
        relative = (covariance - mean.covariance[at]) / torch.outer(spread, spread)
        assert float(relative.abs().max()) < 5 * np.sqrt(2 / n)


def test_samples_are_those_of_their_random_state_and_as_smooth_as_the_model():
    situation, _ = new_handling()
    a, b, c = (hands().sample(situation, 2, random_state=seed) for seed in (0, 0, 1))
    assert torch.equal(a[1].joints, b[1].joints)
    assert not torch.equal(a[0].joints, a[1].joints)
    assert not torch.equal(a[0].joints, c[0].joints)
    assert float(a[0].joints.diff(dim=0).abs().max()) < 0.2
    quaternions = a[0].joints.unflatten(-1, (2, 7))[..., 3:]
    torch.testing.assert_close(quaternions.norm(dim=-1), torch.ones(30, 2, dtype=torch.float64))


def test_bounds_of_a_motion_follow_what_was_demonstrated():
    model = bottle()
    acceleration, jerk = typical_peaks(
        [joint_peaks(d.reorder(upper_body().joint_names)) for d in bottle_demonstrations()]
    )
    assert torch.equal(model.skill.peaks[0], acceleration) and torch.equal(
        model.skill.peaks[1], jerk
    )


# Objects that the robot holds


def test_objects_that_are_held_are_found_and_learned_as_where_they_were_last_free():
    found = carrying_model(PLACES)
    [hold] = found.holds_
    assert (hold.frame, hold.link) == ("bottle", "l_hand")
    same(clone(found).fit(with_holds(carries(), [hold])), found)
    # never let go, it is where it was at first
    shown = with_holds(carries(), [replace(hold, end=np.inf)])
    forever = clone(found).fit(shown)
    once = [at_first(d) for d in carries()]
    nominal = clone(found).fit(once)
    assert not nominal.holds_
    same(forever, nominal, 1e-9)
    assert forever.score(shown) == pytest.approx(nominal.score(once), abs=1e-6)


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_objects_that_move_with_a_hand_and_are_not_said_to_be_held_are_reported():
    with pytest.warns(PlausibilityWarning, match=r"attach_holds"):
        silent = clone(carrying_model(PLACES)).fit(carries())
    assert not silent.holds_
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        clone(carrying_model(PLACES)).fit(with_holds(carries(), []))


def test_objects_never_held_change_nothing_bit_for_bit():
    shown = handlings(moves=True)
    for given in (shown, with_holds(shown, [])):
        model = hands_model().fit(given)
        same(model, hands_model().fit(shown))
        assert not model.holds_


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_batches_are_held_like_the_first():
    whole = carrying_model()
    batches = [held_carries()[:5], held_carries()[5:]]
    same(clone(whole).fit(iter(batches)), whole, 1e-6)
    assert clone(whole).fit(iter(batches)).holds_[0].link == "l_hand"


def started(demonstration, link="l_hand"):
    """With the frame ``start``, where a link is at first."""
    state = upper_body().state(demonstration.joints[0])
    start = Frame(state.position(link), state.orientation(link))
    return replace(demonstration, frames={**demonstration.frames, "start": start})


@pytest.fixture(scope="module")
def starting():
    """A model in which where the hand started matters, and a demonstration of it."""
    shown = [started(one) for one in few_bottles()]
    operators = [pose("l_hand", "bottle"), pose("l_hand", "start"), Canonical()]
    model = TaskParameterizedGMM(4, operators, upper_body(), random_state=0)
    return model.fit(shown), shown[1]


def test_where_a_link_starts_follows_from_the_start_posture(starting, tmp_path):
    model, shown = starting
    links = {name: frame.link for name, frame in model.summary_.frames.items()}
    assert links == {"bottle": None, "start": "l_hand"}
    given = Situation(shown.joints[0], shown.frames)
    bottle = {"bottle": shown.frames["bottle"]}
    silent = Situation(shown.joints[0], bottle)
    save(model, tmp_path / "model")
    expected, found = model.predict([given, silent])
    [loaded] = load_model(tmp_path / "model").predict([silent])
    for other in (found, loaded):
        torch.testing.assert_close(other.joints, expected.joints, rtol=0, atol=1e-9)
    # a pose that is given counts
    there = Frame(shown.frames["start"].position + 0.01, shown.frames["start"].orientation)
    [other] = model.predict([replace(given, frames={**bottle, "start": there})])
    assert (other.joints - expected.joints).abs().max() > 1e-3


def test_a_controller_of_many_robots_knows_where_each_starts(starting):
    model, shown = starting
    starts = shown.joints[0] + torch.tensor([[0.0], [0.05], [-0.05]])
    bottle = {"bottle": shown.frames["bottle"]}
    together = Controller(model.skill, starts, bottle, clock="even")
    own = [started(replace(shown, joints=q.repeat(len(shown), 1))).frames for q in starts]
    pairs = zip(starts, own, strict=True)
    alone = [Controller(model.skill, q, frames, clock="even") for q, frames in pairs]
    for _ in range(5):
        together.step(0.05)
        for n, one in enumerate(alone):
            one.step(0.05)
            torch.testing.assert_close(together.reference[n], one.reference, rtol=0, atol=1e-7)


def test_a_frame_that_the_start_does_not_tell_has_to_be_given(starting):
    model, shown = starting
    for frames in ({}, {"start": shown.frames["start"]}):
        for use in (
            lambda f: model.predict([Situation(shown.joints[0], f)]),
            lambda f: Controller(model.skill, shown.joints[0], f),
        ):
            with pytest.raises(UnknownNameError, match=r"'bottle' is not in the situation"):
                use(frames)


def test_batches_know_where_links_start_too(starting):
    model, _ = starting
    shown = [started(one) for one in few_bottles()]
    again = clone(model).fit([shown[:2], shown[2:]])
    assert again.summary_.frames["start"].link == "l_hand"


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_few_demonstrations_are_not_certain_of_what_comes_next(n):
    far = [replace(one, joints=one.joints + 1.0) for one in waves(1)]
    model = canonical().fit(waves(n))
    wide = model.score(far)
    model.set_params(covariance_shrinkage=0)  # of the same mixture
    assert np.isfinite(wide) and wide > model.score(far) + 50

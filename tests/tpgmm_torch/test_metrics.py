"""Measures of reproductions, against signals whose answer is known."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from sklearn.base import clone
from sklearn.model_selection import KFold, cross_val_score
from sklearn.pipeline import make_pipeline

from tests.support.refusals import refused
from tests.support.skills import (
    HANDS,
    JOINT_NAMES,
    canonical,
    handlings,
    hands,
    hands_model,
    waves,
)
from tests.support.worlds import LEFT, OnPoses, upper_body
from tpgmm_torch import Demonstration, Situation, Trajectory
from tpgmm_torch.alignment import LinearTimeNormalization
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.metrics import (
    PoseScorer,
    joint_rmse,
    largest_acceleration,
    largest_velocity,
    pose_errors,
    reproduction_scorer,
)


def trajectory(time: torch.Tensor, joints: torch.Tensor, names=JOINT_NAMES) -> Trajectory:
    n = joints.shape[1]
    return Trajectory(time, joints, torch.eye(n).expand(len(time), n, n), (), names)


def test_the_error_of_joints_is_their_root_mean_square():
    [wanted] = waves(1)
    shift = torch.tensor([0.3, 0.0, -0.4], dtype=torch.float64)
    moved = trajectory(wanted.time, wanted.joints + shift)
    assert joint_rmse(moved, wanted) == pytest.approx(0.5 / np.sqrt(3))
    assert joint_rmse(trajectory(wanted.time, wanted.joints), wanted) == 0.0


def test_joints_are_compared_by_name():
    [wanted] = waves(1)
    names = JOINT_NAMES[::-1]
    assert joint_rmse(trajectory(wanted.time, wanted.joints.flip(1), names), wanted) == 0.0
    unknown = trajectory(wanted.time, wanted.joints, ("a", "b", "z"))
    refused(lambda: joint_rmse(unknown, wanted), UnknownNameError, r"'z'.*\['a', 'b', 'c'\]")


def test_other_lengths_are_refused():
    [wanted], [longer] = waves(1), waves(1, length=31)
    with pytest.raises(ShapeError, match=r"\(31, 3\).*\(30, 3\)"):
        joint_rmse(trajectory(longer.time, longer.joints), wanted)


def test_the_scorer_is_minus_the_mean_error():
    given = handlings(2)
    errors = [joint_rmse(t, d) for t, d in zip(hands().predict(given), given, strict=True)]
    assert reproduction_scorer(hands(), given) == pytest.approx(-np.mean(errors))
    assert -5e-3 < reproduction_scorer(hands(), given) < 0
    spoilt = [replace(d, joints=d.joints.flip(0)) for d in given]
    assert reproduction_scorer(hands(), spoilt) < -0.1
    refused(lambda: reproduction_scorer(hands(), []), DataError, "empty")


def flip_signs(demonstration: Demonstration, steps: slice = slice(None)) -> Demonstration:
    """The same poses with the other sign of their quaternions, at some steps."""
    joints = demonstration.joints.clone()
    joints[steps] = OnPoses().flipped_answer(joints[steps])
    return replace(demonstration, joints=joints)


def test_signs_of_recorded_quaternions_mean_nothing():
    [shown] = handlings(1)
    found = trajectory(shown.time, shown.joints, HANDS.joint_names)
    for other in (flip_signs(shown), flip_signs(shown, slice(3, None, 4))):
        assert joint_rmse(found, other) == 0.0
        assert pose_errors(found, other, HANDS, "left").angle.max() < 1e-5
        for scorer in (reproduction_scorer, PoseScorer(), PoseScorer(quantity="angle")):
            assert scorer(hands(), [other]) == pytest.approx(scorer(hands(), [shown]), rel=1e-9)
    moved = flip_signs(shown).joints.clone()
    moved[:, 0] += 0.7
    assert joint_rmse(found, replace(shown, joints=moved)) == pytest.approx(0.7 / 14**0.5)


def shift_hand(shown: Demonstration, turn: Rotation, by: float) -> Trajectory:
    """The right hand elsewhere by so many metres, and turned."""
    joints = shown.joints.clone()
    joints[:, 8] += by
    before = Rotation.from_quat(joints[:, 10:14].numpy(), scalar_first=True)
    after = (turn * before).as_quat(scalar_first=True)
    joints[:, 10:14] = torch.from_numpy(after)
    return trajectory(shown.time, joints, HANDS.joint_names)


def test_pose_errors_are_distances_and_angles():
    [shown] = handlings(1)
    found = shift_hand(shown, Rotation.from_rotvec([0.0, 0.0, 30.0], degrees=True), 0.004)
    errors = pose_errors(found, shown, HANDS, "right")
    assert torch.equal(errors.time, shown.time)
    torch.testing.assert_close(errors.position, torch.full((30,), 4.0).double())
    torch.testing.assert_close(errors.angle, torch.full((30,), 30.0).double())
    left = pose_errors(found, shown, HANDS, "left")
    assert left.position.max() == 0.0
    assert left.angle.max() < 1e-5
    assert repr(errors) == "PoseErrors(30 instants, mean 4 mm, 30 deg)"


def test_poses_of_a_robot_are_those_of_its_kinematics():
    robot, time = upper_body(), torch.linspace(0, 1, 5, dtype=torch.float64)
    joints = torch.linspace(-0.3, 0.3, 5, dtype=torch.float64)[:, None].expand(5, 17)
    shown = Demonstration(time, joints.flip(1), joint_names=robot.joint_names[::-1])
    found = trajectory(time, joints + 0.05, robot.joint_names)
    errors = pose_errors(found, shown, robot, LEFT, at=0.5)
    a, b = robot.state(joints[2] + 0.05), robot.state(joints[2])
    expected = 1e3 * (a.position(LEFT) - b.position(LEFT)).norm()
    torch.testing.assert_close(errors.position, expected[None])
    turns = [Rotation.from_quat(s.orientation(LEFT).numpy(), scalar_first=True) for s in (a, b)]
    expected = np.rad2deg((turns[0] * turns[1].inv()).magnitude())
    assert float(errors.angle) == pytest.approx(expected)


def test_instants_are_named_or_given():
    [shown] = handlings(1)
    shown = replace(shown, events={"close": 0.713})
    late = trajectory(shown.time + 0.1, shown.joints, HANDS.joint_names)
    by_name = pose_errors(late, shown, HANDS, "left", at="close")
    assert by_name.time.tolist() == [0.713]
    for at in (0.713, [0.713], torch.tensor(0.713, dtype=torch.float64)):
        other = pose_errors(late, shown, HANDS, "left", at=at)
        assert torch.equal(other.position, by_name.position)
    both = pose_errors(late, shown, HANDS, "left", at=[0.2, 0.713])
    assert both.position[1] == by_name.position[0]
    assert by_name.position > 10
    held = pose_errors(late, shown, HANDS, "left", at=0.0)
    assert held.position == 0.0  # it has not begun yet
    one = Demonstration([1.0], shown.joints[:1], joint_names=HANDS.joint_names)
    assert pose_errors(late, one, HANDS, "left").position.shape == (1,)


@pytest.mark.parametrize(("at", "options", "error", "message"), [
    ("grasp", {}, UnknownNameError, r"event 'grasp' is not in the dem.*'close'"),
    (2.5, {}, DataError, r"\[2.5\] s lie outside the demonstration, 0 to 2 s"),
    (float("nan"), {}, DataError, "NaN"),
    ([], {}, DataError, "outside"),
    (0.5, {"link": "hand"}, UnknownNameError, "'hand'.*'left', 'right'"),
])  # fmt: skip
def test_instants_that_are_none_are_refused(at, options, error, message):
    shown = replace(handlings(1)[0], events={"close": 0.7})
    found = trajectory(shown.time, shown.joints, HANDS.joint_names)
    options = {"link": "left", **options}
    refused(lambda: pose_errors(found, shown, HANDS, at=at, **options), error, message)


def test_a_pose_scorer_is_minus_the_mean_error():
    shown = [replace(d, events={"close": 0.3 * (i + 1)}) for i, d in enumerate(handlings(3))]
    model = hands()
    situations = [Situation.of(d, d.time) for d in shown]
    found = model.predict(situations, candidates=False)

    def mean(quantity, at, *links):
        return np.mean(
            [
                getattr(pose_errors(t, d, HANDS, link, at), quantity).mean()
                for t, d in zip(found, shown, strict=True)
                for link in links
            ]
        )

    for event in ("close", 0.9, None):
        for quantity in ("position", "angle"):
            scorer = PoseScorer("right", event, quantity)
            assert scorer(model, shown) == pytest.approx(-mean(quantity, event, "right"))
    every = PoseScorer(event="close")
    assert every(model, shown) == pytest.approx(-mean("position", "close", "left", "right"))
    assert pickle.loads(pickle.dumps(every)) == every
    assert clone(every, safe=False) == every


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_scorers_of_a_pipeline_align_what_is_held_out():
    """The same skill at other speeds: apart on their own clocks, alike on the common one."""
    shown = [
        replace(one, time=one.time * speed, events={"close": 1.2 * speed})
        for one, speed in zip(handlings(4), (1.0, 1.5, 0.8, 1.2), strict=True)
    ]
    *train, _ = shown
    pipeline = make_pipeline(LinearTimeNormalization(robot=HANDS), hands_model()).fit(train)
    for scorer, worst in ((PoseScorer("right", "close"), 5.0), (reproduction_scorer, 0.01)):
        aligned, apart = scorer(pipeline, shown[3:]), scorer(pipeline[-1], shown[3:])
        assert apart < 3 * aligned < 0
        assert aligned > -worst
    alone = make_pipeline(hands_model()).fit(handlings(3))
    scorer = PoseScorer("right")
    assert scorer(alone, handlings(4)[3:]) == scorer(alone[-1], handlings(4)[3:])
    folds = cross_val_score(
        make_pipeline(LinearTimeNormalization(robot=HANDS), hands_model()),
        shown, cv=KFold(2), scoring=PoseScorer("right", "close"), error_score="raise",
    )  # fmt: skip
    assert folds.min() > -50


def test_what_a_scorer_cannot_serve_is_refused():
    with pytest.raises(DataError, match=r"'position' .mm. or 'angle' .deg., got 'both'"):
        PoseScorer(quantity="both")
    refused(lambda: PoseScorer()(canonical().fit(waves()), waves()), DataError, "no links")
    refused(lambda: PoseScorer("wrist")(hands(), handlings(1)), UnknownNameError, "'wrist'")


@pytest.mark.parametrize("kind", [trajectory, lambda t, q: Demonstration(t, q)])
def test_speed_and_acceleration_are_those_of_a_parabola(kind):
    rng = np.random.default_rng(0)
    time = torch.from_numpy(np.sort(rng.uniform(0, 2, 60)))  # uneven steps
    joints = torch.stack((time, 1.5 * time**2, -3 * time), dim=1)
    motion = kind(time, joints)
    last = float(3 * (time[-1] + time[-2]) / 2)
    assert largest_velocity(motion) == pytest.approx(max(3.0, last))
    assert largest_acceleration(motion) == pytest.approx(3.0, rel=1e-6)

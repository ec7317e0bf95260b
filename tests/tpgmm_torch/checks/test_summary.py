"""Novelty of situations: calibrated on the demonstrations, free of coordinates, and named."""

import copy
import json

import numpy as np
import pytest
import torch

from tests.support.refusals import refused
from tests.support.skills import generator
from tests.support.worlds import upper_body
from tpgmm_torch import Demonstration, Frame, quaternions
from tpgmm_torch.checks import Region, TrainingSummary
from tpgmm_torch.checks.training import summarize
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots import Poses
from tpgmm_torch.robots.kinematics import JointSpace

SKILL = generator()


def summarise(places, starts, turns=None, kinematics=None) -> TrainingSummary:
    """A summary of demonstrations that stand still."""
    frames = Frame(places, turns)
    kinematics = kinematics or JointSpace(tuple(f"j{i}" for i in range(np.shape(starts)[1])))
    items = [
        Demonstration([0.0, 1.0], np.stack((start, start)), {"cup": frames[i]})
        for i, start in enumerate(np.asarray(starts))
    ]
    return TrainingSummary.of(summarize(items, kinematics), kinematics)


def bottles(n: int, seed: int, width: float = 1.0) -> tuple[np.ndarray, Frame]:
    """Start postures and bottles of the generated skill, in a wider box than it has."""
    rng = np.random.default_rng(seed)
    starts, frame = SKILL.start_postures(n, rng).numpy(), SKILL.bottle_poses(n, rng)
    centre = (torch.tensor(SKILL.lowest) + torch.tensor(SKILL.highest)).double() / 2
    turn = quaternions.exp(quaternions.log(frame.orientation) * width)
    return starts, Frame(centre + (frame.position - centre) * width, turn)


def show(n: int, seed: int) -> TrainingSummary:
    starts, frame = bottles(n, seed)
    return summarise(frame.position, starts, frame.orientation)


@pytest.mark.parametrize("n", [5, 10, 20])
def test_situations_like_the_demonstrations_are_beyond_1_once_in_n_plus_1(n):
    beyond, warned = [], []
    for seed in range(60):
        starts, frame = bottles(50, seed + 100)
        novelty = show(n, seed).novelty(starts, {"cup": frame})
        beyond.append((novelty > 1).mean())
        warned.append((novelty > 1.5).mean())
    assert np.mean(beyond) == pytest.approx(1 / (n + 1), abs=0.05)
    assert np.mean(warned) < 0.03  # 2 % with 5, none with 20


def test_it_is_the_same_however_the_base_is_turned():
    starts, frame = bottles(8, 0)
    new_starts, new = bottles(4, 1, width=2.0)
    base = quaternions.exp(torch.tensor([0.3, -1.0, 0.7], dtype=torch.float64))

    def move(pose: Frame) -> Frame:
        turn = quaternions.product(base, pose.orientation)
        return Frame(quaternions.rotate(base, pose.position) + 0.4, turn)

    here = summarise(frame.position, starts, frame.orientation)
    there = summarise(move(frame).position, starts, -move(frame).orientation)
    expected = here.novelty(new_starts, {"cup": new})
    assert there.novelty(new_starts, {"cup": move(new)}) == pytest.approx(expected, rel=1e-6)


def test_the_furthest_demonstration_sets_the_unit():
    starts = np.random.default_rng(0).normal(size=(7, 2))
    starts[3] = (2.0, 2.5)
    others = Region.of(np.delete(starts, 3, axis=0), "start")
    summary = summarise(np.zeros((7, 3)), starts)
    assert summary.limit == pytest.approx(float(others.distance(starts[3])))


def test_one_odd_demonstration_does_not_make_far_objects_likely():
    rng = np.random.default_rng(0)
    places, starts = 0.02 * rng.normal(size=(5, 3)), 0.05 * rng.normal(size=(5, 7))
    apart, bent = places.copy(), starts.copy()
    apart[4, 0] += 0.5
    bent[4] += 1.0
    for summary in (summarise(apart, starts), summarise(places, bent)):
        assert summary.limit == 2.0
        [finding] = summary.findings(starts[0], {"cup": Frame([4.0, 0.0, 0.0])})
        assert finding.check == "place" and "cup: x = 4, shown" in finding.message


def test_few_or_equal_demonstrations_have_fixed_units():
    two = summarise(np.zeros((2, 3)), np.zeros((2, 2)))
    edge = 0.05 * np.sqrt(3 + 2 * np.sqrt(6))  # a deviation of 5 cm
    assert float(two.novelty(None, {"cup": Frame([edge, 0, 0])})) == pytest.approx(1.0)
    equal = summarise(np.zeros((9, 3)), np.zeros((9, 2)))
    assert float(equal.novelty([0.0, 0.0], {"cup": Frame([0.005, 0, 0])})) < 1
    assert float(equal.novelty([0.0, 0.0], {"cup": Frame([0.1, 0, 0])})) > 3


def test_two_unusual_things_are_newer_than_one_by_the_4_norm():
    summary = summarise(np.zeros((2, 3)), np.zeros((2, 2)))
    both = Frame([0.1, 0, 0], quaternions.exp(torch.tensor([0, 0, 0.7]).double()))
    place, turn = Frame([0.1, 0, 0]), Frame([0.0, 0, 0], both.orientation)
    one, other, two = (float(summary.novelty(None, {"cup": f})) for f in (place, turn, both))
    assert 0.5 < one < 1 and 0.5 < other < 1
    assert two**4 == pytest.approx(one**4 + other**4)


def test_unknown_frames_task_parameters_and_nan_do_not_count():
    summary = show(5, 0)
    starts, frame = bottles(2, 1)
    known = summary.novelty(None, {"cup": frame})
    starts[:, 3] = np.nan
    more = {"cup": frame, "other": Frame([9.0, 9, 9])}
    assert summary.novelty(starts, more) == pytest.approx(known)


def test_quaternions_among_joints_are_not_compared():
    hand = Poses(("hand",))
    starts = np.tile([0.0, 0, 0, 1, 0, 0, 0], (3, 1))
    assert summarise(np.zeros((3, 3)), starts, kinematics=hand).compared == [0, 1, 2]


def test_a_coordinate_outside_is_named_with_its_range():
    places = np.random.default_rng(0).uniform([0.2, -0.1, 0.1], [0.4, 0.1, 0.2], (10, 3))
    starts = np.random.default_rng(1).uniform(-0.1, 0.1, (10, 2))
    summary = summarise(places, starts)
    [finding] = summary.findings([0.0, 0.0], {"cup": Frame([0.3, 0.0, 0.45])}, "robot 4, ")
    low, high = places[:, 2].min(), places[:, 2].max()
    assert f"robot 4, cup: z = 0.45, shown {low:.4g} to {high:.4g}" in finding.message
    assert finding.check == "place" and finding.value > 1.5
    [finding] = summary.findings([0.0, 2.0], {})  # of rad or m
    assert finding.names == ("j1",) and "j1 = 2, shown" in finding.message


def test_a_place_beside_a_line_of_places_is_unlikely():
    along = np.linspace(0, 0.5, 12)[:, None] * [1.0, 1.0, 0.0]
    summary = summarise(along, np.zeros((12, 2)))
    assert summary.findings(None, {"cup": Frame([0.25, 0.25, 0.0])}) == []
    [finding] = summary.findings(None, {"cup": Frame([0.0, 0.5, 0.0])})
    assert "cup: beside those shown, at 0, 0.5, 0 m" in finding.message


def test_orientations_count_by_their_angle_whatever_the_sign():
    axis = torch.tensor([0, 0, 1.0], dtype=torch.float64)
    turns = quaternions.exp(torch.linspace(-0.3, 0.3, 6).double()[:, None] * axis)
    summary = summarise(np.zeros((6, 3)), np.zeros((6, 2)), turns)
    assert summary.findings(None, {"cup": Frame([0, 0, 0], -turns[1])}) == []
    [finding] = summary.findings(None, {"cup": Frame([0, 0, 0], [0, 1.0, 0, 0])})
    assert "turned by 180 deg" in finding.message and "(w, x, y, z)?" in finding.remedy
    [finding] = summary.findings(None, {"cup": Frame([0, 0, 0], turns[1].roll(-1))})
    assert "Read as (x, y, z, w) it would fit" in finding.remedy


def test_a_frame_at_a_link_follows_from_the_start_posture():
    robot = upper_body()
    starts = SKILL.start_postures(4, np.random.default_rng(0))
    hands = robot.state(starts).pose("l_hand")
    summary = summarise(hands.position, starts, -hands.orientation, robot)
    assert summary.frames["cup"].link == "l_hand"
    pose = summary.start_frames(starts[1], robot)["cup"]
    assert torch.allclose(pose.position, hands[1].position)
    assert summary.start_frames(starts[1], robot, given=["cup"]) == {}
    beside = summarise(hands.position + 1e-3, starts, hands.orientation, robot)
    assert beside.frames["cup"].link is None


@pytest.mark.parametrize("at", [None, "l_hand@close"])
def test_a_frame_that_was_a_links_pose_is_not_taken_for_an_object(at):
    starts, turns = np.zeros((6, 2)), np.tile([0.0, 1.0, 0.0, 0.0], (6, 1))
    shown = [Frame(np.zeros(3), turn) for turn in turns]
    for frame in shown:
        vars(frame).update(at=at)
    kinematics = JointSpace(("j0", "j1"))
    items = [
        Demonstration([0.0, 1.0], np.stack((start, start)), {"cup": frame.to(torch.float64)})
        for start, frame in zip(starts, shown, strict=True)
    ]
    summary = TrainingSummary.of(summarize(items, kinematics), kinematics)
    summary = TrainingSummary.from_config(json.loads(json.dumps(summary.config())), kinematics)
    assert summary.frames["cup"].at == at
    assert summary.findings(None, {"cup": Frame([0, 0, 0], turns[0])}) == []
    [finding] = summary.findings(None, {"cup": Frame([0, 0, 0])})
    assert "turned by 180 deg" in finding.message
    assert ("It was the pose of l_hand at close" in finding.remedy) == (at is not None)
    assert ("(x, y, z, w)" in finding.remedy) == (at is None)


def damages(config):
    """Copies of nested dictionaries and lists, one value spoiled or left out in each."""
    for key, value in config.items() if isinstance(config, dict) else enumerate(config):
        for wrong in (None, "x", [], -1.5, 1.0, float("nan"), {}, True):
            if wrong != value and not (key in ("link", "at") and wrong is None):
                spoiled = copy.copy(config)
                spoiled[key] = wrong
                yield key, wrong, spoiled
        if isinstance(value, dict | list):
            for path, wrong, inner in damages(value):
                spoiled = copy.copy(config)
                spoiled[key] = inner
                yield f"{key}.{path}", wrong, spoiled


def test_json_gives_it_back_and_damage_is_refused():
    summary = show(5, 0)
    robot = JointSpace(summary.joint_names)
    config = json.loads(json.dumps(summary.config()))
    assert TrainingSummary.from_config(config, robot) == summary
    with pytest.raises(DataError, match="joint_names"):
        TrainingSummary.from_config(config, JointSpace(("a", "b")))
    starts, frame = bottles(3, 1)
    accepted = 0
    for path, wrong, spoiled in damages(config):
        try:
            again = TrainingSummary.from_config(spoiled, robot)
        except DataError:
            continue
        accepted += 1
        # another number where a number may be: it has to work as one
        assert wrong in (-1.5, 1.0) or path in ("events", "frames", "postures"), (path, wrong)
        assert np.isfinite(again.novelty(starts, {"cup": frame})).all()
        again.findings(starts[0] + 9, {"cup": frame[0]})
        again.start_frames(starts, robot)
    assert accepted < 600
    for spoiled in (config | {"more": 1}, {}, {k: config[k] for k in list(config)[1:]}, None):
        refused(
            lambda spoiled=spoiled: TrainingSummary.from_config(spoiled, robot),
            DataError,
            "summary",
        )

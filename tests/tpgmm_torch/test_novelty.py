"""How new a situation is: calibrated on the demonstrations themselves, free of coordinates."""

import json
from dataclasses import asdict

import numpy as np
import pytest
import torch

from tests.support.skills import generator
from tpgmm_torch import Demonstration, Frame, quaternions
from tpgmm_torch.data.affine import Affine
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.novelty import FEWEST, LEAST, UNKNOWN, Novelty, Region
from tpgmm_torch.plausibility.check import summarize
from tpgmm_torch.plausibility.poses import mean_orientation
from tpgmm_torch.plausibility.shown import Shown
from tpgmm_torch.robots.joint_space import JointSpace

TIME = np.arange(2.0)
SKILL = generator()


def learned(places, starts, turns=None) -> Novelty:
    frame = Frame(places, turns)
    turned = frame.orientation.numpy()
    first = {"cup": (frame.position.numpy(), turned, mean_orientation(turned))}
    return Novelty.of(starts, np.ones(starts.shape[1], bool), first)


def bottles(n: int, seed: int, width: float = 1.0) -> tuple[np.ndarray, Frame]:
    """Start postures and bottles of the generated skill, in a wider box than it has."""
    rng = np.random.default_rng(seed)
    starts, frame = SKILL.start_postures(n, rng).numpy(), SKILL.bottle_poses(n, rng)
    centre = (torch.tensor(SKILL.lowest) + torch.tensor(SKILL.highest)).double() / 2
    turn = quaternions.exp(quaternions.log(frame.orientation) * width)
    return starts, Frame(centre + (frame.position - centre) * width, turn)


def shown(n: int, seed: int) -> Novelty:
    starts, frame = bottles(n, seed)
    return learned(frame.position, starts, frame.orientation)


@pytest.mark.parametrize("n", [5, 10, 20])
def test_what_is_like_the_demonstrations_is_beyond_1_once_in_n_plus_1(n):
    beyond = []
    for seed in range(60):
        starts, frame = bottles(50, seed + 100)
        beyond.append((shown(n, seed).ratio(starts, {"cup": frame}) > 1).mean())
    assert np.mean(beyond) == pytest.approx(1 / (n + 1), abs=0.05)


@pytest.mark.parametrize(("n", "width"), [(5, 3.0), (10, 3.0), (10, 2.0)])
def test_inside_and_outside_the_shown_box_are_told_apart(n, width):
    areas = []
    for seed in range(5):
        novelty = shown(n, seed)
        starts, inside = bottles(400, seed + 100)
        _, wide = bottles(400, seed + 200, width=width)
        outside = [i for i in range(400) if not SKILL.usual(wide[i])]
        low = novelty.ratio(starts, {"cup": inside})
        high = novelty.ratio(starts, {"cup": wide})[outside]
        areas.append((low[:, None] < high).mean())  # area under the ROC
    assert np.mean(areas) > 0.95  # 0.988, 0.993 and 0.966 measured


def test_it_is_the_same_however_the_base_is_turned():
    starts, frame = bottles(8, 0)
    new_starts, new = bottles(4, 1, width=2.0)
    base = quaternions.exp(torch.tensor([0.3, -1.0, 0.7], dtype=torch.float64))

    def moved(pose: Frame) -> Frame:
        turn = quaternions.product(base, pose.orientation)
        return Frame(quaternions.rotate(base, pose.position) + 0.4, turn)

    here = learned(frame.position, starts, frame.orientation)
    there = learned(moved(frame).position, starts, -moved(frame).orientation)
    expected = here.ratio(new_starts, {"cup": new})
    assert there.ratio(new_starts, {"cup": moved(new)}) == pytest.approx(expected, rel=1e-6)


def test_the_furthest_demonstration_sets_the_unit():
    rng = np.random.default_rng(0)
    starts, places = rng.normal(size=(7, 2)), np.zeros((7, 3))
    starts[3] = (6.0, 6.0)
    novelty = learned(places, starts)
    others = Region.of(np.delete(starts, 3, axis=0), "start")
    assert novelty.limit == pytest.approx(float(others.distance(starts[3])))


def test_few_demonstrations_leave_fixed_units():
    novelty = learned(np.zeros((FEWEST - 1, 3)), np.zeros((FEWEST - 1, 2)))
    edge = UNKNOWN["place"] * np.sqrt(3 + 2 * np.sqrt(6))
    assert float(novelty.ratio(None, {"cup": Frame([edge, 0, 0])})) == pytest.approx(1.0)


def test_demonstrations_that_are_all_alike_do_not_make_everything_new():
    novelty = learned(np.zeros((9, 3)), np.zeros((9, 2)))
    assert novelty.limit == LEAST
    assert float(novelty.ratio([0.0, 0.0], {"cup": Frame([0.005, 0, 0])})) < 1
    assert float(novelty.ratio([0.0, 0.0], {"cup": Frame([0.1, 0, 0])})) > 3


def test_two_things_that_are_a_little_unusual_are_newer_than_one():
    novelty = learned(np.zeros((FEWEST - 1, 3)), np.zeros((FEWEST - 1, 2)))
    place = Frame([0.1, 0, 0], quaternions.exp(torch.zeros(3, dtype=torch.float64)))
    both = Frame(place.position, quaternions.exp(torch.tensor([0, 0, 0.7]).double()))
    one, two = (float(novelty.ratio(None, {"cup": frame})) for frame in (place, both))
    turned = float(novelty.ratio(None, {"cup": Frame([0.0, 0, 0], both.orientation)}))
    assert 0.5 < one < 1 and 0.5 < turned < 1
    assert max(one, turned) < two < one + turned
    assert two**4 == pytest.approx(one**4 + turned**4)


def test_what_is_not_known_does_not_count():
    novelty = shown(5, 0)
    starts, frame = bottles(2, 1)
    known = novelty.ratio(None, {"cup": frame})
    starts[:, 3] = np.nan
    more = {"cup": frame, "other": Frame([9.0, 9, 9]), "shelf": Affine(np.eye(2), np.zeros(2))}
    assert novelty.ratio(starts, more) == pytest.approx(known)


def test_frames_that_moved_are_known():
    ways = {"cup": Frame([[0.0, 0, 0], [0.3, 0, 0]]), "tray": Frame([[0.0, 0, 0]] * 2)}
    demonstration = Demonstration(TIME, np.eye(2), ways, ("a", "b"))
    robot = JointSpace(("a", "b"))
    assert Shown.of(summarize([demonstration], robot), robot).novelty.moving == ["cup"]


def test_json_gives_it_back_and_nonsense_is_refused():
    novelty = shown(5, 0)
    again = Novelty.from_config(json.loads(json.dumps(asdict(novelty))))
    starts, frame = bottles(3, 1)
    expected = novelty.ratio(starts, {"cup": frame})
    assert np.array_equal(again.ratio(starts, {"cup": frame}), expected)
    for spoil in ({"limit": 0.0}, {"compared": [1]}, {"places": {}}, {"start": None}):
        with pytest.raises(DataError, match="new"):
            Novelty.from_config(asdict(novelty) | spoil)

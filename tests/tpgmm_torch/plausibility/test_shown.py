"""How far a situation is from what was shown: as many false alarms as chance allows."""

import json

import numpy as np
import pytest
import torch

from tests.support.skills import generator
from tests.support.worlds import upper_body
from tpgmm_torch import Demonstration, Frame, quaternions
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.plausibility.check import summarize
from tpgmm_torch.plausibility.shown import CHANCE, MOST_RANGES, Shown
from tpgmm_torch.robots.joint_space import JointSpace

TIME = np.linspace(0, 1, 20)
ROBOT = JointSpace(("a", "b"))


def shown(places, starts=None, turns=None) -> Shown:
    starts = np.zeros((len(places), 2)) if starts is None else starts
    turns = [None] * len(places) if turns is None else turns
    items = [
        Demonstration(TIME, np.outer(1 + TIME, q), {"cup": Frame(p, turn)}, ("a", "b"))
        for p, q, turn in zip(places, starts, turns, strict=True)
    ]
    return Shown.of(summarize(items, ROBOT), ROBOT)


@pytest.mark.parametrize("n", [4, 6, 10, 20])
def test_a_coordinate_of_the_same_law_is_outside_by_the_chance_that_is_stated(n):
    rng = np.random.default_rng(n)
    seen, new = rng.random((200_000, n)), rng.random(200_000)
    low, high = seen.min(1), seen.max(1)
    excess = np.maximum(low - new, new - high) / (high - low)
    limit = shown(np.zeros((n, 3))).ranges
    # below the law of one end: in a box, the other side of the range has an end too
    expected = 2 * CHANCE if limit < MOST_RANGES else 2 / (n + 1) * (1 + limit) ** (1 - n)
    measured = (excess > limit).mean()
    assert measured < expected + 4 * np.sqrt(expected / 200_000)


def test_one_demonstration_says_little():
    assert shown(np.zeros((1, 3))).ranges == MOST_RANGES


def test_situations_of_the_generated_skill_are_plausible():
    recorded = generator().demonstrations(10, seed=0)
    seen = Shown.of(summarize(recorded, upper_body()), upper_body())
    new = [d for seed in (1, 2) for d in generator().demonstrations(10, seed=seed)]
    assert max(float(seen.distance(d.joints[0], d.frames)) for d in new) < 1  # 0.49 measured


def test_a_coordinate_outside_is_named_with_what_was_shown():
    places = np.random.default_rng(0).uniform([0.2, -0.1, 0.1], [0.4, 0.1, 0.2], (10, 3))
    seen = shown(places)
    [finding] = seen.findings([0.0, 0.0], {"cup": Frame([0.3, 0.0, 0.30])}, "situation 4, ")
    low, high = places[:, 2].min(), places[:, 2].max()
    assert f"situation 4, cup: z = 0.3 m, shown {low:.4g} to {high:.4g}" in finding.message
    assert finding.check == "place" and finding.value > 1
    assert seen.findings([0.0, 0.0], {"cup": Frame([0.3, 0.0, 0.15])}) == []


def test_a_place_beside_a_line_of_places_is_implausible():
    along = np.linspace(0, 0.5, 12)[:, None] * [1.0, 1.0, 0.0]
    seen = shown(along)
    assert float(seen.distance(None, {"cup": Frame([0.25, 0.25, 0.0])})) < 1
    [finding] = seen.findings(None, {"cup": Frame([0.1, 0.4, 0.0])})
    assert "Mahalanobis" in finding.message


def test_orientations_count_by_their_angle_whatever_the_sign():
    angles = torch.linspace(-0.3, 0.3, 6, dtype=torch.float64)
    turns = [
        quaternions.exp(a * torch.tensor([0, 0, 1.0], dtype=torch.float64)) for a in angles
    ]
    seen = shown(np.zeros((6, 3)), turns=turns)
    assert float(seen.distance(None, {"cup": Frame([0, 0, 0], -turns[1])})) < 1
    [finding] = seen.findings(None, {"cup": Frame([0, 0, 0], [0, 1.0, 0, 0])})
    assert "turned by 180 deg" in finding.message and "(w, x, y, z)?" in finding.remedy
    [finding] = seen.findings(None, {"cup": Frame([0, 0, 0], turns[1].roll(-1))})
    assert "Read as (x, y, z, w) it would fit" in finding.remedy


def test_start_postures_and_whole_batches():
    starts = np.random.default_rng(1).uniform(-0.1, 0.1, (8, 2))
    seen = shown(np.zeros((8, 3)), starts)
    batch = np.array([[0.0, 0.0], [0.0, 2.0], [0.05, -0.05]])
    far = seen.distance(batch, {"cup": Frame([0, 0, 0])}) > 1
    assert far.tolist() == [False, True, False]
    [finding] = seen.findings(batch[1], {})
    assert finding.names == ("b",) and "b = 2, shown" in finding.message


def test_json_gives_it_back_and_nonsense_is_refused():
    seen = shown(np.random.default_rng(2).random((5, 3)))
    again = Shown.from_config(json.loads(json.dumps(seen.config())))
    assert again == seen
    for spoil in ({"start_low": [0.0]}, {"frames": {"cup": {}}}, {"frames": None}):
        with pytest.raises(DataError, match="shown"):
            Shown.from_config(seen.config() | spoil)

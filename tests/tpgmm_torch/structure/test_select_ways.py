"""How many ways demonstrations show: found where it is known."""

import numpy as np
import pytest
import torch

from tests.support.planted import HAND, PlantedTask
from tests.support.skills import few_bottles
from tests.support.two_ways import TIME, Handles, Obstacle, shown
from tpgmm_datasets.bottle.skill import bottle_operators, upper_body
from tpgmm_torch import Canonical, Demonstration, Frame, RelativePosition, TaskParameterizedGMM
from tpgmm_torch.alignment import LinearTimeNormalization
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots import Poses
from tpgmm_torch.structure.select_ways import SelectWays

POINT = Poses(["hand"], orientation=False)


def learner(operators=None, robot=None):
    return TaskParameterizedGMM(3, operators, robot, tol=1e-1)


def same_partition(one, other):
    """Whether two labellings divide alike."""
    return len(set(zip(one, other, strict=True))) == len(set(one)) == len(set(other))


def paths(offsets, seed=0, noise=0.01):
    """Joints that go 0, 1, ... and are off by offsets in the middle."""
    rng = np.random.default_rng(seed)
    bump = np.sin(np.pi * TIME / TIME[-1])
    ways = [(o + noise * rng.normal()) * bump for o in offsets]
    return [Demonstration(TIME, np.stack((TIME, way), axis=1)) for way in ways]


@pytest.mark.parametrize("task", [Obstacle, Handles])
def test_both_ways_are_found_and_who_went_which(task):
    for seed in range(2):
        demonstrations, sides = shown(task, seed)
        selection = SelectWays(task().model()).fit(demonstrations)
        assert selection.n_ways_ == 2
        assert same_partition(selection.labels_, sides)
        assert selection.labels_[0] == 0
        assert selection.bic_.argmin() == 1


@pytest.mark.parametrize("task", [Obstacle, Handles])
def test_one_way_is_one_mode_for_any_number_of_demonstrations(task):
    demonstrations, sides = shown(task, 0, 16)
    for side in (1, -1):
        members = [one for one, s in zip(demonstrations, sides, strict=True) if s == side]
        for n in range(2, len(members) + 1):
            assert SelectWays(task().model()).fit(members[:n]).n_ways_ == 1


def test_the_order_of_demonstrations_does_not_matter():
    demonstrations, _ = shown(Obstacle)
    order = np.random.default_rng(0).permutation(len(demonstrations))
    first = SelectWays(Obstacle().model()).fit(demonstrations)
    other = SelectWays(Obstacle().model()).fit([demonstrations[i] for i in order])
    assert same_partition(first.labels_[order], other.labels_)
    np.testing.assert_allclose(other.bic_, first.bic_, rtol=1e-6)


def test_skills_of_one_way_are_one_mode():
    bottles = LinearTimeNormalization().fit_transform(few_bottles())
    assert SelectWays(learner(bottle_operators(), upper_body())).fit(bottles).n_ways_ == 1
    for seed in range(2):
        planted = PlantedTask(seed, 2).demonstrations(6)
        assert SelectWays(learner(None, HAND)).fit(planted).n_ways_ == 1


@pytest.mark.parametrize("shifts", [(0.5, -0.5, 0.0), (0.5, 0.8, -0.5), (1.0, 0.5, -0.5, -1.0)])
def test_more_than_two_ways_are_found(shifts):
    labels = np.arange(5 * len(shifts)) % len(shifts)
    selection = SelectWays(learner()).fit(paths(np.array(shifts)[labels]))
    assert same_partition(selection.labels_, labels)


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_a_way_shown_once_is_none():
    assert SelectWays(learner()).fit(paths([0.5] * 9 + [-0.5])).n_ways_ == 1
    assert SelectWays(learner()).fit(paths([0.5] * 8 + [-0.5] * 2)).n_ways_ == 2


def test_what_differs_by_when_it_is_done_is_one_way():
    rng = np.random.default_rng(0)
    closing = np.resize([0.42, 0.48], 12) + 0.002 * rng.normal(size=12)
    gripper = [
        Demonstration(TIME, (TIME / TIME[-1] > when).astype(float)[:, None]) for when in closing
    ]
    assert SelectWays(learner()).fit(gripper).n_ways_ == 1
    assert SelectWays(learner(), shift=0.0).fit(gripper).n_ways_ > 1


def test_what_the_situation_shows_is_one_way():
    """Objects stand in one of two places: a hand that goes there has no choice."""
    rng = np.random.default_rng(0)
    places = [(0.3 * (-1) ** n, 0.4, 0) + 0.01 * rng.normal(size=3) for n in range(10)]
    s = np.sin(np.pi / 2 * TIME / TIME[-1])[:, None]
    going = [Demonstration(TIME, s * place, {"cup": Frame(place)}) for place in places]
    operators = [RelativePosition("hand", "cup"), Canonical()]
    assert SelectWays(learner(operators, POINT)).fit(going).n_ways_ == 1
    assert (
        SelectWays(learner([Canonical()], POINT)).fit(going).n_ways_ == 2
    )  # who does not see it


def test_a_number_of_modes_may_be_given():
    demonstrations = paths([0.5] * 3 + [-0.5] * 3)
    assert SelectWays(learner(), n_ways=1).fit(demonstrations).n_ways_ == 1
    assert SelectWays(learner(), n_ways=3).fit(demonstrations).n_ways_ == 3
    two = SelectWays(learner(), n_ways=2).fit(paths(np.linspace(-1, 1, 6)))
    assert two.labels_.tolist() == [0, 0, 0, 1, 1, 1]
    with pytest.raises(
        DataError, match="3 modes of at least 2 demonstrations each need 6, got 4"
    ):
        SelectWays(learner(), n_ways=3).fit(demonstrations[:4])


def test_units_do_not_matter():
    demonstrations = paths([0.5] * 4 + [-0.5] * 4)
    large = [Demonstration(d.time, 1e3 * d.joints) for d in demonstrations]
    first, other = (SelectWays(learner()).fit(one) for one in (demonstrations, large))
    np.testing.assert_array_equal(first.labels_, other.labels_)
    assert torch.tensor(first.bic_).argmin() == torch.tensor(other.bic_).argmin()

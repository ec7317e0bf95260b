"""Typical mistakes are noticed, each once; good recordings are not."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from sklearn.exceptions import ConvergenceWarning

from tests.support.mistakes import MISTAKES, Mistake
from tests.support.skills import generator, handlings, waves
from tests.support.worlds import upper_body
from tpgmm_datasets import check, load_lerobot
from tpgmm_torch import Demonstration, quaternions
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.checks import check as fit_check
from tpgmm_torch.checks.training import summarize
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, TPGMMError
from tpgmm_torch.robots import Poses

DATA = Path(__file__).parents[4] / "shared" / "data"
needs_recordings = pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here")
TIME = np.arange(100) / 50


def checks(shown, robot=None):
    return [(finding.check, finding.episodes) for finding in check(shown, robot)]


def messages(mistake: Mistake, folder: Path) -> list[str]:
    """Errors of ours, and warnings, that somebody sees who makes the mistake."""
    found = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            mistake.make(folder)
        except TPGMMError as error:
            found.append(str(error))
    kinds = [w for w in caught if not issubclass(w.category, ConvergenceWarning)]
    assert all(issubclass(w.category, PlausibilityWarning) for w in kinds)
    return [*found, *(str(w.message) for w in kinds)]


@pytest.mark.parametrize("mistake", MISTAKES, ids=str)
def test_a_mistake_is_noticed_once_and_by_its_name(mistake, tmp_path):
    [message] = messages(mistake, tmp_path)
    assert re.search(mistake.told, message), message


@pytest.mark.parametrize(
    "spoil", [lambda q: q + 2.5, lambda q: q.flip(1), lambda q: q.roll(3, 1), torch.rad2deg]
)
@pytest.mark.parametrize("named", [True, False])
def test_fit_and_loaders_agree_on_limits_and_order(spoil, named):
    robot, known = upper_body(), ("units", "limits", "order")
    names = robot.joint_names if named else None
    good = generator().demonstrations(3, seed=0)
    shown = [replace(one, joints=spoil(one.joints), joint_names=names) for one in good]
    reports = check(shown, robot), fit_check(summarize(shown, robot), robot)
    one, other = ([str(f) for f in report if f.check in known] for report in reports)
    assert one == other != []


@pytest.mark.parametrize("seed", range(4))
def test_the_generated_skill_is_plausible(seed):
    recorded = generator().demonstrations(10, seed=seed)
    assert checks(recorded, upper_body()) == []
    assert checks(DynamicTimeWarping(robot=upper_body()).fit_transform(recorded)) == []


@pytest.mark.parametrize(
    ("shown", "robot"), [(waves(6), None), (handlings(5), Poses(("left", "right")))]
)
def test_small_skills_are_plausible(shown, robot):
    assert checks(shown, robot) == []


@needs_recordings
def test_real_recordings_are_plausible():
    assert checks(load_lerobot(DATA / "g1_bottle")) == []
    poses = Poses(("left", "right"))
    assert checks(load_lerobot(DATA / "honeytea_bimanual", robot=poses), poses) == []


def test_nothing_is_changed_and_the_warning_names_the_caller():
    given = Demonstration(1000 * TIME, np.sin(TIME)[:, None])
    before = given.time.clone(), given.joints.clone()
    with pytest.warns(PlausibilityWarning, match="time: ") as caught:
        check([given]).act()
    assert caught[0].filename == __file__
    assert torch.equal(given.time, before[0]) and torch.equal(given.joints, before[1])
    with pytest.raises(DataError, match="at least one"):
        check([])


def test_joints_are_checked_in_the_order_of_the_robot():
    recorded = generator().demonstrations(4, seed=0)
    names = recorded[0].joint_names
    turned = [replace(d, joints=d.joints.flip(1), joint_names=names[::-1]) for d in recorded]
    assert checks(turned, upper_body()) == []
    unnamed = [replace(d, joint_names=None) for d in turned]
    assert checks(unnamed, upper_body()) == [("order", ())]


# -- time and events -------------------------------------------------------------------------


def record(n=6, stretch=1.0, **events):
    found = []
    for share in np.linspace(-0.02, 0.02, n):
        at = {name: (when + share) * TIME[-1] for name, when in events.items()}
        found.append(Demonstration(TIME * stretch, np.sin(TIME + share)[:, None], events=at))
    return found


@pytest.mark.parametrize(
    ("stretch", "odd"), [(0.5, False), (20, False), (1000, True), (50, True), (1e-6, True)]
)
def test_steps_of_time_tell_of_units(stretch, odd):
    assert checks(record(stretch=stretch)) == [("time", ())] * odd


def test_durations_of_a_factor_of_two_are_usual_and_of_five_are_not():
    items = record()
    for factor, odd in ((1.5, False), (5.0, True)):
        items[2] = replace(items[2], time=items[0].time * factor)
        assert checks(items) == [("durations", (2,))] * odd
    assert checks([replace(d, time=d.time * (1 + n / 3)) for n, d in enumerate(items)]) == []


def test_events_elsewhere_missing_or_in_another_order():
    good = record(grasp=0.3, lift=0.4)
    assert checks(good) == []
    for wrong in ({"grasp": 1.6, "lift": 1.7}, {"grasp": 0.8, "lift": 0.6}, {"grasp": 0.6}):
        items = [*good[:5], replace(good[5], events=wrong)]
        assert checks(items) == [("events", (5,))]
    rare = [*(replace(d, events={}) for d in good[:4]), *good[4:]]
    assert checks(rare) == []


# -- copies and paths ------------------------------------------------------------------------


def test_copies_are_named_with_the_first():
    shown = waves(4)
    [finding] = check([*shown, shown[1], shown[1]])
    assert finding.episodes == (4, 5) and "demonstration 4 is a copy of 1" in finding.message
    still = replace(shown[0], joints=0 * shown[0].joints)
    assert checks([still, still]) == [("still", ())]


@pytest.mark.parametrize(("count", "reversed_"), [(3, [2]), (4, [0]), (6, [3]), (9, [1, 2, 6])])
def test_motions_that_run_backwards_among_others_are_named(count, reversed_):
    shown = waves(count)
    for n in reversed_:
        shown[n] = replace(shown[n], joints=shown[n].joints.flip(0))
    [finding] = check(shown)
    assert (finding.check, finding.episodes) == ("episodes", tuple(reversed_))
    assert "backwards" in finding.message


def test_there_and_back_has_no_direction():
    there = [replace(d, joints=torch.cat((d.joints, d.joints.flip(0)))[::2]) for d in waves(6)]
    there[3] = replace(there[3], joints=there[3].joints.flip(0))
    assert checks(there) == []


@pytest.mark.parametrize("named", [True, False])
def test_the_sign_of_a_quaternion_makes_no_outlier(named):
    tool, time = Poses(["tool"]), torch.linspace(0, 2, 40, dtype=torch.float64)
    turn = quaternions.exp(time[:, None] * torch.tensor([0.6, 0.0, 0.8]).double())
    shown = []
    for n in range(8):
        tilt = quaternions.exp(torch.tensor([0.02 * n, 0.0, 0.0]).double())
        # as trackers do: w >= 0, and two of them w <= 0
        q = quaternions.product(tilt, turn)
        q = torch.where(q[:, :1] < 0, -q, q) * (-1 if n in (2, 5) else 1)
        joints, names = torch.cat((torch.zeros(40, 3), q), dim=1), tool.joint_names
        shown.append(Demonstration(time, joints, joint_names=names if named else None))
    assert checks(shown, None if named else tool) == []


def test_joints_that_hardly_move_count_little():
    wider = [
        Demonstration(d.time, np.hstack((d.joints, 1e-3 * d.joints[:, :1] + 0.1 * (n == 2))))
        for n, d in enumerate(waves(6))
    ]
    assert checks(wider) == []

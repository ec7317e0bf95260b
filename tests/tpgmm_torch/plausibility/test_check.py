"""Typical mistakes are told, each once; what is right is left in peace."""

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
from tpgmm_datasets import load_lerobot
from tpgmm_torch import Demonstration, Poses
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.exceptions import (
    DataError,
    PlausibilityError,
    PlausibilityWarning,
    ShapeError,
    TPGMMError,
    UnknownNameError,
)
from tpgmm_torch.plausibility.check import check, examine, summarize, summarized

DATA = Path(__file__).parents[4] / "shared" / "data"
needs_recordings = pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here")


def told(mistake: Mistake, folder: Path) -> list[str]:
    """What someone who makes the mistake is told: errors of ours, and warnings."""
    messages = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            mistake.make(folder)
        except TPGMMError as error:
            messages.append(str(error))
    kinds = [w for w in caught if not issubclass(w.category, ConvergenceWarning)]
    assert all(issubclass(w.category, PlausibilityWarning) for w in kinds)
    return [*messages, *(str(w.message) for w in kinds)]


def test_there_are_enough_mistakes_of_each_kind():
    assert len(MISTAKES) >= 75
    groups = {mistake.group for mistake in MISTAKES}
    assert groups >= {"units", "order", "names", "lengths", "quaternions", "frames", "time"}
    assert groups >= {"shapes", "files", "values"}


@pytest.mark.parametrize("mistake", MISTAKES, ids=str)
def test_a_mistake_is_told_once_and_by_its_name(mistake, tmp_path):
    [message] = told(mistake, tmp_path)
    assert re.search(mistake.told, message), message


@pytest.mark.parametrize("seed", range(4))
def test_the_generated_skill_is_plausible(seed):
    recorded = generator().demonstrations(10, seed=seed)
    assert examine(recorded, upper_body()).findings == ()
    aligned = DynamicTimeWarping(robot=upper_body()).fit_transform(recorded)
    assert examine(aligned, upper_body()).findings == ()


@pytest.mark.parametrize(
    ("shown", "robot"), [(waves(5), None), (handlings(5), Poses(("left", "right")))]
)
def test_small_skills_are_plausible(shown, robot):
    assert examine(shown, robot).findings == ()


@needs_recordings
def test_real_recordings_are_plausible():
    assert examine(load_lerobot(DATA / "g1_bottle")).findings == ()
    poses = Poses(("left", "right"))
    hands = load_lerobot(DATA / "honeytea_bimanual", robot=poses)
    assert examine(hands, poses).findings == ()


def test_strictness_makes_errors_of_what_is_unlikely():
    late = [replace(d, time=100 * d.time) for d in waves(4)]
    with pytest.warns(PlausibilityWarning, match="time: ") as caught:
        report = check(late)
    assert len(caught) == 1 and caught[0].filename == __file__
    assert [finding.check for finding in report] == ["time"]
    with pytest.raises(PlausibilityError, match="time: ") as raised:
        check(late, strict=True)
    assert isinstance(raised.value, DataError)


def test_nothing_is_mended():
    time = np.linspace(0, 2, 30)
    given = Demonstration(1000 * time, np.sin(time)[:, None])
    before = given.time.clone(), given.joints.clone()
    with pytest.warns(PlausibilityWarning):
        check([given])
    assert torch.equal(given.time, before[0]) and torch.equal(given.joints, before[1])


def test_joints_are_looked_at_in_the_order_of_the_robot():
    recorded = generator().demonstrations(4, seed=0)
    names = recorded[0].joint_names
    turned = [replace(d, joints=d.joints.flip(1), joint_names=names[::-1]) for d in recorded]
    assert examine(turned, upper_body()).findings == ()
    unnamed = [replace(d, joint_names=None) for d in turned]
    assert [f.check for f in examine(unnamed, upper_body())] == ["order"]


def test_what_does_not_fit_together_is_refused():
    with pytest.raises(ShapeError, match="has 3 joints, the robot has 17"):
        examine(waves(2), upper_body())
    with pytest.raises(UnknownNameError, match="'waist_roll' is not in"):
        names = tuple(f"joint{n}" for n in range(17))
        examine([replace(generator().demonstrations(1)[0], joint_names=names)], upper_body())
    with pytest.raises(DataError, match="at least one"):
        check([])


def test_batches_are_looked_at_as_they_pass():
    shown, seen = waves(5), []
    batches = summarized([shown[:2], shown[2:]], None, seen)
    assert len(next(batches)) == 2 and len(seen) == 2
    assert len(next(batches)) == 3
    assert [e.digest for e in seen] == [e.digest for e in summarize(shown, None)]

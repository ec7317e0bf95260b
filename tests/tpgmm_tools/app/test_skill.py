"""What the buttons do."""

import warnings
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support import skills
from tests.support.recordings import Recording
from tests.support.worlds import upper_body
from tpgmm_tools.app.skill import learn, moved, remarks, show
from tpgmm_torch import Demonstration, Frame, Situation, TaskParameterizedGMM, quaternions
from tpgmm_torch.data.tables import read_table
from tpgmm_torch.exceptions import DataError, PlausibilityError, UnknownNameError


@pytest.fixture(scope="module")
def skill():
    return learn(skills.generator().demonstrations(3), upper_body(), 8)


def test_it_learns_all_hands_in_all_frames(skill):
    assert skill.model.n_components_ == 8
    assert skill.report.startswith("Learned 3 demonstrations of ")
    assert "- `position:l_hand@bottle + " in skill.report
    assert "- `canonical`" in skill.report
    assert len(skill.situations) == 3


def test_the_bottle_is_grasped_where_it_is_put(skill, tmp_path):
    before = skill.situations[0]
    x, y, z = before.frames["bottle"].position.tolist()
    trajectory, report = show(skill, before, tmp_path)
    there = moved(before, {"bottle": (x - 0.02, y + 0.03, z + 0.01, 0)})
    other, _ = show(skill, there, tmp_path)
    links = skill.model.kinematics_
    hands = [links.state(one.joints).position("l_hand") for one in (trajectory, other)]
    grasp = (hands[0] - before.frames["bottle"].position).norm(dim=-1).argmin()
    np.testing.assert_allclose(
        hands[1][grasp] - hands[0][grasp], (-0.02, 0.03, 0.01), atol=0.005
    )
    assert "s of motion" in report and "times as far" in report


def test_what_there_is_to_take_away_says_the_same(skill, tmp_path):
    trajectory, _ = show(skill, skill.situations[0], tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "model.zip", "motion.csv", "motion.html"
    ]  # fmt: skip
    bottle = skill.situations[0].frames["bottle"].position
    shown = Recording(tmp_path / "motion.html").pose("/frames/bottle", 0)
    np.testing.assert_allclose(shown[:3], bottle, atol=1e-6)
    table = read_table(tmp_path / "motion.csv")
    names = list(trajectory.joint_names)
    np.testing.assert_allclose(table[names], trajectory.joints, atol=1e-12)
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        archive.extractall(tmp_path / "again")
    again = TaskParameterizedGMM.load(tmp_path / "again" / "model")
    [same] = again.predict([skill.situations[0]])
    np.testing.assert_allclose(same.joints, trajectory.joints, atol=1e-9)


def test_objects_are_turned_about_the_vertical_through_them():
    lying = Frame([0.1, 0.2, 0.3], quaternions.exp(torch.tensor([0.0, np.pi / 2, 0.0])))
    situation = Situation([0.0], {"cup": lying})
    frame = moved(situation, {"cup": ("0.4", 0, 1, 90)}).frames["cup"]
    np.testing.assert_allclose(frame.position, (0.4, 0, 1))
    point = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    expected = quarter @ (lying.transform(point) - lying.position).numpy()
    np.testing.assert_allclose(frame.transform(point) - frame.position, expected, atol=1e-12)


@pytest.mark.parametrize(
    "place", [(1, 2, 3), (1, 2, 3, None), (1, 2, 3, "a"), (1, 2, 3, float("nan"))]
)
def test_a_place_that_is_none_is_refused(place):
    situation = Situation([0.0], {"cup": Frame([0.1, 0.2, 0.3])})
    with pytest.raises(DataError, match="cup: a place is x, y, z in metres and a turn"):
        moved(situation, {"cup": place})


def test_objects_that_move_or_are_not_there_cannot_be_placed():
    moving = Frame(np.zeros((5, 3)))
    situation = Situation([0.0], {"cup": Frame([0.1, 0, 0]), "belt": moving})
    for name in ("belt", "mug"):
        with pytest.raises(UnknownNameError, match=rf"{name}.*cup"):
            moved(situation, {name: (0, 0, 0, 0)})


def test_what_cannot_be_is_an_error_and_what_is_unlikely_a_remark():
    shown = skills.generator().demonstrations(3)
    degrees = [
        Demonstration(d.time, d.joints.rad2deg(), dict(d.frames), d.joint_names) for d in shown
    ]
    with pytest.raises(PlausibilityError, match="degrees"):
        learn(degrees, upper_body(), 4)
    far = [
        replace(one, frames={"bottle": Frame(one.frames["bottle"].position + 4.0)})
        for one in shown
    ]
    remarked = learn(far, upper_body(), 4).report
    assert "**To be looked at:**\n- " in remarked and "'bottle'" in remarked


def test_remarks_are_collected_once_and_not_printed(recwarn):
    with remarks() as texts:
        for _ in range(2):
            warnings.warn("odd\n  thing", UserWarning, stacklevel=1)
        warnings.warn("for programmers", DeprecationWarning, stacklevel=1)
    assert texts == ["odd thing"]
    assert not len(recwarn)

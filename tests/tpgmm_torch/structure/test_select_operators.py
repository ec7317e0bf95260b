"""Which operators matter: found where it is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.carrying import carries
from tests.support.planted import HAND, PlantedTask, told
from tests.support.skills import waves
from tests.support.worlds import upper_body
from tpgmm_torch import (
    AbsolutePosition,
    Canonical,
    Demonstration,
    Frame,
    RelativePosition,
    SelectOperators,
    Stack,
)
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.robots import Poses
from tpgmm_torch.structure.select_operators import candidate_operators
from tpgmm_torch.training.hold_detection import attach_holds, with_holds


def relative(selection):
    """Texts of what was kept and refers to a frame."""
    texts = {
        format_operator(selection.candidates_[j]) for j in np.flatnonzero(selection.support_)
    }
    return {text for text in texts if "@" in text}


@pytest.mark.parametrize("n_relevant", [1, 2])
def test_what_was_planted_is_found_among_eight_frames_and_nothing_else(n_relevant):
    hits = wrong = missed = 0
    for seed in range(4):
        task = PlantedTask(seed, n_relevant)
        found = relative(SelectOperators(robot=HAND).fit(task.demonstrations(5)))
        hits, wrong = hits + len(found & told(task)), wrong + len(found - told(task))
        missed += len(told(task) - found)
    assert 2 * hits / (2 * hits + wrong + missed) >= 0.95


@pytest.mark.parametrize("seed", range(3))
def test_two_of_three_that_agree_by_chance_hide_no_frame(seed):
    """Without the third, the cup seems to matter after the hand has left it, too."""
    hand = Poses(["hand"], orientation=False)
    rng, time = np.random.default_rng(seed), np.linspace(0, 1, 50)
    at_cup = np.clip(np.minimum(time / 0.3, (0.5 - time) / 0.15), 0, 1)[:, None]
    cups = rng.uniform(-0.3, 0.3, (3, 3))
    cups[1] = cups[0] + 0.002 * rng.normal(size=3)
    shown = []
    for cup in cups:
        home = [0, 0, 0.5] + 0.005 * rng.normal(size=3)
        path = (1 - at_cup) * home + at_cup * cup + 0.001 * rng.normal(size=(50, 3))
        shown.append(Demonstration(time, path, {"cup": Frame(cup)}, hand.joint_names))
    found = SelectOperators(robot=hand).fit(shown)
    assert relative(found) == {"position:hand@cup"}


@pytest.fixture(scope="module")
def task():
    return PlantedTask(0, 2)


@pytest.fixture(scope="module")
def selection(task):
    return SelectOperators(robot=HAND).fit(task.demonstrations(5))


def test_it_says_when_an_operator_matters(selection, task):
    """The first frame while the hand rests at it, the second later."""
    texts = [format_operator(one) for one in selection.candidates_]
    assert selection.relevance_.shape == (len(selection.time_), len(texts))
    first, second = (texts.index(f"position:hand@{name}") for name in task.relevant)
    peaks = selection.time_[selection.relevance_.argmax(0)]
    assert 3.0 < peaks[first] < 6.5 < peaks[second] < 11.5
    dropped = selection.relevance_[:, ~selection.support_].mean(0)
    assert dropped.max() < selection.threshold < selection.relevance_.mean(0)[first]


def test_it_says_why(selection, task):
    judged = {format_operator(one.operator): one for one in selection.judgements_}
    kept = judged[f"position:hand@{task.relevant[0]}"]
    assert kept.kept and kept.unit == "mm" and kept.error < 15 < 100 < kept.error_of_others
    other = next(name for name in "abcdefgh" if name not in task.relevant)
    dropped = judged[f"orientation:hand@{other}"]
    assert not dropped.kept and dropped.unit == "deg"
    assert dropped.error > dropped.error_of_others
    lines = selection.report().splitlines()
    assert len(lines) == 1 + len(selection.candidates_)
    assert sum(line.startswith("kept") for line in lines) == selection.support_.sum()


def test_what_refers_to_one_frame_is_stacked_and_joints_come_last(selection, task):
    *tasks, joints = selection.operators_
    assert joints == Canonical()
    assert [one.references()[0] for one in tasks] == list(task.relevant)
    assert all(isinstance(one, Stack) and len(one.operators) == 2 for one in tasks)


def test_turning_and_moving_the_world_changes_nothing(selection, task):
    """Gains do not depend on the base frame, but for what stands in it."""
    world = Frame([0.4, -0.3, 0.7], np.array([0.6, -0.2, 0.5, 0.59]) / np.sqrt(0.9981))
    moved = []
    for one in task.demonstrations(5):
        state = HAND.state(one.joints)
        frames = {name: world.compose(frame) for name, frame in one.frames.items()}
        joints = Poses.joints({"hand": world.compose(state.pose("hand"))})
        moved.append(replace(one, joints=joints, frames=frames))
    again = SelectOperators(robot=HAND).fit(moved)
    np.testing.assert_array_equal(again.support_, selection.support_)


def test_the_sign_of_a_quaternion_means_nothing(selection, task):
    shown = task.demonstrations(5)
    frames = {name: Frame(f.position, -f.orientation) for name, f in shown[1].frames.items()}
    joints = shown[2].joints.clone()
    joints[:, 3:] *= -1
    shown[1], shown[2] = replace(shown[1], frames=frames), replace(shown[2], joints=joints)
    again = SelectOperators(robot=HAND).fit(shown)
    np.testing.assert_allclose(again.relevance_, selection.relevance_, atol=1e-8)


def test_of_two_frames_that_are_one_only_one_is_kept():
    """A tray on a table that moves with it says nothing more."""
    task = PlantedTask(3, 1)
    [name], shown = task.relevant, task.demonstrations(5)
    on_it = Frame([0.1, 0.0, 0.05])
    shown = [
        replace(one, frames={name: one.frames[name], "tray": one.frames[name].compose(on_it)})
        for one in shown
    ]
    found = SelectOperators(robot=HAND).fit(shown)
    kinds = sorted(text.partition(":")[0] for text in relative(found))
    assert kinds == ["orientation", "position"]
    spare = [one for one in found.judgements_ if not one.kept and one.operator.references()]
    assert all(one.alone > found.threshold > one.gain for one in spare)


def test_what_a_hand_carries_is_found_as_a_thing():
    """However it was grasped, the bottle stands in the same place on the tray."""
    found = SelectOperators(robot=upper_body()).fit(attach_holds(carries(6), upper_body()))
    assert {"position:bottle@tray", "position:l_hand@bottle"} <= relative(found)
    assert "position:l_hand@tray" not in relative(found)
    free = SelectOperators(robot=upper_body()).fit(with_holds(carries(6), ()))
    assert not any("bottle@tray" in format_operator(one) for one in free.candidates_)


def test_joints_that_matter_are_found_in_groups():
    """One joint repeats its motion, the other wanders."""
    rng, time = np.random.default_rng(0), torch.linspace(0, 2, 60, dtype=torch.float64)
    shown = []
    for one in waves(5, 60):
        steps = torch.from_numpy(rng.normal(size=60)).cumsum(0) * 0.2
        shown.append(
            replace(
                one,
                time=time,
                joints=torch.stack((one.joints[:, 0], steps), 1),
                joint_names=("steady", "idle"),
            )
        )
    groups = [Canonical(joints=["steady"]), Canonical(joints=["idle"])]
    found = SelectOperators(groups).fit(shown)
    assert found.operators_ == (groups[0],)


def test_candidates_are_all_links_in_all_frames(task):
    shown = task.demonstrations(3)[0]
    shown = replace(shown, frames={"a": shown.frames["a"]})
    texts = [format_operator(one) for one in candidate_operators(Poses(["l", "r"]), shown)]
    kinds = ("position", "orientation")
    places = ("l", "r", "l@a", "r@a", "r@l")
    assert texts == ["canonical", *(f"{kind}:{place}" for place in places for kind in kinds)]
    shown = replace(shown, frames={"a": shown.frames["a"], "b": shown.frames["a"]})
    free = candidate_operators(Poses(["l", "r"]), shown)
    [carried] = with_holds([shown], [Hold("a", "l"), Hold("b", "r")])
    held = candidate_operators(Poses(["l", "r"]), carried)[len(free) :]
    # of two that are held, each seen from the other as it is held
    places = ("a@b", "b@a", "a@held:b", "b@held:a")
    assert [format_operator(one) for one in held] == [
        f"{k}:{at}" for at in places for k in kinds
    ]
    shown = replace(shown, frames={"a": shown.frames["a"]})
    points = candidate_operators(Poses(["l"], orientation=False), shown)
    assert points == [Canonical(), AbsolutePosition("l"), RelativePosition("l", "a")]
    assert candidate_operators(None, shown) == [Canonical()]


def test_two_demonstrations_are_too_few(task):
    with pytest.raises(DataError, match="at least 3, got 2; name the operators"):
        SelectOperators(robot=HAND).fit(task.demonstrations(2))


def test_candidates_that_do_not_fit_are_refused(task):
    candidates = [Canonical(), RelativePosition("hand", "lid")]
    with pytest.raises(UnknownNameError, match="frame 'lid' is not in the demonstration"):
        SelectOperators(candidates, HAND).fit(task.demonstrations(3))

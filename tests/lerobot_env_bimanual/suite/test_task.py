"""What the tasks of the suite have in common: experts that vary within bounds."""

import math

import numpy as np
import pytest
import torch

from lerobot_env_bimanual.bottle.conditions import skill
from lerobot_env_bimanual.suite import handover, peg_in_hole, pour
from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.names import MORE, OBSTRUCTED, SUITE
from lerobot_env_bimanual.suite.task import (
    BOW,
    START,
    STRETCH,
    Box,
    Leg,
    Style,
    hands_along,
)
from lerobot_env_bimanual.suite.tasks import TASKS, suite_task
from tests.support.suite_expert import TRIED
from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_evaluation.benchmarks import BENCHMARKS
from tpgmm_torch import Frame, TaskParameterizedGMM
from tpgmm_torch.exceptions import UnknownNameError

#: The sum of all angles of a demonstration by the upper body, without regard to sign [rad].
TOTALS = {
    "handover": 1111.8646806073698,
    "lid": 1016.4567192942939,
    "peg_in_hole": 492.2491393930438,
    "pour": 1125.6969080842707,
    "wipe": 1182.953066188302,
}
BOX = Box((0.2, -0.1, 0.1), (0.3, 0.1, 0.2), 20.0)


@pytest.fixture(scope="module")
def motions():
    return suite_task("handover").demonstrations(5, seed=2, rate=10)


def test_a_demonstration_is_the_same_without_the_others(motions):
    [alone] = suite_task("handover").demonstrations(5, seed=2, rate=10, only=[3])
    assert torch.equal(alone.time, motions[3].time) and alone.events == motions[3].events
    assert torch.allclose(alone.joints, motions[3].joints, rtol=0, atol=1e-9)


def test_names_are_those_that_are_known_without_mujoco():
    assert {*TASKS} == {*SUITE, *MORE, *OBSTRUCTED} and {*SUITE} <= {*BENCHMARKS}
    assert list(SUITE) == sorted(SUITE)
    with pytest.raises(UnknownNameError, match="handover"):
        suite_task("juggle")


@pytest.mark.parametrize("robot", TRIED)
@pytest.mark.parametrize("name", SUITE)
def test_a_task_hangs_together(name, robot):
    task, env = suite_task(name, robot), SuiteEnv(name, robot)
    env.reset(seed=0)
    assert task.name == name and task.objects == SUITE[name]
    assert set(task.draw(np.random.default_rng(0))) == set(task.objects)
    assert task.grasp in task.phases
    assert set(task.figures) == set(env.figures())
    for hold in task.holds:
        # what is held may be a part of an object, like a lid
        assert hold.hand in HANDS and env._scene.gap(hold) > 0.02
    for orientation in (False, True):
        for held in (False, True):
            operators = task.operators(orientation, held)
            TaskParameterizedGMM(task.robot, operators)
    first = env._start.poses[task.objects[0]]
    assert task.usual(first) and first[2] - task.foot == pytest.approx(env._scene.table)
    # the same draws, however an episode begins
    given = env.reset(seed=4, options={task.objects[0]: first})[0]["agent_pos"]
    np.testing.assert_array_equal(env.reset(seed=4)[0]["agent_pos"], given)


@pytest.mark.parametrize(("name", "total"), sorted(TOTALS.items()))
def test_what_the_upper_body_demonstrates_is_what_was_published(name, total):
    [shown] = suite_task(name).demonstrations(2, seed=1, rate=10, only=[0])
    assert float(shown.joints.abs().sum()) == pytest.approx(total, rel=1e-9)


def test_a_seed_says_all():
    task = suite_task("handover")
    same, again = (task.demonstrations(2, seed=3, rate=5) for _ in range(2))
    [other, _] = task.demonstrations(2, seed=4, rate=5)
    for one, two in zip(same, again, strict=True):
        assert torch.equal(one.joints, two.joints) and one.events == two.events
    assert not torch.equal(same[0].joints[0], other.joints[0])


def test_demonstrations_take_up_to_a_fifth_more_or_less(motions):
    task = suite_task("handover")
    whole = sum(task.phases.values())
    times = sorted(float(motion.time[-1]) / whole for motion in motions)
    np.testing.assert_allclose(
        times, np.linspace(1 - STRETCH, 1 + STRETCH, 5), atol=0.1 / whole
    )
    assert task.duration >= whole * (1 + STRETCH) + 1
    for motion in motions:
        assert list(motion.events) == list(task.phases)
        assert all(np.diff(list(motion.events.values())) > 0)


def test_demonstrations_begin_around_the_neutral_posture(motions):
    away = torch.stack([motion.joints[0] for motion in motions]) - skill().neutral_posture()
    assert float(away.abs().max()) <= START and float(away.std()) > START / 4


def test_nobody_does_it_twice_in_the_same_manner(motions):
    """The wrists' ways differ in the middle, and not where they have to be."""
    task = suite_task("handover")
    poses = {
        name: torch.cat((frame.position, frame.orientation)).numpy()
        for name, frame in motions[0].frames.items()
    }
    best = task.nominal(poses, motions[0].joints[0].numpy(), rate=10)
    assert best.events == pytest.approx(task.ends())

    def hand(motion, instant):
        joints = motion.joints[round(10 * instant)]
        return task.robot.state(joints).position("l_hand")

    def before(motion, begin, end):
        return (motion.events[begin] + motion.events[end]) / 2

    def apart(*phases):
        halfway = [hand(motion, before(motion, *phases)) for motion in (best, motions[0])]
        return float(torch.linalg.vector_norm(halfway[0] - halfway[1]))

    assert apart("hold", "bring") > 0.005
    assert apart("close", "hold") < 0.001


def test_without_style_the_expert_is_at_its_best():
    none, drawn = Style.none(2, 17), Style.draw(2, 17, np.random.default_rng(0))
    for name, value in vars(none).items():
        assert not value.any() and vars(drawn)[name].any()
        assert value.shape == vars(drawn)[name].shape


def standing(*position):
    return Frame(torch.tensor([position], dtype=torch.float64))


STARTS = {hand: standing(0.0, 0.0, 0.0) for hand in HANDS}


def ways(legs, times, bow):
    """Positions of the left hand at shares of the phase ``go``, then ``on``."""
    out = []
    for time in times:
        progress = {
            "go": torch.tensor([min(time, 1.0)], dtype=torch.float64),
            "on": torch.tensor([max(time - 1.0, 0.0)], dtype=torch.float64),
        }
        out.append(hands_along(STARTS, {"r_hand": [], "l_hand": legs}, progress, bow)[0])
    return torch.cat([frame.position for frame in out])


def test_ways_bend_aside_in_free_space_and_nowhere_else():
    target, end = standing(0.2, 0.0, 0.0), standing(0.2, 0.0, 0.1)
    bow = torch.zeros((1, 2, 3), dtype=torch.float64)
    bow[:, 0, 1] = 0.03
    free = [Leg("go", target, free=True), Leg("on", end)]
    times = np.linspace(0, 2, 2001)
    bent, straight = (ways(free, times, by) for by in (bow, 0 * bow))
    bump = (bent - straight)[:, 1]
    assert bump[0] == 0 and bump[1000:].abs().max() < 1e-12
    assert float(bump[500]) == pytest.approx(0.03)
    speed = torch.diff(bump) * 1000
    assert speed[[0, 999, 1000]].abs().max() < 1e-4 < speed.abs().max()
    torch.testing.assert_close(straight[1000], target.position[0])
    torch.testing.assert_close(straight[-1], end.position[0])
    # the other hand's is not this hand's
    assert torch.equal(ways(free, times, bow.flip(1)), straight)
    held = [Leg("go", target), Leg("on", end)]
    assert torch.equal(ways(held, times, bow), straight)


@pytest.mark.parametrize(
    ("name", "hand", "thing", "grips", "phase"),
    [
        ("handover", "l_hand", "baton", handover.GRIP, "raise"),
        ("handover", "l_hand", "baton", handover.GRIP, "bring"),
        ("handover", "r_hand", "baton", handover.GRIP, "carry"),
        ("pour", "l_hand", "jug", pour.GRIP, "raise"),
        ("pour", "l_hand", "jug", pour.GRIP, "bring"),
        ("pour", "r_hand", "cup", pour.GRIP, "lift"),
    ],
)
def test_what_is_carried_stays_off_the_highest_table(name, hand, thing, grips, phase):
    """However low ways bend, but for one in forty."""
    task = suite_task(name)
    rng = np.random.default_rng(0)
    drawn = max((task.draw(rng) for _ in range(200)), key=lambda one: one[task.objects[0]][2])
    poses = {each: Frame(*np.split(pose[None], [3], axis=1)) for each, pose in drawn.items()}
    style = Style.none(1, 17)
    style.bow[..., 2] = -2 * BOW
    legs = task.legs(STARTS, poses, style)
    before = list(task.phases)[: list(task.phases).index(phase)]
    progress = {
        each: torch.tensor([each in before], dtype=torch.float64) for each in task.phases
    }
    heights = []
    for share in torch.linspace(0, 1, 101, dtype=torch.float64):
        both = hands_along(STARTS, legs, {**progress, phase: share[None]}, style.bow)
        heights.append(float(both[HANDS.index(hand)].position[0, 2]))
    # of what is held, above where it stood on the table
    heights = np.subtract(heights, grips[hand][2] + drawn[thing][2])
    assert min(heights) > -1e-6 and max(heights) > 0.03


def test_a_leg_can_be_a_way():
    target = standing(0.2, 0.0, 0.0)

    def circle(done):
        angle = 2 * math.pi * done
        position = torch.stack((done * 0, 1 - angle.cos(), angle.sin()), dim=-1)
        return Frame(position + target.position)

    legs = [Leg("go", target), Leg("on", circle)]
    bow = torch.zeros((1, 2, 3), dtype=torch.float64)
    seen = ways(legs, (1.0, 1.25, 1.5), bow)
    wanted = torch.tensor([(0.2, 0, 0), (0.2, 1, 1), (0.2, 2, 0)], dtype=torch.float64)
    torch.testing.assert_close(seen, wanted, atol=1e-12, rtol=0)


def test_upright_poses_stand_in_their_box_and_others_do_not():
    rng = np.random.default_rng(0)
    poses = np.array([BOX.draw(rng) for _ in range(200)])
    assert all(BOX.contains(pose) for pose in poses)
    low, high = np.array(BOX[:2])
    assert np.all(poses[:, :3].min(0) < low + 0.1 * (high - low))
    assert np.all(poses[:, :3].max(0) > high - 0.1 * (high - low))
    np.testing.assert_allclose(np.linalg.norm(poses[:, 3:], axis=1), 1)
    turn = np.degrees(2 * np.arcsin(poses[:, 6]))
    assert -20 <= turn.min() < -17 and 17 < turn.max() <= 20 and not poses[:, 4:6].any()
    pose = np.array((0.25, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0))
    assert BOX.contains(pose)
    assert BOX.contains(pose * ([1] * 3 + [-1] * 4))  # the same orientation
    for index, value in ((0, 0.31), (1, -0.11), (2, 0.21)):
        assert not BOX.contains(np.where(np.arange(7) == index, value, pose))
    for axis, angle in ((6, 21.0), (6, -21.0), (6, 180.0), (4, 1.0), (5, 1.0)):
        turned = pose.copy()
        half = math.radians(angle) / 2
        turned[3], turned[axis] = math.cos(half), math.sin(half)
        assert not BOX.contains(turned)


@pytest.mark.parametrize(
    ("name", "other", "side", "aside", "lower"),
    [
        ("handover", "stand", 1, 0.0, suite_task("handover").foot),
        ("peg_in_hole", "block", -1, 0.06, peg_in_hole.LENGTH - peg_in_hole.HEIGHT),
        ("pour", "jug", -1, 0.0, pour.CUP_HALF - pour.JUG_HALF),
    ],
)
def test_two_objects_stand_on_one_table_each_on_its_side(name, other, side, aside, lower):
    task, rng = suite_task(name), np.random.default_rng(0)
    for _ in range(50):
        poses = task.draw(rng)
        first, second = poses[task.objects[0]], poses[other]
        assert task.usual(first) and not task.usual(second)
        assert second[2] == pytest.approx(first[2] - lower)
        assert side * first[1] > aside and -side * second[1] > aside

"""Opening a lid that the other hand steadies, and what can go wrong with it."""

import numpy as np
import pytest
import torch

from lerobot_env_bimanual.bottle.measures import successful
from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.lid import AREA
from lerobot_env_bimanual.suite.tasks import suite_task
from tests.support.suite_expert import replay
from tpgmm_torch import Demonstration

TASK = suite_task("lid")
RATE = 50


@pytest.fixture(scope="module")
def examples() -> list[Demonstration]:
    return TASK.demonstrations(2, seed=3, rate=float(RATE))


def done(motion: Demonstration, joints=None) -> dict[str, float]:
    """The figures of an episode that follows a motion, or other joints in its place."""
    info = replay(SuiteEnv("lid", fps=RATE), motion, joints)
    assert info["is_success"] == successful(info, TASK.figures)
    return info


def between(motion: Demonstration, first: str, last: str) -> slice:
    """The time steps of a part of a motion."""
    begin, end = (round(motion.events[name] * RATE) for name in (first, last))
    return slice(begin, end)


@pytest.mark.parametrize("index", [0, 1])
def test_the_expert_opens_the_lid_and_shuts_it(examples, index):
    figures = done(examples[index])
    assert figures["is_success"], figures
    assert 86 < figures["opened_deg"] < 94 and figures["kept_s"] > 2.2
    # on the circle nothing pulls, and the box stays where it is
    assert figures["pull_n"] < 5 and figures["box_mm"] < 1 and figures["shut_deg"] < 1


def test_the_chord_in_place_of_the_circle_pulls_the_box_away_or_loses_the_grip(examples):
    motion = examples[0]
    joints, part = motion.joints.numpy().copy(), between(motion, "hold", "open")
    # wide of the circle: as if the hinge were 4 cm higher, where the hand is half way
    robot, way = TASK.robot, np.sin(np.linspace(0, np.pi, part.stop - part.start))
    for step, share in zip(range(part.start, part.stop), way, strict=True):
        state = robot.state(torch.from_numpy(joints[step]))
        lift = torch.linalg.pinv(state.linear_jacobian("r_hand")[:, 10:]) @ torch.tensor(
            (0.0, 0.0, 0.04 * share), dtype=torch.float64
        )
        joints[step, 10:] += lift.numpy()
    figures = done(motion, joints)
    assert not figures["is_success"] and figures["pull_n"] > 20
    assert figures["box_mm"] > 5 or not figures["grips"]


def test_a_lid_that_is_opened_for_a_moment_was_not_kept_open(examples):
    motion = examples[0]
    part = between(motion, "open", "keep")
    joints = np.delete(motion.joints.numpy(), part, axis=0)
    figures = done(motion, joints)
    assert figures["opened_deg"] > 80 and figures["kept_s"] < 2
    assert not figures["is_success"]


def test_a_lid_that_stays_open_is_not_shut(examples):
    motion = examples[0]
    figures = done(motion, motion.joints.numpy()[: between(motion, "open", "keep").stop])
    assert figures["kept_s"] > 2 and figures["shut_deg"] > 80
    assert figures["grips"] and not figures["is_success"]


def test_a_hand_that_misses_the_knob_opens_nothing(examples):
    motion = examples[0]
    joints = motion.joints.numpy().copy()
    joints[:, 10:] = joints[0, 10:]
    figures = done(motion, joints)
    assert figures["opened_deg"] < 1 and not figures["grips"] and not figures["is_success"]


def test_boxes_stand_where_the_task_is_meant_for_them_and_the_seed_says_where():
    rng = np.random.default_rng(0)
    drawn = [TASK.draw(rng)["box"] for _ in range(50)]
    assert all(map(TASK.usual, drawn)) and not TASK.usual(drawn[0] + np.eye(7)[1])
    positions = np.array(drawn)[:, :3]
    assert (np.ptp(positions, axis=0) > 0.8 * np.subtract(AREA.highest, AREA.lowest)).all()
    again = TASK.draw(np.random.default_rng(0))["box"]
    np.testing.assert_array_equal(again, drawn[0])

"""A baton that changes hands, and what can go wrong with it."""

from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.tasks import suite_task
from tests.support.suite_expert import replay

TASK = suite_task("handover")


def test_the_left_hand_opens_when_the_right_one_holds():
    [motion, *_] = TASK.demonstrations(3, seed=3, rate=50.0)
    env = SuiteEnv("handover", fps=50, noise=0.5)
    for event, hand in zip(("bring", "pass"), TASK.holds, strict=True):
        replay(env, motion, seconds=motion.events[event])
        assert env._scene.held == {hand}

"""The rate of actions in the observations of environments."""

from lerobot.envs.factory import make_env_config

import lerobot_env_bimanual  # noqa: F401  registers the environment
from lerobot_env_bimanual.control_rate import CONTROL_RATE, rate_processors
from tests.support.policies import batch


def test_observations_hold_the_rate():
    before, after = rate_processors(50)
    assert before(batch())[CONTROL_RATE].tolist() == [[50.0], [50.0]]
    assert not after.steps
    before, _ = make_env_config("bottle_shaking", fps=25).get_env_processors()
    assert before(batch())[CONTROL_RATE][0, 0] == 25

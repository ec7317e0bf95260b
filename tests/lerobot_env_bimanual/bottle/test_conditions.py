"""What differs between episodes: drawn from the seed, or chosen."""

import gymnasium as gym
import numpy as np
import pytest

import lerobot_env_bimanual  # noqa: F401  registers the environment
from lerobot_env_bimanual.bottle.conditions import skill
from tpgmm_torch.exceptions import DataError, ShapeError


def made(**options):
    return gym.make("lerobot_env_bimanual/BottleShaking-v0", **options).unwrapped


def test_the_seed_alone_gives_the_start():
    situation = skill().situations(1, seed=7)[0]
    starts = []
    for options in ({}, {"fps": 25}, {"mode": "kinematic"}, {"pushes": True, "noise": 1.0}):
        env = made(**options)
        env.reset(seed=3)  # another episode before it
        env.reset(seed=7)
        starts.append(env._start)
    for start in starts:
        np.testing.assert_array_equal(start.joints, situation.joints)
        place = situation.frames["bottle"].position
        np.testing.assert_array_equal(start.poses["bottle"][:3], place)
        assert repr(start) == repr(starts[0])
    env.reset()
    assert not np.array_equal(env._start.joints, situation.joints)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"joints": np.zeros(14)}, ShapeError, "joints needs 17 values"),
        ({"joints": np.full(17, np.nan)}, DataError, "not finite"),
        ({"joints": np.full(17, 1.0)}, DataError, "l_elbow is out of its range by 1 rad"),
        ({"bottle": np.zeros(7)}, DataError, "unit quaternion"),
        ({"bottle": np.zeros(3)}, ShapeError, "bottle needs 7 values"),
    ],
)
def test_an_impossible_start_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        made().reset(seed=0, options=options)

"""Meta-World itself: in its own environment alone, `make metaworld`."""

import numpy as np
import pytest

pytest.importorskip("metaworld", reason="Meta-World has an environment of its own")

from lerobot_env_bimanual.metaworld.demonstrations import record_metaworld
from lerobot_env_bimanual.metaworld.hand import FRAMES
from lerobot_env_bimanual.metaworld.state import MetaworldStateEnv
from lerobot_env_bimanual.metaworld.tasks import TASKS


def test_the_tasks_are_those_of_the_library():
    import metaworld

    assert sorted(metaworld.ALL_V3_ENVIRONMENTS) == list(TASKS)


def test_a_seed_is_a_situation_and_observations_are_in_order():
    env = MetaworldStateEnv("pick-place-v3")
    first, _ = env.reset(seed=3)
    other, _ = env.reset(seed=4)
    again, _ = env.reset(seed=3)
    for name, values in first.items():
        assert np.allclose(values, again[name])
        assert not np.allclose(values, other[name]) or name == "agent_pos"
    poses = first["environment_state"].reshape(len(FRAMES), 7)
    assert np.allclose(poses[:, 3:], (1, 0, 0, 0))
    assert np.allclose(poses[0, :3], env.raw[4:7])
    assert np.allclose(poses[1], (0, 0, 0, 1, 0, 0, 0))  # there is one object
    assert np.allclose(poses[2, :3], env.raw[36:39])
    assert np.allclose(first["agent_pos"], env.raw[:4])


def test_references_bring_the_target_there_and_no_further_than_its_limits():
    env = MetaworldStateEnv("reach-v3")
    env.reset(seed=0)
    reference = np.array([0.1, 0.7, 0.2, 0.0])
    for _ in range(20):
        env.step(reference)
    assert np.allclose(env.target, reference[:3], atol=1e-9)
    for _ in range(100):
        env.step([0.1, 0.7, -1.0, 0.0])
    assert env.target[2] == pytest.approx(env.action_space.low[2])


@pytest.mark.parametrize("task", ["reach-v3", "handle-pull-v3"])
def test_an_expert_played_back_by_its_references_succeeds(task):
    env = MetaworldStateEnv(task, control="displacement", stop_at_success=False)
    [shown] = record_metaworld(env, [5])
    assert shown.success
    assert len(shown.observed) == len(shown.references) == len(shown.actions)
    env.control = "reference"
    env.reset(seed=5)
    for reference in shown.references:
        *_, info = env.step(reference)
    assert info["is_success"]

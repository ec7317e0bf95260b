"""Wrenches of hands as observations, objects that are not where they are seen, and a policy."""

import numpy as np
import pytest
import torch

from lerobot_env_bimanual import BimanualConfig
from lerobot_env_bimanual.disturbances import Course, parse_condition
from lerobot_env_bimanual.record import demonstrate_forces
from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.pressing import wiping
from tpgmm_torch import quaternions


@pytest.fixture(scope="module")
def shown():
    [one] = demonstrate_forces("wipe", 1, fps=25)
    return one


def test_a_demonstration_presses_along_the_normal_of_the_board(shown):
    turn = quaternions.conjugate(shown.frame("board").orientation)
    force = quaternions.rotate(turn, shown.wrenches["r_hand"][:, :3]).numpy()
    wipes = (shown.time > 5.0) & (shown.time < 8.0)
    assert (force[wipes, 2] < -2).all()
    assert np.abs(force[wipes, :2]).max() < 0.1
    assert not force[shown.time < 2.5].any()


def test_a_wrench_has_the_moments_of_its_contacts_about_the_hand(shown):
    env = SuiteEnv(**BimanualConfig(task="wipe", force=True, fps=25).gym_kwargs)
    pose = torch.cat((shown.frame("board").position, shown.frame("board").orientation))
    env.reset(seed=0, options={"board": pose.numpy(), "joints": shown.joints[0].numpy()})
    for joints in shown.joints[1:140]:
        seen, *_ = env.step(joints.numpy())
    model, data = env._simulation()
    assert env.observation_space.contains(seen)
    force, moment = np.split(seen["wrench.r_hand"], 2)
    assert np.linalg.norm(force) > 2
    points = [c.pos for c in data.contact if model.geom("sponge").id in c.geom]
    moments = np.cross(np.array(points) - data.body("r_hand").xpos, force)
    assert (moments.min(0) - 1e-6 <= moment).all()
    assert (moment <= moments.max(0) + 1e-6).all()


def test_observing_forces_changes_nothing_else():
    seen = []
    for force in (False, True):
        env = SuiteEnv("wipe", fps=25, force=force, noise=1.0)
        first, _ = env.reset(seed=3)
        later, *_ = env.step(first["agent_pos"])
        seen.append({k: v for k, v in later.items() if not k.startswith("wrench.")})
    assert seen[0].keys() == seen[1].keys()
    assert all(np.array_equal(seen[0][key], seen[1][key]) for key in seen[0])


@pytest.mark.parametrize(
    ("condition", "height", "angle"),
    [("lower", -0.005, 0), ("higher", 0.005, 0), ("tilted", 0, 3)],
)
def test_an_object_is_not_where_it_is_seen(condition, height, angle):
    [part] = parse_condition(condition)
    rng = np.random.default_rng(0)
    part = part.draw(rng, Course(1.0, 2.0, 3.0), lambda step: True)
    turn = rng.normal(size=4)
    turn /= np.linalg.norm(turn)
    true = np.array([0.1, 0.2, 0.3, *turn])
    thought = part.observe(true, true, 0.0, rng)
    back = quaternions.conjugate(torch.from_numpy(turn))
    local = quaternions.rotate(back, torch.from_numpy(true - thought)[:3])
    np.testing.assert_allclose(local, [0, 0, height], atol=1e-12)
    twist = quaternions.product(back, torch.from_numpy(thought[3:]))
    error = quaternions.log(twist).rad2deg().numpy()
    assert np.linalg.norm(error) == pytest.approx(angle)
    assert error[2] == pytest.approx(0)


def test_a_policy_reads_the_wrench():
    model, actions = wiping(), []
    board = torch.tensor([[0.4, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0]])
    for press in (8.0, 20.0):
        policy = TPGMMPolicy.from_estimator(model, fps=50)
        state = torch.tensor([[0.4, 0.0, 0.4]])
        for _ in range(150):
            observed = {
                "observation.state": state,
                "observation.environment_state": board,
                "observation.wrench.hand": torch.tensor([[0, 0, -press, 0, 0, 0]]),
            }
            state = policy.select_action(observed)
        actions.append(float(state[0, 2]))
    assert actions[1] > actions[0] + 5e-3

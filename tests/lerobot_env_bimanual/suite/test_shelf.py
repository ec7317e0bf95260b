"""A shelf in the way of what was learned: a policy that knows it goes around."""

import numpy as np
import pytest
import torch
from lerobot.envs import preprocess_observation

from lerobot_env_bimanual.record import expert
from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.pick_place import SHELF
from lerobot_env_bimanual.suite.tasks import suite_task
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tpgmm_control.obstacles import Scene
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.exceptions import UnknownNameError

TASK, FPS = suite_task("shelf"), 25


@pytest.fixture(scope="module")
def model():
    """Of demonstrations without the shelf."""
    shown = suite_task("pick_place").demonstrations(4, seed=0, rate=FPS)
    aligned = DynamicTimeWarping(robot=TASK.robot).fit_transform(shown)
    operators = TASK.operators(held=False)
    return TaskParameterizedGMM(15, operators, TASK.robot, random_state=0).fit(aligned)


def done(model, seed, **options):
    """The last ``info`` of an episode."""
    parts = ("x", "y", "z", "qw", "qx", "qy", "qz")
    names = [f"{name}.{part}" for name in TASK.objects for part in parts]
    policy = TPGMMPolicy.from_estimator(model, fps=FPS, environment_names=names, **options)
    env, over = SuiteEnv("shelf", fps=FPS), False
    seen, _ = env.reset(seed=seed)
    with torch.inference_mode():
        while not over:
            action = policy.select_action(preprocess_observation(seen))
            seen, _, _, over, info = env.step(action[0].numpy())
    return info


def test_what_is_learned_leads_through_the_shelf_and_the_policy_around_it(model):
    blind, led = done(model, 103), done(model, 103, obstacles=f"{SHELF}:visuals")
    assert blind["inside_mm"] > 20 and not blind["is_success"]
    # all else is well done
    assert blind["put"] and blind["place_mm"] < 8 and blind["home_mm"] < 50
    assert led["inside_mm"] == 0 and led["is_success"]


def test_nobody_demonstrates_it():
    with pytest.raises(UnknownNameError, match=r"shelf.*pick_place"):
        expert("shelf")


def test_the_environment_shows_what_the_policy_reads():
    scene, env = Scene(TASK.robot, SHELF, visuals=True), SuiteEnv("shelf", fps=FPS)
    env.reset(seed=0)
    model, data = env._scene.model, env._scene.data
    own = np.flatnonzero(model.geom_bodyid == model.body("a shelf").id)
    boards = [one for one in scene.shapes if one.name == "shelf"]
    assert len(own) == len(boards) > 1
    for geom, board in zip(own, boards, strict=True):
        np.testing.assert_allclose(data.geom_xpos[geom], board.pose.position, atol=1e-12)
        np.testing.assert_allclose(model.geom_size[geom], board.size)
        assert not model.geom_contype[geom] and not model.geom_conaffinity[geom]
        assert model.geom_rgba[geom, 3] == 1 and model.geom_group[geom] == 0


def test_depths_are_those_of_the_scene_of_the_policy():
    scene, env = Scene(TASK.robot, SHELF, visuals=True), SuiteEnv("shelf", fps=FPS)
    env.reset(seed=0)
    rng, found = np.random.default_rng(0), []
    for _ in range(40):
        joints = 0.6 * rng.uniform(TASK.robot.lower, TASK.robot.upper)
        env._scene.place(joints, 0.0)
        near = scene.distances(joints[None])
        nearest = min(float(d.min()) for pair, d in near.items() if "shelf" in pair)
        found.append(max(0.0, -nearest))
        assert env._scene.depth("a shelf") == pytest.approx(found[-1], abs=1e-5)
    assert max(found) > 0.01

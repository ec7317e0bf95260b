"""Rendered cameras see tags where they are, and nothing is simulated otherwise."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from lerobot.envs import (
    env_to_policy_features,
    make_env,
    make_env_config,
    preprocess_observation,
)

import lerobot_env_bimanual  # noqa: F401  registers the environments
from lerobot_env_bimanual.bottle.carrying import CarryAndPutEnv
from lerobot_env_bimanual.bottle.shaking import BottleShakingEnv
from lerobot_env_bimanual.bottle.torque import AWAY, BottleTorqueEnv
from lerobot_env_bimanual.eyes import rig as rigs
from lerobot_env_bimanual.eyes.carriers import cube_at, flat_at
from lerobot_env_bimanual.eyes.cells import cell_of
from lerobot_env_bimanual.eyes.lens import usual_camera
from lerobot_env_bimanual.eyes.rig import Rig, View, looking
from lerobot_env_bimanual.eyes.views import CENTRE, VIEWS, around, chosen_views
from lerobot_env_bimanual.rendering import offscreen
from lerobot_env_bimanual.suite.env import SuiteEnv
from tpgmm_torch.exceptions import DataError, DependencyError, UnknownNameError
from tpgmm_vision.cell import cell_from
from tpgmm_vision.detection.tags import TagDetector
from tpgmm_vision.poses import inverse, transform

pytestmark = pytest.mark.skipif(offscreen() is None, reason="nothing can be drawn here")

SUITE = ("handover", "lid", "peg_in_hole", "pour", "wipe")
TASKS = {"bottle_shaking": BottleShakingEnv, "carry_and_put": CarryAndPutEnv}
TASKS |= {name: partial(SuiteEnv, name) for name in SUITE}


def rms_of_corners(rig, picture, camera):
    """Between the corners that are found and those that are where the tags are [pixels]."""
    found = TagDetector()(picture).corners
    camera_from_base = inverse(rig.camera_pose(camera))
    apart = {}
    for body, carrier in rig.carriers.items():
        pose = camera_from_base @ rig.pose(body) @ carrier.pose
        for number, corners in carrier.target.corners.items():
            if number in found:
                wanted = rig.lens.camera.project(transform(pose, corners))
                apart[number] = float(np.sqrt(np.square(found[number] - wanted).mean()))
    return apart


@pytest.mark.parametrize("task", TASKS)
def test_tags_are_seen_where_they_are(task):
    env = TASKS[task](fps=25, cameras="front,side")
    observation, _ = env.reset(seed=3)
    rig, numbers = env.eyes, set()
    for camera, picture in observation["pixels"].items():
        assert picture.shape == (480, 640, 3)
        apart = rms_of_corners(rig, picture, camera)
        assert max(apart.values()) < 1.0 and np.median(list(apart.values())) < 0.05
        numbers |= set(apart)
    for body, carrier in rig.carriers.items():
        assert numbers & set(carrier.target.corners), f"no tag of {body} is seen"
    env.close()


def test_the_cell_is_that_of_the_scene_and_what_is_estimated_is_there():
    env = gym.make("lerobot_env_bimanual/CarryAndPut-v0", cameras="side,front", fps=25)
    observation, _ = env.reset(seed=0)
    cell = cell_from(cell_of(env))
    assert cell.joints == env.unwrapped.joint_names
    assert list(cell.cameras) == ["side", "front"]
    poses = observation["environment_state"].reshape(-1, 7)
    for (name, thing), true in zip(cell.objects.items(), poses, strict=True):
        target = env.unwrapped.eyes.carriers[name].pose
        np.testing.assert_allclose(target @ thing.pose, np.eye(4), atol=1e-6)
        assert thing.upright == (name == "tray")
        assert np.isfinite(true).all()
    assert cell.cameras["front"].camera == usual_camera()
    np.testing.assert_allclose(cell.cameras["front"].pose, VIEWS["front"].pose, atol=1e-6)
    env.close()


def test_cameras_change_nothing_that_is_simulated():
    options = {"fps": 50, "noise": 1.0, "pushes": True, "condition": "moved+pose-noise"}
    plain, seeing = (
        SuiteEnv("pour", **options, **more)
        for more in ({}, {"cameras": "front", "camera_width": 64, "camera_height": 48})
    )
    pairs = [(env.reset(seed=7)[0], env) for env in (plain, seeing)]
    rng = np.random.default_rng(0)
    for _ in range(30):
        (one, _), (other, _) = pairs
        assert set(other) - set(one) == {"pixels"}
        for key, values in one.items():
            np.testing.assert_array_equal(values, other[key])
        action = one["agent_pos"] + rng.uniform(-0.05, 0.05, len(one["agent_pos"]))
        pairs = [(env.step(action)[0], env) for _, env in pairs]
    seeing.close()


def test_pictures_follow_from_the_seed_and_move_with_the_robot():
    def seen(steps):
        env = BottleShakingEnv(fps=25, cameras="front", camera_width=160, camera_height=120)
        observation, _ = env.reset(seed=5)
        for _ in range(steps):
            observation, *_ = env.step(observation["agent_pos"] + 0.02)
        env.close()
        return observation["pixels"]["front"].astype(int)

    first, same, later = seen(0), seen(0), seen(10)
    np.testing.assert_array_equal(first, same)
    assert np.abs(later - first).max() > 50


@pytest.mark.parametrize("kind", ["bottle_shaking", "carry_and_put", "bimanual"])
def test_lerobot_sees_the_cameras(kind):
    config = make_env_config(
        kind, fps=25, cameras="front,side", camera_width=80, camera_height=60,
        observe_objects=False, episode_length=2,
    )  # fmt: skip
    shapes = {key: value.shape for key, value in env_to_policy_features(config).items()}
    assert shapes.pop("action") == shapes.pop("observation.state")
    keys = "observation.images.front", "observation.images.side"
    assert shapes == dict.fromkeys(keys, (3, 60, 80))
    [[vector]] = [list(tasks.values()) for tasks in make_env(config, n_envs=2).values()]
    observation, _ = vector.reset(seed=[0, 1])
    batch = preprocess_observation(observation)
    assert batch["observation.images.front"].shape == (2, 3, 60, 80)
    assert "observation.environment_state" not in batch
    vector.close()


def test_without_cameras_features_are_those_of_states():
    config = make_env_config("bottle_shaking", fps=25)
    states = {"observation.state", "observation.environment_state"}
    assert set(env_to_policy_features(config)) == {"action"} | states


def test_unknown_cameras_are_refused():
    with pytest.raises(UnknownNameError, match=r"'top'.*front"):
        BottleShakingEnv(cameras="front,top")
    with pytest.raises(UnknownNameError, match="top"):
        make_env_config("bimanual", cameras="top")
    with pytest.raises(DataError, match="cameras='front'"):
        cell_of(BottleShakingEnv())
    assert list(chosen_views("['front', side]")) == list(chosen_views(("front", "side")))


def test_a_camera_on_a_link_goes_with_it():
    env = BottleShakingEnv(fps=25)
    env.reset(seed=0)
    hand = pose = env.rig("front").pose("r_hand")
    pose = inverse(hand) @ looking(hand[:3, 3] + (0.5, -0.2, 0.4), (0.3, 0.0, 0.2))
    rig = Rig(env._scene, {"wrist": View(pose, "r_hand")}, {"bottle": cube_at(10, z=0.2)})
    entry = cell_from(rig.content()).cameras["wrist"]
    assert entry.link == "r_hand"
    rng, seen = np.random.default_rng(0), []
    for move in (0.0, 0.1):
        joints = env._scene.joints
        joints[list(env.joint_names).index("waist_yaw")] += move
        env._scene.place(joints, 0.0)
        seen.append(rms_of_corners(rig, rig.pictures(rng)["wrist"], "wrist"))
    assert all(one and max(one.values()) < 0.3 for one in seen)
    rig.close()


def test_what_is_moved_in_the_model_is_moved_in_the_picture():
    env = BottleTorqueEnv(obstacle=1.0)
    env.reset(seed=0)
    rig = env.rig("front", (160, 120))
    env._scene.clear()
    rng = np.random.default_rng(0)
    without = rig.pictures(rng)["front"].astype(int)
    assert tuple(env._scene.model.geom_pos[env._scene._obstacle]) == AWAY
    env._scene.block((0.5, -0.2, 0.2))
    assert np.abs(rig.pictures(rng)["front"] - without).max() > 80
    rig.close()


def test_bodies_that_are_not_there_are_named():
    env = BottleShakingEnv(fps=25)
    with pytest.raises(DataError, match=r"no bodies \['cup'\].*bottle"):
        Rig(env._scene, dict(VIEWS), {"cup": flat_at(3, 0.1, 0.0)})


def test_where_nothing_can_be_drawn_that_is_an_error(monkeypatch):
    monkeypatch.setattr(rigs, "offscreen", lambda: None)
    env = BottleShakingEnv(fps=25, cameras="front")
    with pytest.raises(DependencyError, match="libegl1"):
        env.reset(seed=0)


def test_a_view_looks_at_its_point_from_so_far():
    pose = around(CENTRE, 0.8, 30.0, 40.0).pose
    [seen] = transform(inverse(pose), [CENTRE])
    np.testing.assert_allclose(seen, (0, 0, 0.8), atol=1e-12)
    assert pose[2, 3] == pytest.approx(CENTRE[2] + 0.8 * np.sin(np.radians(40)))
    assert abs(pose[2, 0]) < 1e-12, "the horizon is level"

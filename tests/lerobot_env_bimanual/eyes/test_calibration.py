"""Postures that show tags in a hand to a camera."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_env_bimanual.bottle.shaking import BottleShakingEnv
from lerobot_env_bimanual.eyes import calibration
from lerobot_env_bimanual.eyes.calibration import chain_of, varied_postures
from lerobot_env_bimanual.eyes.carriers import cube_at
from lerobot_env_bimanual.eyes.rig import looking
from lerobot_env_bimanual.eyes.views import View
from lerobot_env_bimanual.rendering import offscreen
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.detection.tags import TagDetector

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(offscreen() is None, reason="nothing can be drawn here"),
]

TAGS = {"r_hand": cube_at(40, y=0.04)}


@pytest.fixture(scope="module")
def env():
    """At its start posture."""
    env = BottleShakingEnv(fps=25)
    env.reset(seed=0)
    return env


def test_the_joints_that_move_a_link_are_those_of_its_chain(env):
    rig = env.rig("front", carriers=TAGS, objects={})
    moved = [env.joint_names[one] for one in chain_of(rig.scene, "r_hand")]
    assert moved == [name for name in env.joint_names if not name.startswith("l_")]


def test_all_postures_show_the_tags_and_turn_the_hand_about_all_axes(env, monkeypatch):
    monkeypatch.setattr(calibration, "DRAWN", 3000)
    rig = env.rig("front", carriers=TAGS, objects={})
    before = env._scene.joints
    postures = varied_postures(rig, "r_hand", 8, np.random.default_rng(0))
    np.testing.assert_array_equal(env._scene.joints, before)
    detector, rng, seen, turns = TagDetector(), np.random.default_rng(0), 0, []
    for posture in postures:
        env._scene.place(posture, 0.0)
        turns.append(Rotation.from_matrix(rig.pose("r_hand")[:3, :3]))
        found = detector(rig.pictures(rng)["front"]).corners
        seen += bool(found.keys() & set(TAGS["r_hand"].target.corners))
    env._scene.place(before, 0.0)
    rig.close()
    assert seen >= 7
    apart = [(one.inv() * other).as_rotvec() for one in turns for other in turns]
    assert np.linalg.svd(np.array(apart), compute_uv=False).min() > 2.0
    assert (np.degrees([np.linalg.norm(one) for one in apart]) > 20).mean() > 0.7


def test_a_camera_that_looks_away_is_refused(env, monkeypatch):
    monkeypatch.setattr(calibration, "DRAWN", 200)
    away = View(looking((1.0, 0.0, 0.5), (2.0, 0.0, 0.5)))
    rig = env.rig("front", carriers=TAGS, objects={})
    rig.views = {"front": away}
    with pytest.raises(DataError, match="0 show the tags of r_hand"):
        varied_postures(rig, "r_hand", 3, np.random.default_rng(0))

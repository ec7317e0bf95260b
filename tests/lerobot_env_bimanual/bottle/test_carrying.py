"""The carrying environment: what is seen, when hands close and open, how it is judged."""

import numpy as np
import pytest

import lerobot_env_bimanual  # noqa: F401  registers the environment
from lerobot_env_bimanual.bottle.carrying import CarryAndPutEnv, carrying
from lerobot_env_bimanual.disturbances import Displaced, Stopped
from tests.support.bottle_expert import nominal
from tpgmm_torch import Frame
from tpgmm_torch.exceptions import DataError, ShapeError

FPS = 25


def follow(env, path, seconds, seed=0, **options):
    """Observations while a path is followed by the clock."""
    seen = [env.reset(seed=seed, options=options)[0]]
    for k in range(round(seconds * env.fps)):
        observation, *_, info = env.step(path[min(k + 1, len(path) - 1)])
        seen.append(observation)
    return seen, info


def path_of(env, seed=0, **options):
    env.reset(seed=seed, options=options)
    return nominal(env)


@pytest.mark.parametrize("mode", ["dynamic", "kinematic"])
def test_the_bottle_slides_is_held_and_put_down(mode):
    env = CarryAndPutEnv(fps=FPS, mode=mode)
    path = path_of(env)
    seen, _ = follow(env, path, 15)
    start, poses = env._start, np.array([o["environment_state"] for o in seen])
    bottle, tray = poses[:, :7], poses[:, 7:]
    np.testing.assert_array_equal(tray, np.broadcast_to(start.poses["tray"], tray.shape))
    # while the hands close it slides in its own direction, and no more while it is carried
    first = Frame(start.poses["bottle"][:3], start.poses["bottle"][3:])
    forwards = first.inverse_transform(Frame(bottle[:, :3], bottle[:, 3:]).position)
    assert forwards[round(4.0 * FPS), 0] == pytest.approx(0, abs=1e-3)
    assert forwards[round(4.7 * FPS), 0] == pytest.approx(start.slide[0], abs=1e-3)
    height = bottle[:, 2] - start.poses["bottle"][2]
    # under position control the arms give way by 1 to 3 mm under its weight
    assert height[round(7 * FPS)] == pytest.approx(0.05, abs=3e-3)
    assert height[-1] == pytest.approx(0, abs=1e-3)
    figures = env.figures()
    assert figures["standing"] == 1 and figures["put_mm"] < 1 and figures["put_deg"] < 0.1
    assert not env._scene.held
    # the hands have left and it stands where it was put
    np.testing.assert_allclose(bottle[-1], bottle[round(11 * FPS)], atol=1e-3)


def test_who_expects_no_slide_misses_by_it():
    env = CarryAndPutEnv(fps=FPS, mode="kinematic")
    path = path_of(env, slide=np.zeros(2))
    for slide in ((0.03, 0.0), (-0.02, 0.1)):
        follow(env, path, 15, slide=np.array(slide))
        figures = env.figures()
        assert figures["put_mm"] == pytest.approx(1e3 * abs(slide[0]), abs=0.1)
        assert figures["put_deg"] == pytest.approx(np.degrees(slide[1]), abs=0.1)
        assert figures["standing"] == 1 and not env._successful(figures)


def test_hands_that_stay_in_the_air_do_not_put_it_down():
    env = CarryAndPutEnv(fps=FPS, mode="kinematic")
    path = path_of(env)
    follow(env, path[: round(8 * FPS)], 15)
    assert env._scene.held and env.figures()["standing"] == 0


def test_a_bottle_that_is_lost_is_not_taken_again():
    env = CarryAndPutEnv(fps=FPS, mode="kinematic")
    path = path_of(env).copy()
    elbow = env.joint_names.index("l_shoulder_yaw")
    since = round(6 * FPS)
    path[since:, elbow] += np.minimum(np.arange(len(path) - since) * 0.03, 0.4)
    follow(env, path, 15)
    assert not env._scene.held and env.figures()["standing"] == 0


@pytest.mark.parametrize(("moment", "held"), [(5.0, False), (8.0, True), (11.0, True)])
def test_pushed_back_it_is_held_as_it_was(moment, held):
    env = CarryAndPutEnv(fps=FPS, condition=(Displaced(-2.0, moment=moment),), mode="kinematic")
    path = path_of(env)
    seen, _ = follow(env, path, moment)
    before, now = seen[round((moment - 2) * FPS)], seen[-1]
    np.testing.assert_allclose(now["environment_state"], before["environment_state"], atol=1e-9)
    assert bool(env._scene.held) == held and not env._put


def test_nothing_slides_while_the_robot_is_stopped():
    env = CarryAndPutEnv(fps=FPS, condition=(Stopped(1.0, moment=4.28),), mode="kinematic")
    path = path_of(env)
    seen, _ = follow(env, path, 5.2)
    poses = np.array([o["environment_state"][:3] for o in seen])
    still = poses[round(4.32 * FPS) : round(5.28 * FPS)]
    assert np.ptp(still, axis=0).max() < 1e-9
    assert 0.001 < np.linalg.norm(still[0] - poses[0]) < abs(env._start.slide[0])


def test_a_start_can_be_chosen_and_impossible_ones_are_refused():
    env = CarryAndPutEnv(fps=FPS)
    tray = np.array([0.3, -0.03, 0.0, 1.0, 0.0, 0.0, 0.0])
    observation, _ = env.reset(seed=0, options={"tray": tray, "slide": [0.01, 0.0]})
    np.testing.assert_array_equal(observation["environment_state"][7:], tray)
    assert env._start.slide.tolist() == [0.01, 0.0]
    with pytest.raises(DataError, match="tray is x, y, z and a unit quaternion"):
        env.reset(options={"tray": np.zeros(7)})
    with pytest.raises(ShapeError, match="slide needs 2 values"):
        env.reset(options={"slide": [0.01]})


def test_situations_are_those_of_the_generator():
    env = CarryAndPutEnv()
    env.reset(seed=7)
    [situation] = carrying().situations(1, seed=7)
    np.testing.assert_array_equal(env._start.joints, situation.joints)
    place = situation.frames["bottle"].position
    np.testing.assert_array_equal(env._start.poses["bottle"][:3], place)
    slides = []
    for seed in range(100):
        env.reset(seed=seed)
        slides.append(env._start.slide)
        tray = env._start.poses["tray"]
        assert tray[2] == pytest.approx(env._start.poses["bottle"][2] - 0.11)
    spread = np.ptp(slides, axis=0)
    assert 0.055 < spread[0] <= 0.06 and np.radians(18) < spread[1] <= np.radians(20)

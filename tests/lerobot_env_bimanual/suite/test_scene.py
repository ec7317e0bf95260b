"""The simulated world of the suite: hands that hold, let go, and are put back."""

import math

import mujoco
import numpy as np
import pytest

from lerobot_env_bimanual.bottle.conditions import skill
from lerobot_env_bimanual.robot_scene import (
    OBJECT,
    TABLE,
    Hold,
    RobotScene,
    add_table,
    add_thing,
    robot_spec,
)

LEFT = Hold("l_hand", "rod", "rod")
RIGHT = Hold("r_hand", "rod", "rod")
JOINTS = skill().neutral_posture().numpy()
MASS, GRAVITY = 0.2, 9.81


def at(*position):
    return np.array([*position, 1.0, 0.0, 0.0, 0.0])


@pytest.fixture
def scene():
    """A thin rod, and a cube on a shelf that cannot be moved, far from the table."""
    spec, kinds = robot_spec(), mujoco.mjtGeom
    add_table(spec, 0.7)
    rod = {"type": kinds.mjGEOM_CYLINDER, "size": (0.01, 0.06, 0)}
    add_thing(spec, "rod").add_geom(name="rod", mass=MASS, contype=0, conaffinity=TABLE, **rod)
    box = {"type": kinds.mjGEOM_BOX, "size": (0.02, 0.02, 0.02), "mass": MASS}
    for name, free in (("cube", True), ("shelf", False)):
        thing = add_thing(spec, name, free=free)
        thing.add_geom(name=f"{name} box", contype=OBJECT, conaffinity=OBJECT, **box)
    return RobotScene(spec, ("rod", "cube", "shelf"), (LEFT, RIGHT))


def beside(scene, hand="l_hand", off=0.02):
    """A pose of the rod beside a hand at the neutral posture."""
    state = skill().robot.state(JOINTS)
    sign = 1 if hand == "r_hand" else -1
    offset = np.array((0, sign * off, 0.02))
    return at(*(state.position(hand).numpy() + offset))


def begin(scene, **poses):
    usual = {"rod": beside(scene), "cube": at(1, 1, 1.04), "shelf": at(1, 1, 1.0)}
    scene.reset({**usual, **poses}, JOINTS, -1.0)


def wait(scene, seconds):
    scene.follow(np.tile(JOINTS, (round(1000 * seconds) + 1, 1)))


def seen_from_hand(scene, hand="l_hand"):
    body, rod = scene.data.body(hand), scene.data.body("rod")
    return body.xmat.reshape(3, 3).T @ (rod.xpos - body.xpos)


def test_what_is_observed_stands_where_it_is_put(scene):
    begin(scene, shelf=at(0.5, 0.5, 0.5), cube=at(0.9, 0.1, 0.2))
    np.testing.assert_allclose(scene.pose("shelf"), at(0.5, 0.5, 0.5))
    np.testing.assert_allclose(scene.pose("cube"), at(0.9, 0.1, 0.2))
    poses = [scene.pose(name) for name in ("rod", "cube", "shelf")]
    np.testing.assert_array_equal(scene.objects, poses)
    assert scene.table == -1.0
    np.testing.assert_array_equal(scene.joints, JOINTS)


def test_a_hand_carries_what_it_holds_and_nothing_else(scene):
    begin(scene)
    before = seen_from_hand(scene)
    scene.hold(LEFT)
    assert scene.held == scene.taken == {LEFT}
    wait(scene, 1.0)
    np.testing.assert_allclose(seen_from_hand(scene), before, atol=1e-3)
    assert scene.pull(LEFT) == pytest.approx(MASS * GRAVITY, rel=0.02)
    assert scene.pull(RIGHT) == 0
    scene.let_go(LEFT)
    assert not scene.held and scene.taken == {LEFT}
    wait(scene, 0.2)
    fallen = np.linalg.norm(seen_from_hand(scene) - before)
    assert fallen == pytest.approx(GRAVITY * 0.2**2 / 2, rel=0.05)
    assert scene.pull(LEFT) == 0


def test_a_light_thing_that_is_held_beside_its_middle_does_not_hang_down(scene):
    begin(scene)
    scene.hold(LEFT)
    wait(scene, 1.0)
    w = abs(scene.pose("rod")[3])
    assert math.degrees(2 * math.acos(min(1.0, w))) < 1.0


def test_a_palm_touches_what_it_is_told_to(scene):
    gaps = []
    for off in (0.05, 0.08):
        begin(scene, rod=beside(scene, off=off))
        gaps.append(scene.gap(LEFT))
    assert gaps[1] - gaps[0] == pytest.approx(0.03, abs=3e-3)  # the palm is turned a little
    assert scene.gap(RIGHT) > 0.2
    begin(scene, rod=beside(scene, "r_hand", off=0.05))
    assert scene.gap(RIGHT) == pytest.approx(gaps[0], abs=1e-6)  # as in a mirror
    begin(scene, rod=beside(scene, off=0.0))
    assert scene.gap(LEFT) < 0


def test_a_thing_presses_on_what_it_stands_on(scene):
    begin(scene)
    wait(scene, 0.5)
    assert scene.touch("cube box", "shelf box") == pytest.approx(MASS * GRAVITY, rel=0.01)
    weight = scene.force("cube", "shelf")
    np.testing.assert_allclose(weight, (0, 0, -MASS * GRAVITY), atol=0.02)
    np.testing.assert_allclose(scene.force("shelf", "cube"), -weight)
    assert scene.touch("rod", "shelf box") == 0
    assert not scene.force("rod", "shelf").any()


def test_put_back_the_world_is_what_it_was(scene):
    begin(scene)
    scene.hold(LEFT)
    wait(scene, 0.1)
    snapshot, poses = scene.snapshot(), [pose.copy() for pose in scene.objects]
    lying = seen_from_hand(scene)
    scene.let_go(LEFT)
    wait(scene, 0.3)
    scene.put("rod", beside(scene, "r_hand"))
    scene.put("shelf", at(0.2, 0.2, 0.2))
    scene.hold(RIGHT)
    scene.restore(snapshot)
    scene.rest()
    assert scene.held == scene.taken == {LEFT}
    for pose, before in zip(scene.objects, poses, strict=True):
        np.testing.assert_allclose(pose, before, atol=1e-12)
    wait(scene, 0.3)
    np.testing.assert_allclose(seen_from_hand(scene), lying, atol=1e-3)
    assert scene.pull(RIGHT) == 0


def test_an_episode_begins_with_empty_hands(scene):
    begin(scene)
    scene.hold(LEFT)
    wait(scene, 0.1)
    begin(scene)
    assert not scene.held and not scene.taken
    assert scene.data.time == 0 and not scene.data.qvel.any()
    wait(scene, 0.2)
    assert scene.pull(LEFT) == 0
    assert scene.pose("rod")[2] < beside(scene)[2] - 0.1

"""A policy that keeps clear of obstacles."""

import pytest

from tests.support.policies import act, batch, changed, played
from tests.support.skills import bottle_demonstrations
from tpgmm_control.obstacles import Scene
from tpgmm_torch.exceptions import DataError

STEPS = 100
WORLD = "<mujoco><worldbody><geom name='ball' size='0.03' pos='{}'/></worldbody></mujoco>"


def test_a_policy_keeps_clear_of_the_obstacles_of_a_file(tmp_path):
    shown = bottle_demonstrations()[5:6]
    observed, file, robot = batch(shown), tmp_path / "scene.xml", played().kinematics
    options = {"obstacles": f"{file}:visuals"}
    free = act(played(), observed, STEPS)
    place = robot.state(free[0, STEPS // 2].double()).position("l_hand").tolist()
    file.write_text(WORLD.format(" ".join(map(str, place))))
    led = act(changed(played(), **options), observed, STEPS)
    scene = Scene(robot, file, visuals=True)
    flat = (x.reshape(-1, robot.n_joints).double() for x in (free, led))
    nearest = [min(d.min() for p, d in scene.distances(x).items() if "ball" in p) for x in flat]
    assert nearest[0] < 0 < nearest[1]
    # nothing is near, and arms are as they were shown; but some ticks of 0.1 s could not be
    # stopped before the robot's own base and torso
    file.write_text(WORLD.format("3 0 0"))
    alike = (act(changed(played(), **options), observed, STEPS) == free).all(-1)
    assert alike.sum() > 0.9 * STEPS and alike[..., STEPS // 2 :].all()
    with pytest.raises(DataError, match="only visuals"):
        act(changed(played(), obstacles=str(file)), observed, 2)

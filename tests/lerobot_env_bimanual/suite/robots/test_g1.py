"""A Unitree G1 at the suite's table: it is that of the URDF, from the pelvis up."""

import re
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from lerobot_env_bimanual.suite.robots import g1
from lerobot_env_bimanual.suite.robots.embodiments import embodiment
from tests.support.robot_zoo import G1_JOINTS, G1_PATH
from tpgmm_torch.exceptions import DependencyError

LEGS = re.compile(r"(hip|knee|ankle)")


def test_links_move_as_pinocchio_says_seen_from_the_pelvis():
    robot, model = embodiment("g1").robot, embodiment("g1").spec().compile()
    assert robot.joint_names == G1_JOINTS
    theirs, data = pin.buildModelFromUrdf(str(G1_PATH)), mujoco.MjData(model)
    seen, rng = theirs.createData(), np.random.default_rng(0)
    lower, upper = (limit.numpy() for limit in (robot.lower, robot.upper))
    wrists = [f"{side}_wrist_yaw_link" for side in g1.SIDES]
    for joints in rng.uniform(lower, upper, (5, robot.n_joints)):
        positions = pin.neutral(theirs)
        for name, value in zip(G1_JOINTS, joints, strict=True):
            positions[theirs.joints[theirs.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(theirs, seen, positions)
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        for wrist in wrists:
            there = seen.oMf[theirs.getFrameId(wrist)]
            body = data.body(wrist)
            np.testing.assert_allclose(body.xpos, there.translation + g1.BASE, atol=1e-9)
            np.testing.assert_allclose(body.xmat.reshape(3, 3), there.rotation, atol=1e-9)


def test_ranges_and_masses_are_those_of_the_urdf_without_the_legs():
    model = embodiment("g1").spec().compile()
    robot, tree = embodiment("g1").robot, ElementTree.parse(G1_PATH).getroot()
    masses = {
        link.get("name"): float(link.find("inertial/mass").get("value"))
        for link in tree.iter("link")
        if link.find("inertial") is not None
    }
    kept = {name: mass for name, mass in masses.items() if not LEGS.search(name)}
    assert 20 < len(kept) < len(masses)
    for name, mass in kept.items():
        assert model.body(name).mass == pytest.approx(mass)
    assert sum(model.body_mass) == pytest.approx(sum(kept.values()))
    for joint in tree.iter("joint"):
        if joint.get("name") in robot.joint_names:
            column, limit = robot.joint_names.index(joint.get("name")), joint.find("limit")
            assert float(robot.lower[column]) == float(limit.get("lower"))
            assert float(robot.upper[column]) == float(limit.get("upper"))
            assert float(robot.velocity[column]) == float(limit.get("velocity"))


def test_without_the_package_it_says_what_to_install(monkeypatch):
    def missing(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(g1, "distribution", missing)
    for make in (g1.g1_robot, g1.g1_spec):
        with pytest.raises(DependencyError, match=r"g1 needs example-robot-data: pip install"):
            make()


def test_a_version_without_the_robot_is_told(monkeypatch, tmp_path):
    old = SimpleNamespace(locate_file=lambda path: Path(tmp_path, path))
    monkeypatch.setattr(g1, "distribution", lambda name: old)
    with pytest.raises(DependencyError, match=r"not in this version .*g1_29dof.*--upgrade"):
        g1.g1_robot()

"""Inertia and bias are those of MuJoCo, of MJCF and URDF."""

import mujoco
import numpy as np
import pytest
import torch

from tests.support.torque_arm import LIMITS, POSTURE, Simulation, dynamics, mjcf, robot
from tpgmm_control.torque import MujocoDynamics
from tpgmm_torch import Robot
from tpgmm_torch.exceptions import DataError, UnknownNameError

URDF = """<robot name="fork"><link name="base"/>
<link name="a"><visual><geometry><mesh filename="nowhere.stl"/></geometry></visual><inertial>
<origin xyz="0.1 0 0.2"/><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0"
 iyz="0"/></inertial></link>
<link name="b"><inertial><mass value="1"/><inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0"
 ixz="0" iyz="0"/></inertial></link>
<joint name="lead" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="1" effort="7"/></joint>
<joint name="follow" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.4"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="1" effort="3"/>
<mimic joint="lead" multiplier="-0.5" offset="0.1"/></joint></robot>"""


def test_inertia_and_bias_solve_the_equation_of_motion():
    rng, arm = np.random.default_rng(0), Simulation(POSTURE)
    arm.data.qvel[:] = velocity = rng.normal(size=7)
    mujoco.mj_forward(arm.model, arm.data)
    batch = torch.tensor(np.stack([POSTURE, POSTURE]))
    inertia, bias = dynamics()(batch, torch.tensor(velocity).expand(2, 7))
    torque = rng.normal(size=7)
    acceleration = arm.acceleration(torque)
    np.testing.assert_allclose(inertia[1].numpy() @ acceleration, torque, atol=1e-9)
    np.testing.assert_allclose(bias[0], arm.data.qfrc_bias, atol=1e-12)
    np.testing.assert_allclose(dynamics().effort, LIMITS)


def test_a_urdf_has_its_masses_and_what_mimics_moves_along():
    fork = Robot.from_urdf(URDF, links=["b"])
    found = MujocoDynamics(fork)
    joints, still = torch.tensor([0.3]).double(), torch.zeros(1).double()

    def energies(q, qd):
        """Potential energy, and kinetic energy, from the masses of the URDF."""
        state = fork.state(q)
        center = 0.2 * torch.cos(q[0]) - 0.1 * torch.sin(q[0])
        way = state.jacobian("b") @ qd
        motion = 0.5 * (0.1 + 2 * 0.05) * qd @ qd + 0.5 * way[:3] @ way[:3]
        potential = 9.81 * (2 * center + state.position("b")[2])
        return potential, motion + 0.01 * way[3:] @ way[3:]

    inertia, bias = found(joints, still)
    step = 1e-6
    slope = (energies(joints + step, still)[0] - energies(joints - step, still)[0]) / (2 * step)
    assert float(bias) == pytest.approx(float(slope), abs=1e-5)
    one = torch.ones(1).double()
    assert float(inertia) == pytest.approx(2 * float(energies(joints, one)[1]), abs=1e-9)
    assert found.effort.tolist() == [7.0]


def test_a_robot_without_masses_or_with_other_joints_is_refused():
    with pytest.raises(DataError, match="keeps no masses"):
        MujocoDynamics(robot())
    other = Robot.from_urdf(URDF, links=["b"])
    with pytest.raises(UnknownNameError, match="lead"):
        MujocoDynamics(other, mjcf())

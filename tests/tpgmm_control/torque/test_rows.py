"""Rows of torque space against MuJoCo, potentials, and the fusion of joints."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.own_operators import PlanarPosition
from tests.support.torque_arm import (
    BOARD,
    POSE,
    POSTURE,
    WIPING,
    Simulation,
    dynamics,
    robot,
    skill,
)
from tpgmm_control.torque import TorqueGains
from tpgmm_control.torque.rows import LocalGaussians, Mechanics, force_row, fused_torque
from tpgmm_torch import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators.wrench import Wrench

FRAMES = {"board": BOARD}
REST = torch.zeros(7, dtype=torch.float64)
JOINTS = torch.tensor([90.0, 80.0, 70.0, 60.0, 20.0, 15.0, 10.0]).double()
LINK = torch.tensor((900.0,) * 3 + (30.0,) * 3).double()
EXACT = TorqueGains(frame_tolerance=0.0, frame_turn_tolerance=0.0)


def mechanics_at(q, local, gains, stiffness=None):
    """Mechanics of the arm's tip at a posture, at rest."""
    inertia, _ = dynamics()(torch.as_tensor(q), REST)
    jacobian = local.jacobian(robot().state(q))
    return Mechanics.at(inertia, jacobian, REST, gains, stiffness)


def torque(model, q, gains=TorqueGains(), stiffness=None):  # noqa: B008
    """Fused torque of a skill at a posture at rest."""
    local, state = LocalGaussians(model, gains), robot().state(q)
    if stiffness is not None:
        links = len(local.jacobian(state)) // 6
        stiffness = torch.block_diag(stiffness[0], *[stiffness[1]] * links)
    mechanics = mechanics_at(q, local, gains, stiffness)
    time = torch.zeros((), dtype=torch.float64)
    rows = [local.rows(time, time + 1, state, FRAMES, mechanics)]
    for one in model.expected_forces(time):
        axes, first = one.operator.directions(state, FRAMES), local.first_row(one.operator.link)
        rows.append(force_row(one, axes, 0.0, first, mechanics, gains)[0])
    return fused_torque(rows, mechanics)[0].numpy(), mechanics


STIFF = JOINTS.diag(), LINK.diag()


def test_the_inverse_is_the_dynamically_consistent_one_of_mujoco():
    local = LocalGaussians(skill([POSE], POSTURE), TorqueGains())
    mechanics = mechanics_at(POSTURE, local, TorqueGains())
    jacobian = robot().state(POSTURE).jacobian("tip").numpy()
    arm = Simulation(POSTURE)
    columns = [arm.acceleration(one) - arm.acceleration(-one) for one in np.eye(7)]
    accelerations = jacobian @ np.array(columns).T / 2
    inertia = np.linalg.inv(
        jacobian
        @ np.linalg.solve(dynamics()(torch.tensor(POSTURE), REST)[0].numpy(), jacobian.T)
    )
    np.testing.assert_allclose(mechanics.consistent[7:], inertia @ accelerations, atol=1e-9)
    # a static force is a force, and no moment
    static = mechanics.consistent[7:].numpy() @ jacobian.T @ [0, 0, 8.0, 0, 0, 0]
    np.testing.assert_allclose(static, [0, 0, 8.0, 0, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("operator", "distance"),
    [
        (Canonical(), lambda r: r @ np.diag(JOINTS) @ r / 2),
        (AbsolutePosition("tip"), lambda r: 450 * r @ r),
        (RelativePosition("tip", "board"), lambda r: 450 * r @ r),
        (AbsoluteOrientation("tip"), lambda r: 120 * (1 - np.sqrt(1 - r @ r / 4))),
        (RelativeOrientation("tip", "board"), lambda r: 120 * (1 - np.sqrt(1 - r @ r / 4))),
    ],
    ids=lambda value: "" if callable(value) else str(value),
)
def test_torques_are_the_gradient_of_a_potential(operator, distance):
    model = skill([operator], POSTURE)

    def potential(q):
        state = robot().state(q)
        [mean] = model.conditionals[0].mean
        if operator.quaternion_starts(robot()):
            at = operator.linearize(state, FRAMES)
            return distance((at.matrix @ mean).numpy())
        return distance((operator.coordinates(state, FRAMES) - mean).numpy())

    q = POSTURE + 0.1 * np.random.default_rng(0).normal(size=7)
    gradient = [(potential(q + d) - potential(q - d)) / 2e-6 for d in 1e-6 * np.eye(7)]
    found, _ = torque(model, q, stiffness=STIFF)
    np.testing.assert_allclose(found, -np.array(gradient), atol=2e-6)


@pytest.mark.parametrize(
    "operators", [[POSE], [Canonical(), POSE], [Stack(Canonical(), *POSE.operators)]]
)
def test_with_stiffness_like_inertia_it_is_the_fusion_of_joints(operators):
    model, square = skill(operators, POSTURE), 100.0
    q = POSTURE + 0.1 * np.random.default_rng(1).normal(size=7)
    inertia, _ = dynamics()(torch.tensor(q), REST)
    jacobian = robot().state(q).jacobian("tip")
    mass = torch.linalg.inv(jacobian @ torch.linalg.solve(inertia, jacobian.mT))
    found, mechanics = torque(model, q, EXACT, (square * inertia, square * mass))
    estimate = model.estimate(torch.zeros(()).double(), torch.tensor(q), FRAMES)
    wanted = square * inertia @ (estimate.joints - torch.tensor(q))
    if operators == [POSE]:  # free joints: each has a prior of its own, compare the task
        found, wanted = (mechanics.consistent[7:].numpy() @ x for x in (found, wanted.numpy()))
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)
    else:
        np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_a_force_is_pressed_where_a_position_is_not_known():
    operators = [*POSE.operators, Wrench("tip", "board", axes=(2,))]
    found, mechanics = torque(skill(operators, POSTURE), POSTURE, stiffness=STIFF)
    wrench = mechanics.consistent[7:].numpy() @ found
    normal = operators[-1].directions(robot().state(POSTURE), FRAMES)[0].numpy()
    assert wrench[:3] @ normal == pytest.approx(8.0, abs=0.3)
    assert np.abs(wrench[3:]).max() < 0.1


def test_what_the_pose_leaves_free_is_the_posture_s():
    far = POSTURE + 0.3 * np.eye(7)[2]
    inertia, _ = dynamics()(torch.tensor(far), REST)
    softness = torch.diag(1 / JOINTS)
    posture = skill([Canonical()], POSTURE).conditionals[0]
    posture = replace(posture, covariance=(softness @ inertia @ softness)[None])
    pose = skill([POSE], far, 1e-5).conditionals[0]
    model = replace(
        skill([Canonical(), POSE], POSTURE), conditionals=[posture, pose], n_samples=None
    )
    found, mechanics = torque(model, far, EXACT, STIFF)
    alone = np.diag(JOINTS) @ (POSTURE - far)
    jacobian = robot().state(far).jacobian("tip").numpy()
    free = np.eye(7) - jacobian.T @ mechanics.consistent[7:].numpy()
    np.testing.assert_allclose(found, free @ alone, atol=1e-3 * np.abs(alone).max())
    assert np.linalg.norm(found) > 1.0


@pytest.mark.parametrize("bend", [0.0, 1e-9, 1e-6, 1e-4, 1e-3, 1e-2])
def test_singular_postures_have_finite_torques_that_change_little(bend):
    stretched = np.array([0.0, 0.0, 0.0, bend, 0.0, bend, 0.0])
    model = skill([*WIPING, Wrench("tip", "board", axes=(2,))], POSTURE)
    found, _ = torque(model, stretched, stiffness=STIFF)
    again, _ = torque(model, stretched + 1e-7, stiffness=STIFF)
    assert np.isfinite(found).all() and np.abs(found).max() < 1000
    assert np.abs(found - again).max() < 0.1


def test_a_share_of_contact_weakens_the_force():
    operators, pressed = [*WIPING, Wrench("tip", "board", axes=(2,))], []
    for share in (1.0, 0.5, 0.01):
        found, mechanics = torque(skill(operators, POSTURE, share=share), POSTURE)
        normal = operators[-1].directions(robot().state(POSTURE), FRAMES)[0].numpy()
        pressed.append(normal @ mechanics.consistent[7:10].numpy() @ found)
    assert pressed[0] > 7 > pressed[1] > 0.1 > pressed[2] > 0


def test_operators_of_other_kinds_are_refused():
    tangent = RelativeOrientation("tip", "board", geometry="tangent")
    for other in (PlanarPosition(), RelativePosition("tip", "l3"), tangent):
        with pytest.raises(DataError, match="no rows in torque space"):
            LocalGaussians(skill([Canonical(), other], POSTURE), TorqueGains())

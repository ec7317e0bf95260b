"""A controller of torques: continuous, limited, finite, and held with a reason."""

import numpy as np
import pytest
import torch

from tests.support.torque_arm import BOARD, LIMITS, POSTURE, WIPING, Simulation, dynamics, skill
from tpgmm_control.torque import TorqueController, TorqueGains
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, ShapeError
from tpgmm_torch.operators.wrench import Wrench

FRAMES = {"board": BOARD}
FORCE = Wrench("tip", "board", axes=(2,))
NONE = {"tip": np.zeros(6)}
AWAY = POSTURE + 0.05


def controller(operators=(*WIPING, FORCE), at=AWAY, **settings):
    """One that runs a skill at rest."""
    frames = FRAMES if len(operators) > 1 else {}
    return TorqueController(
        skill(list(operators), POSTURE),
        at,
        frames,
        dynamics=dynamics(),
        bounds=None,
        **settings,
    )


def run(control, arm, ticks, dt=0.002, **values):
    """Commands of some ticks in MuJoCo."""
    commands = []
    for _ in range(ticks):
        q, qd = arm.data.qpos.copy(), arm.data.qvel.copy()
        commands.append(control.step(dt, q, velocities=qd, wrenches=NONE, **values))
        arm.step(commands[-1].torque.numpy(), round(dt / 0.002))
    return commands


@pytest.mark.parametrize("operators", [(*WIPING, FORCE), WIPING], ids=["forces", "none"])
def test_torques_begin_as_those_that_carry_the_robot_and_go_on_from_there(operators):
    arm = Simulation(AWAY)
    gravity = arm.data.qfrc_bias.copy()
    commands = run(controller(operators), arm, 600)
    torques = np.array([one.torque.numpy() for one in commands])
    np.testing.assert_allclose(torques[0], gravity, atol=1e-9)
    assert np.abs(np.diff(torques, axis=0)).max() < 1.0
    assert (np.abs(torques) <= LIMITS).all()
    assert commands[-1].status == "running"
    assert np.abs(arm.data.qpos - POSTURE).max() < (0.3 if FORCE in operators else 0.03)


def test_without_forces_stiffness_is_that_of_the_covariance():
    control = controller(WIPING, blend=0)
    for _ in range(2):
        command = control.step(0.002, AWAY, velocities=np.zeros(7))
    inertia, bias = dynamics()(torch.tensor(AWAY), torch.zeros(7).double())
    spring = command.stiffness_matrix @ (command.reference - torch.tensor(AWAY))
    damping = command.impedance.joints.damping(command.stiffness_matrix, inertia)
    np.testing.assert_allclose(command.torque, bias + spring + damping @ command.velocity)


def test_what_cannot_be_right_fades_to_gravity_and_damping_with_a_reason():
    control, arm = controller(), Simulation(AWAY)
    run(control, arm, 300)
    q, qd = arm.data.qpos.copy(), arm.data.qvel.copy()
    before = control.step(0.002, q, velocities=qd, wrenches=NONE).torque
    cases = [
        ({"velocities": np.full(7, np.nan)}, 0.002, "velocities"),
        ({}, 0.002, "velocities"),
        ({"velocities": qd}, 0.02, "longer than"),
        ({"velocities": qd}, np.nan, "time did not increase"),
    ]
    for inputs, dt, reason in cases:
        one = control.step(dt, q, wrenches=NONE, **inputs)
        assert one.status == "holding" and reason in one.reason()
        assert (one.torque - before).abs().max() < 20 * 0.02 / 0.05
    one = control.step(0.002, q * np.nan, velocities=qd, wrenches=NONE)
    assert "joints were not read" in one.reason() and one.torque.isfinite().all()
    for _ in range(200):
        last = control.step(0.002, q, wrenches=NONE)
    _, bias = dynamics()(torch.tensor(q), torch.zeros(7).double())
    np.testing.assert_allclose(last.torque, bias, atol=1e-2)
    again = [control.step(0.002, q, velocities=0 * qd, wrenches=NONE).torque for _ in range(3)]
    assert all((one - last.torque).abs().max() < 0.1 for one in again)  # it fades in again


def test_dynamics_that_fail_hold_the_last_known_bias_until_they_are_back():
    fails = []

    def sometimes(q, qd):
        inertia, bias = dynamics()(q, qd)
        return (inertia * np.nan, bias * np.nan) if fails else (inertia, bias)

    control = TorqueController(
        skill([*WIPING, FORCE], POSTURE), POSTURE, FRAMES, dynamics=sometimes, bounds=None
    )
    still = {"velocities": np.zeros(7), "wrenches": NONE}
    torques = [control.step(0.002, POSTURE, **still).torque for _ in range(50)]
    fails.append(True)
    commands = [control.step(0.002, POSTURE, **still) for _ in range(50)]
    assert "no finite torque" in commands[-1].reason()
    fails.clear()
    commands += [control.step(0.002, POSTURE, **still) for _ in range(50)]
    assert commands[-1].status == "running"
    torques = torch.stack(torques + [one.torque for one in commands])
    assert torques.isfinite().all() and torques.diff(dim=0).abs().max() < 0.2


def test_a_hundred_hertz_are_refused_and_two_hundred_and_fifty_are_not():
    for dt, status in ((0.01, "holding"), (0.004, "running")):
        control = controller(at=POSTURE)
        for _ in range(5):
            command = control.step(dt, POSTURE, velocities=np.zeros(7), wrenches=NONE)
        assert command.status == status, command.reason()
    assert "Hz or more" not in command.reason()


def test_the_integral_is_bounded_by_the_force_and_freezes_where_motors_are_at_their_limits():
    pushes = []
    for effort in (LIMITS, np.full(7, 1e-3)):
        control = controller(at=POSTURE, blend=0, effort=effort)
        torques = [
            control.step(0.004, POSTURE, velocities=np.zeros(7), wrenches=NONE).torque.numpy()
            for _ in range(120)
        ]
        pushes.append(np.abs(torques[-1] - torques[1]).max())
        assert (np.abs(torques) <= effort).all()
    assert pushes[0] > 0.5 and pushes[1] == 0


def test_a_batch_is_each_robot_alone():
    starts = np.array([POSTURE, AWAY])
    both = controller(at=starts)
    alone = [controller(at=one) for one in starts]
    for i in range(20):
        q = starts + 1e-4 * i
        wrenches = {"tip": np.zeros((2, 6))}
        together = both.step(0.002, q, velocities=0.05 + 0 * q, wrenches=wrenches)
        for k, one in enumerate(alone):
            single = one.step(0.002, q[k], velocities=np.full(7, 0.05), wrenches=NONE)
            np.testing.assert_allclose(together.torque[k], single.torque, atol=1e-8)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ShapeError, match="inertia"):
        TorqueController(
            skill(WIPING, POSTURE), POSTURE, FRAMES,
            dynamics=lambda q, qd: (torch.eye(6).double(), q),
        )  # fmt: skip
    with pytest.raises(DataError, match="effort"):
        controller(effort=[1.0])
    with pytest.raises(ShapeError, match="velocities"):
        controller().step(0.002, POSTURE, velocities=np.zeros(6), wrenches=NONE)
    with pytest.warns(PlausibilityWarning, match="no wrench"):
        controller().step(0.002, POSTURE, velocities=np.zeros(7))
    for wrong in ({"damping_ratio": 0.0}, {"link_frequency": -1.0}, {"integral": np.nan}):
        with pytest.raises(DataError, match=f"{next(iter(wrong))} of TorqueGains"):
            TorqueGains(**wrong)

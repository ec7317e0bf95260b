"""A seven-joint arm with masses in MuJoCo, and skills of one component for it."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
import torch

from tpgmm_control.torque import MujocoDynamics
from tpgmm_torch import Canonical, Frame, RelativeOrientation, RelativePosition, Robot, Stack
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.wrench import Wrench
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.regression import Regression

POSTURE = np.array([0.2, 0.5, -0.1, 1.5, 0.3, 0.9, -0.4])
LIMITS = np.array([80.0, 80.0, 80.0, 80.0, 12.0, 12.0, 12.0])
BOARD = Frame([0.45, 0.05, 0.35], [0.96, 0.1, -0.2, 0.17])


def mjcf() -> str:
    """Axes z, y, z, y, z, y, z, with motors of limited torque."""
    bodies, motors = "", ""
    links = [(0.3, 4), (0.1, 3), (0.3, 3), (0.1, 2), (0.3, 2), (0.1, 1), (0.1, 0.5)]
    for i, (length, mass) in enumerate(links):
        axis, inertia = ("0 0 1", "0 1 0")[i % 2], 3 * f"{0.005 * mass} "
        bodies += (
            f'<body name="l{i}" pos="0 0 {length}"><joint name="j{i}" axis="{axis}" '
            f'armature="0.05"/><inertial mass="{mass}" pos="0.01 0 0.05" '
            f'diaginertia="{inertia}"/>'
        )
        motors += (
            f'<motor joint="j{i}" ctrlrange="{-LIMITS[i]} {LIMITS[i]}" ctrllimited="true"/>'
        )
    bodies += '<site name="tip" pos="0.02 0 0.1"/>' + len(links) * "</body>"
    return f"<mujoco><worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>"


@functools.cache
def robot() -> Robot:
    """The arm, with its tip and its elbow as links."""
    return Robot.from_mjcf(mjcf(), links=["tip", "l3"])


@functools.cache
def dynamics() -> MujocoDynamics:
    """Its inertia and bias."""
    return MujocoDynamics(robot(), mjcf())


class Simulation:
    """The arm in MuJoCo itself."""

    def __init__(self, joints: np.ndarray) -> None:
        self.model = mujoco.MjModel.from_xml_string(mjcf())
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = joints
        mujoco.mj_forward(self.model, self.data)

    def acceleration(self, torque: np.ndarray) -> np.ndarray:
        """Of the joints, for a torque beside the bias."""
        self.data.qfrc_applied[:] = self.data.qfrc_bias + torque
        mujoco.mj_forward(self.model, self.data)
        return self.data.qacc.copy()

    def step(self, torque: np.ndarray, n: int) -> None:
        """For n time steps of 2 ms."""
        self.data.qfrc_applied[:] = torque
        mujoco.mj_step(self.model, self.data, n)


def skill(
    operators: list[Operator], at: np.ndarray, deviation: float = 0.01, *, share: float = 1.0
) -> Regression:
    """One component, at rest at a posture; forces are 8 N along each axis."""
    state, conditionals = robot().state(at), []
    for operator in operators:
        if isinstance(operator, Wrench):
            mean = torch.tensor([8.0] * len(operator.axes or ()) + [share]).double()
            covariance = torch.eye(len(mean)).double() * 0.04
        else:
            mean = operator.coordinates(state, {"board": BOARD})
            covariance = torch.eye(len(mean)).double() * deviation**2
        covariance = (covariance + 1e-9 * torch.eye(len(mean)))[None]
        zero = torch.zeros(1).double()
        conditionals.append(
            Conditionals(mean[None], torch.zeros_like(mean)[None], covariance, zero, zero + 1)
        )
    return Regression(
        robot(), operators, conditionals, torch.zeros(1).double(), begin=0.0, end=10.0,
        time=torch.linspace(0, 10, 50).double(),
    )  # fmt: skip


POSE = Stack(RelativePosition("tip", "board"), RelativeOrientation("tip", "board"))
WIPING = [Canonical(), RelativePosition("tip", "board"), RelativeOrientation("tip", "board")]

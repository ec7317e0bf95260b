"""A simulated robot with two hands under joint position control, in MuJoCo."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch.exceptions import DataError

#: Of the simulation and of the position control of the joints [s].
TIMESTEP = 1e-3
#: Gains of the position control [N m / rad, N m s / rad].
STIFFNESS, DAMPING = 1000.0, 30.0
#: Name of the model's camera.
CAMERA = "front"

_DIVERGED = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{x}")) for x in ("QPOS", "QVEL", "QACC")
]
#: What collides with what, as bits: the table; the palms, and no other part of the robot.
TABLE, PALM = 1, 2
BOX, CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
#: Half the sides of the upper body's palms, which robots without palms are given [m].
PALM_SIZE = (0.025, 0.01, 0.04)


def robot_spec() -> mujoco.MjSpec:
    """Specify the upper body alone, with a light and a camera before it.

    Returns
    -------
    mujoco.MjSpec
        As :func:`add_position_control` gives it, the joints in the URDF's order.
    """
    return add_position_control(mujoco.MjSpec.from_string(upper_body_urdf()))


def add_position_control(spec: mujoco.MjSpec, gain: float = 1.0) -> mujoco.MjSpec:
    """Give a robot position control, palms, a light and a camera before it.

    Parameters
    ----------
    spec : mujoco.MjSpec
        A robot alone, with bodies ``l_hand`` and ``r_hand``, whose first geoms are the palms.
    gain : float, default=1
        By what stiffness and damping are multiplied.

    Returns
    -------
    mujoco.MjSpec
        The same, with a position actuator for each joint, and geoms ``l_palm`` and ``r_palm``.
    """
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for joint in spec.joints:
        motor = spec.add_actuator(name=joint.name, target=joint.name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.set_to_position(kp=gain * STIFFNESS, kv=gain * DAMPING)
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0  # as the controllers of such robots do
    for hand in HANDS:
        palm = spec.body(hand).geoms[0]
        palm.name, palm.contype, palm.rgba = f"{hand[0]}_palm", PALM, (0.85, 0.45, 0.2, 1)
    add_view(spec)
    return spec


def add_view(spec: Any) -> None:
    """Add a camera before the robot, light and a bright sky: cheap to draw by a processor."""
    spec.visual.quality.shadowsize, spec.visual.quality.offsamples = 0, 0
    world, texture = spec.worldbody, mujoco.mjtTexture
    world.add_camera(
        name=CAMERA, pos=(1.05, 0.6, 0.55), xyaxes=(-0.54, 0.84, 0, -0.33, -0.21, 0.92), fovy=45
    )
    world.add_light(pos=(0.8, 0.6, 1.4), dir=(-0.5, -0.4, -1), diffuse=(0.8, 0.8, 0.8))
    spec.add_texture(
        name="sky",
        type=texture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.95, 0.95, 0.95),
        rgb2=(0.7, 0.75, 0.8),
        width=64,
        height=384,
    )


def add_geom(body: Any, shape: Any, size: Sequence[float], **more: Any) -> None:
    """Add a shape to a body, of half sizes [m], with which nothing collides by default."""
    body.add_geom(type=shape, size=size, **{"contype": 0, "conaffinity": 0, **more})


def add_table(spec: Any, width: float) -> None:
    """Add a body ``table`` whose top is where that is, drawn so wide [m]."""
    table, plane = spec.worldbody.add_body(name="table"), mujoco.mjtGeom.mjGEOM_PLANE
    add_geom(table, plane, (0, 0, 1), contype=TABLE, group=3)
    size = (0.2, width / 2, 0.01)
    add_geom(table, BOX, size, pos=(0.34, 0, -0.01), rgba=(0.6, 0.5, 0.4, 1))


def add_weld(spec: Any, hand: str, thing: str) -> Any:
    """Let a hand hold a thing: a weld between the bodies, not active."""
    weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, name1=hand, name2=thing)
    weld.objtype, weld.active = mujoco.mjtObj.mjOBJ_BODY, False
    return weld


class RobotScene(ABC):
    """A simulated world with the robot in it.

    Parameters
    ----------
    spec : mujoco.MjSpec
        That of :func:`add_position_control`, with more in it.

    Attributes
    ----------
    spec : mujoco.MjSpec
        What the model was compiled of.
    model : mujoco.MjModel
    data : mujoco.MjData
    """

    def __init__(self, spec: mujoco.MjSpec) -> None:
        self.spec, self.model = spec, spec.compile()
        self.data = mujoco.MjData(self.model)
        self._n = self.model.nu
        driven = self.model.actuator_trnid[:, 0]
        # of what is driven, among all positions and velocities
        self._places, self._dofs = self.model.jnt_qposadr[driven], self.model.jnt_dofadr[driven]

    @property
    @abstractmethod
    def objects(self) -> list[NDArray[np.float64]]:
        """The poses of what is observed, shape (7,) each."""

    @abstractmethod
    def place(self, joints: NDArray[np.float64], seconds: float) -> None:
        """Put the joints somewhere without dynamics, while time passes."""

    @abstractmethod
    def snapshot(self) -> Any:
        """Return the state without velocities."""

    @abstractmethod
    def restore(self, snapshot: Any) -> None:
        """Bring everything to where it was."""

    @property
    def joints(self) -> NDArray[np.float64]:
        """Joint positions, shape (n_joints,) [rad]."""
        return np.asarray(self.data.qpos[self._places])

    def follow(
        self, references: NDArray[np.float64], torques: NDArray[np.float64] | None = None
    ) -> None:
        """Simulate position control.

        Parameters
        ----------
        references : ndarray of shape (n + 1, n_joints)
            Where the joints should be now and at the end of the next ``n`` time steps [rad].
        torques : ndarray of shape (n, n_joints), optional
            From outside, during each time step [N m].
        """
        model, data = self.model, self.data
        control = self._controls(references[1:], np.diff(references, axis=0) / TIMESTEP)
        for i in range(len(control)):
            if torques is not None:
                data.qfrc_applied[self._dofs] = torques[i]
            self._step(control[i])
        if data.warning.number[_DIVERGED].any():  # MuJoCo then resets itself
            raise DataError(f"the simulation diverges at {references[-1].tolist()}")
        mujoco.mj_kinematics(model, data)

    def _controls(
        self, references: NDArray[np.float64], speeds: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Controls of the actuators at each time step."""
        # a joint of stiffness k follows a moving reference at a distance of d v / k, where d
        # is its damping, the joint's own and the control's: so much it has to be led
        model = self.model
        damping = model.dof_damping[self._dofs] - model.actuator_biasprm[:, 2]
        return references + damping / model.actuator_gainprm[:, 0] * speeds

    def _step(self, control: NDArray[np.float64]) -> None:
        self.data.ctrl[:] = control
        mujoco.mj_step(self.model, self.data)

    def rest(self) -> None:
        """Stand still, as it is."""
        data = self.data
        data.qvel[:] = data.qacc_warmstart[:] = data.qfrc_applied[:] = 0
        data.ctrl[:] = self.joints
        mujoco.mj_forward(self.model, data)

    def _attach(self, weld: int, hand: int, thing: int) -> None:
        """Activate a weld between two bodies as one lies in the other."""
        data = self.data
        inverse, turn = np.empty(4), np.empty(4)
        mujoco.mju_negQuat(inverse, data.xquat[hand])
        mujoco.mju_mulQuat(turn, inverse, data.xquat[thing])
        point = data.xmat[thing].reshape(3, 3).T @ (data.xpos[hand] - data.xpos[thing])
        # a point of the thing, where it is in the hand, and how the thing is turned there
        self.model.eq_data[weld, :10] = np.concatenate((point, np.zeros(3), turn))
        data.eq_active[weld] = True

    def _contact_force(self, index: int, first: bool) -> NDArray[np.float64]:
        """Compute the force of a contact's geom on the other one, shape (3,) [N]."""
        force, frame = np.empty(6), self.data.contact.frame[index].reshape(3, 3)
        mujoco.mj_contactForce(self.model, self.data, index, force)
        # it is what the first geom does to the second, in the contact's frame
        return np.asarray((1 if first else -1) * force[:3] @ frame)

"""A simulated robot under joint position control, and what its hands can hold, in MuJoCo."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch.exceptions import DataError

Array = NDArray[np.float64]
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
#: What objects collide with, as a bit, beside the table: one another, but no palms.
OBJECT = 8
BOX, CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
#: Half the sides of the upper body's palms, which robots without palms are given [m].
PALM_SIZE = (0.025, 0.01, 0.04)
#: A weld's rows of constraints: a force, then a moment.
_ROWS = 3


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
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
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


@dataclass(frozen=True)
class Hold:
    """A hand that may take hold of an object.

    Parameters
    ----------
    hand : str
        The link.
    thing : str
        The object's body.
    grip : str
        The geom that the palm has to touch.
    """

    hand: str
    thing: str
    grip: str


def add_thing(spec: mujoco.MjSpec, name: str, *, free: bool = True) -> mujoco.MjsBody:
    """Add an object's body, without geoms.

    Parameters
    ----------
    free : bool, default=True
        Whether it can be moved; what is not free stands where it is put.
    """
    body = spec.worldbody.add_body(name=name)
    if free:
        body.add_freejoint(name=name)
    return body


class RobotScene:
    """The state of a simulated world with a robot in it, and what its hands can do there.

    Parameters
    ----------
    spec : mujoco.MjSpec
        That of :func:`add_position_control` at a table, with the objects in it.
    names : sequence of str
        The objects that are observed.
    holds : sequence of Hold
        Which hand may take hold of what.

    Attributes
    ----------
    spec : mujoco.MjSpec
        What the model was compiled of.
    model : mujoco.MjModel
    data : mujoco.MjData
    names : tuple of str
    held : set of Hold
        Which hands hold something.
    taken : set of Hold
        Which do, or have done.
    """

    #: How a grip yields: time constant [s] and damping ratio. The lighter a thing is, the
    #: softer it is held; with the usual 0.02 s a baton would hang from the hand by degrees.
    softness: ClassVar[tuple[float, float]] = (0.004, 1.0)

    def __init__(
        self, spec: mujoco.MjSpec, names: Sequence[str], holds: Sequence[Hold]
    ) -> None:
        for hold in holds:
            weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD)
            weld.name1, weld.name2, weld.name = hold.hand, hold.thing, _name_weld(hold)
            weld.objtype, weld.active = mujoco.mjtObj.mjOBJ_BODY, False
            weld.solref = self.softness
        self.spec, self.model = spec, spec.compile()
        self.data = mujoco.MjData(self.model)
        self._n = self.model.nu
        driven = self.model.actuator_trnid[:, 0]
        # of what is driven, among all positions and velocities
        self._places, self._dofs = self.model.jnt_qposadr[driven], self.model.jnt_dofadr[driven]
        self.names = tuple(names)
        self.held: set[Hold] = set()
        self.taken: set[Hold] = set()
        self._welds = {hold: self.model.equality(_name_weld(hold)).id for hold in holds}

    @property
    def joints(self) -> Array:
        """Joint positions, shape (n_joints,) [rad]."""
        return np.asarray(self.data.qpos[self._places])

    def follow(self, references: Array, torques: Array | None = None) -> None:
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

    def _controls(self, references: Array, speeds: Array) -> Array:
        """Controls of the actuators at each time step."""
        # a joint of stiffness k follows a moving reference at a distance of d v / k, where d
        # is its damping, the joint's own and the control's: so much it has to be led
        model = self.model
        damping = model.dof_damping[self._dofs] - model.actuator_biasprm[:, 2]
        return references + damping / model.actuator_gainprm[:, 0] * speeds

    def _step(self, control: Array) -> None:
        self.data.ctrl[:] = control
        mujoco.mj_step(self.model, self.data)

    def rest(self) -> None:
        """Stand still, as it is."""
        data = self.data
        data.qvel[:] = data.qacc_warmstart[:] = data.qfrc_applied[:] = 0
        data.ctrl[:] = self.joints
        mujoco.mj_forward(self.model, data)

    @property
    def objects(self) -> list[Array]:
        """The poses of what is observed, shape (7,) each."""
        return [self.pose(name) for name in self.names]

    @property
    def table(self) -> float:
        """Height of the table [m]."""
        return float(self.model.body_pos[self.model.body("table").id, 2])

    def pose(self, name: str) -> Array:
        """Return a body's position [m] and orientation, a unit quaternion; shape (7,)."""
        body = self.data.body(name)
        return np.concatenate((body.xpos, body.xquat))

    def put(self, name: str, pose: Array) -> None:
        """Put an object somewhere, at rest; shape (7,)."""
        model, data, body = self.model, self.data, self.model.body(name).id
        if model.body_jntnum[body] and model.jnt_type[model.body_jntadr[body]] == 0:  # free
            joint = data.joint(int(model.body_jntadr[body]))
            joint.qpos[:], joint.qvel[:] = pose, 0
        else:
            model.body_pos[body], model.body_quat[body] = pose[:3], pose[3:]
        mujoco.mj_kinematics(model, data)

    def reset(
        self,
        poses: Mapping[str, Array],
        joints: Array,
        table: float,
    ) -> None:
        """Stand still, the objects where they are put.

        Parameters
        ----------
        poses : mapping of str to ndarray of shape (7,)
        joints : ndarray of shape (n_joints,)
            [rad]
        table : float
            Its height [m].
        """
        mujoco.mj_resetData(self.model, self.data)
        self.data.eq_active[:] = False
        self.held, self.taken = set(), set()
        self.data.ctrl[:] = self.data.qpos[self._places] = joints
        self.model.body_pos[self.model.body("table").id, 2] = table
        for name, pose in poses.items():
            self.put(name, pose)
        mujoco.mj_forward(self.model, self.data)

    def place(self, joints: Array, seconds: float) -> None:
        """Put the joints somewhere without dynamics; objects stay where they are."""
        self.data.qpos[self._places] = joints
        mujoco.mj_kinematics(self.model, self.data)
        self.data.time += seconds

    def gap(self, hold: Hold) -> float:
        """Distance of a palm from where it would hold, negative inside it [m]."""
        model, points = self.model, np.empty(6)
        palm, grip = (model.geom(name).id for name in (f"{hold.hand[0]}_palm", hold.grip))
        return float(mujoco.mj_geomDistance(model, self.data, palm, grip, 1.0, points))

    def depth(self, body: str) -> float:
        """Measure how deep whatever moves is in a body that stands still, 0 if nowhere [m].

        It is right with MuJoCo 3.12 or newer.
        """
        model, points = self.model, np.empty(6)
        fixed = np.flatnonzero(model.geom_bodyid == model.body(body).id).tolist()
        moving = np.flatnonzero(model.body_weldid[model.geom_bodyid]).tolist()
        pairs = itertools.product(moving, fixed)
        return -min(
            mujoco.mj_geomDistance(model, self.data, *pair, 0.0, points) for pair in pairs
        )

    def hold(self, hold: Hold) -> None:
        """Attach an object to a hand as it lies in it."""
        hand, thing = (self.data.body(name) for name in (hold.hand, hold.thing))
        inverse, turn = np.empty(4), np.empty(4)
        mujoco.mju_negQuat(inverse, hand.xquat)
        mujoco.mju_mulQuat(turn, inverse, thing.xquat)
        point = thing.xmat.reshape(3, 3).T @ (hand.xpos - thing.xpos)
        # a point of the thing, where it is in the hand, and how the thing is turned there
        weld = self._welds[hold]
        self.model.eq_data[weld, :10] = np.concatenate((point, np.zeros(3), turn))
        self.data.eq_active[weld] = True
        self.held.add(hold)
        self.taken.add(hold)

    def let_go(self, hold: Hold) -> None:
        """Open a hand."""
        self.data.eq_active[self._welds[hold]] = False
        self.held.discard(hold)

    def pull(self, hold: Hold) -> float:
        """Return the force between a hand and what it holds [N]; 0 if it holds nothing."""
        data = self.data
        rows = np.flatnonzero(
            (data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY)
            & (data.efc_id == self._welds[hold])
        )[:_ROWS]
        return math.sqrt(float(np.square(data.efc_force[rows]).sum()))

    def touch(self, first: str, second: str) -> float:
        """Return the normal force between two geoms, pressing [N]."""
        model, data, total, part = self.model, self.data, 0.0, np.empty(6)
        pair = {model.geom(first).id, model.geom(second).id}
        for index in range(data.ncon):
            if set(data.contact.geom[index].tolist()) == pair:
                mujoco.mj_contactForce(model, data, index, part)
                total += part[0]
        return total

    def force(self, first: str, second: str) -> Array:
        """Force of one body on another where they touch, friction too; shape (3,) [N]."""
        total, model = np.zeros(3), self.model
        bodies = model.body(first).id, model.body(second).id
        for index, geoms in enumerate(self.data.contact.geom):
            pair = tuple(model.geom_bodyid[geoms])
            if set(pair) == set(bodies):
                total += self._contact_force(index, pair == bodies)
        return total

    def wrench(self, body: str) -> Array:
        """Wrench of a body on all it touches, at its origin, shape (6,) [N, N m]."""
        total, own = np.zeros(6), self.model.body(body).id
        for index, geoms in enumerate(self.data.contact.geom):
            first, second = self.model.geom_bodyid[geoms]
            if first != second and own in (first, second):
                force = self._contact_force(index, first == own)
                arm = self.data.contact.pos[index] - self.data.xpos[own]
                total += np.concatenate((force, np.cross(arm, force)))
        return total

    def snapshot(self) -> tuple[Any, ...]:
        """Return the state without velocities."""
        model, held, taken = self.model, self.held.copy(), self.taken.copy()
        places = model.body_pos.copy(), model.body_quat.copy()  # of what is not free
        return self.data.qpos.copy(), held, taken, model.eq_data.copy(), *places

    def restore(self, snapshot: tuple[Any, ...]) -> None:
        """Bring everything to where it was."""
        model = self.model
        self.data.qpos[:], held, taken, model.eq_data[:], *places = snapshot
        model.body_pos[:], model.body_quat[:] = places
        self.held, self.taken = held.copy(), taken.copy()
        for hold, weld in self._welds.items():
            self.data.eq_active[weld] = hold in self.held
        mujoco.mj_kinematics(self.model, self.data)

    def _contact_force(self, index: int, first: bool) -> Array:
        """Compute the force of a contact's geom on the other one, shape (3,) [N]."""
        force, frame = np.empty(6), self.data.contact.frame[index].reshape(3, 3)
        mujoco.mj_contactForce(self.model, self.data, index, force)
        # it is what the first geom does to the second, in the contact's frame
        return np.asarray((1 if first else -1) * force[:3] @ frame)


def _name_weld(hold: Hold) -> str:
    return f"{hold.hand} {hold.thing}"

"""A simulated robot at a table with things that its hands can hold, in MuJoCo."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from lerobot_env_bimanual.base import Array
from lerobot_env_bimanual.robot_scene import RobotScene, add_weld

#: What objects collide with, as a bit, beside the table: one another, but no palms.
OBJECT = 8
#: How a grip yields: time constant [s] and damping ratio. The lighter a thing is, the softer it
#: is held; with MuJoCo's own 0.02 s a baton would hang from the hand by some degrees.
GRIP = (0.004, 1.0)
#: A weld's rows of constraints: a force, then a moment.
_ROWS = 3


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


class SuiteScene(RobotScene):
    """The state of the simulated world, and what hands can do in it.

    Parameters
    ----------
    spec : mujoco.MjSpec
        A robot at a table, with the objects in it.
    names : sequence of str
        The objects that are observed.
    holds : sequence of Hold
        Which hand may take hold of what.

    Attributes
    ----------
    names : tuple of str
    held : set of Hold
        Which hands hold something.
    taken : set of Hold
        Which do, or have done.
    """

    def __init__(
        self, spec: mujoco.MjSpec, names: Sequence[str], holds: Sequence[Hold]
    ) -> None:
        for hold in holds:
            weld = add_weld(spec, hold.hand, hold.thing)
            weld.name, weld.solref = f"{hold.hand} {hold.thing}", GRIP
        super().__init__(spec)
        model = self.model
        self.names = tuple(names)
        self.held: set[Hold] = set()
        self.taken: set[Hold] = set()
        self._welds = {hold: model.equality(f"{hold.hand} {hold.thing}").id for hold in holds}

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
        hand, thing = (self.model.body(name).id for name in (hold.hand, hold.thing))
        self._attach(self._welds[hold], hand, thing)
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

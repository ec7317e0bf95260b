"""Distances between solids that links, objects and the base carry, with their derivatives.

Poses come from the project's own kinematics, distances between two solids from MuJoCo's
``mj_geomDistance``. Pairs that are certainly further apart than asked are left out before: the
centre of one solid is so far from the box around the other that not even the sphere around the
first reaches there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_control.obstacles.shapes import Shape
from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DependencyError
from tpgmm_torch.robots.mjcf import mujoco_module
from tpgmm_torch.robots.robot import Robot

Indices = NDArray[np.intp]

#: First version of MuJoCo whose distances agree with what touches, for all kinds of solids.
RIGHT_DISTANCES = (3, 12)
#: Of a plane, which has no middle, where a radius is asked for [m].
ENDLESS = 1e9
#: A way between two solids that is shorter has no direction [m].
TINY = 1e-9


class Placed(NamedTuple):
    """Where the solids of B robots are, and how they move with the joints.

    Parameters
    ----------
    centres, rotations : ndarray of shape (B, G, 3) and (B, G, 3, 3)
        Of the solids.
    origins, jacobians : ndarray of shape (B, C, 3) and (B, C, 6, n_joints)
        Of what carries them: links, objects, the base.
    """

    centres: Array
    rotations: Array
    origins: Array
    jacobians: Array


class Near(NamedTuple):
    """Pairs of solids that are near each other.

    Parameters
    ----------
    robot, pair : ndarray of shape (N,)
        Which robot of the batch, which pair.
    distance : ndarray of shape (N,)
        Negative where they overlap [m].
    normal : ndarray of shape (N, 3)
        Unit vectors from the first solid to the second; 0 where there is no direction.
    points : ndarray of shape (N, 2, 3)
        The nearest points of both.
    """

    robot: Indices
    pair: Indices
    distance: Array
    normal: Array
    points: Array


class Geometry:
    """Solids of a robot, of objects and of what stands around, and pairs of them.

    Parameters
    ----------
    robot : Robot
    shapes : sequence of Shape
    pairs : ndarray of shape (P, 2)
        The solids of each pair.

    Raises
    ------
    DependencyError
        Without MuJoCo 3.12 or newer; distances of older ones are wrong.
    """

    def __init__(self, robot: Robot, shapes: Sequence[Shape], pairs: Indices) -> None:
        named = [*dict.fromkeys(one.carrier for one in shapes if one.carrier is not None)]
        links = [name for name in named if name in robot.model.links]
        self.objects = tuple(name for name in named if name not in links)
        carriers = [*links, *self.objects, None]
        self.carrier = np.array([carriers.index(one.carrier) for one in shapes], np.intp)
        self._links, self._columns = _of_links(robot, links)
        self._model = _flat(shapes)
        self._data = mujoco_module("distances").MjData(self._model)
        model = self._model
        self._centres = model.geom_pos.copy()
        turns = torch.from_numpy(model.geom_quat.copy())
        self._turns = quaternions.to_matrix(turns).numpy()
        plane = model.geom_type == 0
        reach = np.linalg.norm(self._centres, axis=1) + model.geom_rbound
        #: Of spheres around the origins of carriers that hold their solids (C,) [m].
        self.radius = np.array(
            [max(reach[self.carrier == k], default=0.0) for k in range(len(carriers))]
        )
        self._radius = np.where(plane, ENDLESS, model.geom_rbound)
        self._middle, self._half = model.geom_aabb[:, :3].copy(), model.geom_aabb[:, 3:].copy()
        #: Of the solids that count (P, 2).
        self.pairs = pairs

    def place(
        self, joints: Tensor, objects: Mapping[str, tuple[Array, Array, Array]]
    ) -> Placed:
        """Where all solids are.

        Parameters
        ----------
        joints : Tensor of shape (B, n_joints)
        objects : mapping of str to three ndarray
            Of each object position (B, 3), rotation (B, 3, 3) and Jacobian (B, 6, n_joints).
        """
        batch, n, links = *joints.shape, len(self._links.links) if self._links else 0
        count = links + len(self.objects) + 1
        origins, jacobians = np.zeros((batch, count, 3)), np.zeros((batch, count, 6, n))
        turns = np.zeros((batch, count, 3, 3)) + np.eye(3)
        if self._links is not None:
            with torch.inference_mode():
                state = self._links.state(joints.cpu().double()[:, self._columns])
                turns[:, :links] = quaternions.to_matrix(state.orientations).numpy()
            origins[:, :links] = state.positions.numpy()
            jacobians[:, :links][..., self._columns] = state.jacobians.numpy()
        for at, name in enumerate(self.objects, links):
            origins[:, at], turns[:, at], jacobians[:, at] = objects[name]
        turn = turns[:, self.carrier]
        centres = origins[:, self.carrier] + (turn @ self._centres[..., None])[..., 0]
        return Placed(centres, turn @ self._turns, origins, jacobians)

    def least(self, placed: Placed, robots: Indices, pairs: Indices) -> Array:
        """Distances (N,) that some pairs of robots have at least."""
        first, second = self.pairs[pairs].T
        found = np.full(len(pairs), -np.inf)
        for ball, box in ((first, second), (second, first)):
            away = placed.centres[robots, ball] - placed.centres[robots, box]
            local = np.einsum("ni,nij->nj", away, placed.rotations[robots, box])
            outside = np.maximum(np.abs(local - self._middle[box]) - self._half[box], 0.0)
            far = np.sqrt((outside**2).sum(1)) - self._radius[ball]
            found = np.maximum(found, far)
        return found

    def near(self, placed: Placed, within: Array) -> Near:
        """The pairs that are nearer than asked.

        Parameters
        ----------
        placed : Placed
        within : ndarray of shape (B, P)
            How near counts [m].
        """
        measure = mujoco_module("distances").mj_geomDistance
        model, data = self._model, self._data
        first, second = self.pairs.T
        away = placed.centres[:, first] - placed.centres[:, second]
        reach = np.maximum(within + self._radius[first] + self._radius[second], 0.0)
        robots, pairs = np.nonzero((away**2).sum(-1) < reach**2)
        keep = self.least(placed, robots, pairs) < within[robots, pairs]
        robots, pairs = robots[keep], pairs[keep]
        ways, before, bounds = np.zeros((len(robots), 6)), -1, within[robots, pairs]
        distance: Array = np.zeros(len(robots))
        every = (robots.tolist(), *self.pairs[pairs].T.tolist(), bounds.tolist())
        for row, (robot, one, other, bound) in enumerate(zip(*every, strict=True)):
            if robot != before:
                data.geom_xpos[:] = placed.centres[robot]
                data.geom_xmat[:] = placed.rotations[robot].reshape(-1, 9)
                before = robot
            distance[row] = measure(model, data, one, other, bound, ways[row])
        keep = distance < bounds
        robots, pairs, distance = robots[keep], pairs[keep], distance[keep]
        points = ways[keep].reshape(-1, 2, 3)
        way = points[:, 1] - points[:, 0]
        length = np.linalg.norm(way, axis=1, keepdims=True)
        normal = np.where(length > TINY, way / np.maximum(length, TINY), 0.0)
        return Near(robots, pairs, distance, normal * np.sign(distance)[:, None], points)

    def rows(self, placed: Placed, near: Near) -> Array:
        """Derivatives (N, n_joints) of the distances with respect to the joints.

        The nearest points move with what carries them, ``d' = n^T (v_2 - v_1)``, and the
        velocity of a point is ``v + w x r``.
        """
        found: Array = np.zeros((len(near.robot), placed.jacobians.shape[-1]))
        for side, sign in ((0, -1.0), (1, 1.0)):
            at = near.robot, self.carrier[self.pairs[near.pair, side]]
            arm, n = near.points[:, side] - placed.origins[at], near.normal
            turn = arm[:, [1, 2, 0]] * n[:, [2, 0, 1]] - arm[:, [2, 0, 1]] * n[:, [1, 2, 0]]
            twist = np.concatenate((n, turn), axis=1)
            found += sign * np.einsum("ni,nij->nj", twist, placed.jacobians[at])
        return found

    def reach(self, placed: Placed, moved: Array) -> Array:
        """How far, to first order, carriers get (B, C) when joints move by so much.

        Parameters
        ----------
        placed : Placed
        moved : ndarray of shape (B, n_joints)
            Absolute values.
        """
        size = np.sqrt(
            (placed.jacobians.reshape(*placed.jacobians.shape[:2], 2, 3, -1) ** 2).sum(3)
        )
        way: Array = (size[:, :, 0] + self.radius[:, None] * size[:, :, 1]) @ moved[..., None]
        return way[..., 0]


def _of_links(robot: Robot, links: Sequence[str]) -> tuple[Robot | None, list[int] | slice]:
    """The kinematics of links that carry solids, and the columns of its joints.

    Coordinates have units of their own: what they move stands where it is at 0.
    """
    if not links:
        return None, slice(0)
    config = robot.config()
    apart = set(config["coordinates"])
    joints = [name for name in config["joints"] if name not in apart]
    still = dict.fromkeys((n for n in robot.model.actuated_joints if n in apart), 0.0)
    changed = {"links": [*links], "joints": joints, "coordinates": [], "tools": {}}
    changed |= {"locked": {**config["locked"], **still}, "dtype": "float64"}
    columns = [config["joints"].index(name) for name in joints] if apart else slice(None)
    return type(robot).from_config({**config, **changed}), columns


def _flat(shapes: Sequence[Shape]) -> Any:
    """A MuJoCo model with the solids side by side, each posed as in its carrier."""
    mujoco = mujoco_module("distances")
    if tuple(int(part) for part in mujoco.__version__.split(".")[:2]) < RIGHT_DISTANCES:
        raise DependencyError(
            f"MuJoCo {mujoco.__version__} returns wrong distances: pip install 'mujoco>=3.12'"
        )
    spec = mujoco.MjSpec()
    for index, shape in enumerate(shapes):
        geom: dict[str, Any] = {"type": getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}")}
        size = [*shape.size, 0.0, 0.0, 0.0][:3]
        if shape.vertices is not None:
            mesh = spec.add_mesh(name=f"mesh{index}", uservert=shape.vertices.ravel().tolist())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            geom["meshname"], size = mesh.name, [0.0, 0.0, 0.0]
        pose = shape.pose.position.numpy(), shape.pose.orientation.numpy()
        spec.worldbody.add_geom(**geom, size=size, pos=pose[0], quat=pose[1])
    return spec.compile()

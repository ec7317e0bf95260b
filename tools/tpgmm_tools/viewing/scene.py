"""A motion as numbers to draw: poses over time, solids, paths, ellipsoids."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from tpgmm_control.loop.rollout import rollout
from tpgmm_control.obstacles import Scene
from tpgmm_control.obstacles import Shape as Obstacle
from tpgmm_tools.viewing.visuals import OBJECT_COLOR, OBJECT_OPACITY, Color, Shape, whole_body
from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.held_objects import held_objects
from tpgmm_torch.robots.kinematics import RobotState

COLORS: Mapping[str, Color] = {
    "demonstrations": (120, 120, 120),
    "reproduction": (214, 39, 40),
    "covariance": (31, 119, 180),
}
OBSTACLE_COLOR: Color = (110, 110, 110)
#: Obstacles that can be drawn.
DRAWN = ("box", "sphere", "cylinder", "capsule")
#: Of paths [pixels].
THICKNESSES = {"demonstrations": 1.2, "reproduction": 3.5}
#: Half axes of the ellipsoids, in standard deviations.
STANDARD_DEVIATIONS = 2.0
#: Ellipsoids along a path, and points of a path.
ELLIPSOIDS, POINTS = 40, 400
#: Half axes of ellipsoids that would be too thin to be drawn [m].
THINNEST = 5e-4


@dataclass(frozen=True, eq=False)
class Node:
    """A coordinate system that moves or stands still, and the solids in it.

    Parameters
    ----------
    poses : ndarray of shape (F, 7) or (1, 7)
        Position [m] and quaternion, at each picture or always.
    solids : mapping of str to Shape
        By name.
    axes : float
        Length of the axes [m]; 0 if they are not drawn.
    label : str
        Beside the origin.
    """

    poses: Array
    solids: Mapping[str, Shape]
    axes: float = 0.0
    label: str = ""


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """``centres`` (N, 3) [m], ``half_axes`` (N, 3) [m] and ``orientations`` (N, 4)."""

    centres: Array
    half_axes: Array
    orientations: Array


@dataclass(frozen=True, eq=False)
class Drawing:
    """One motion; the parts go by their path in the scene, like ``/robot/hand``.

    Parameters
    ----------
    trajectory : Trajectory
        The reproduction.
    time : ndarray of shape (F,)
        Instants of the pictures, since the start [s].
    nodes : mapping of str to Node
        Links and objects.
    lines, ellipsoids : mapping of str to ndarray (N, 2, 3), mapping of str to Ellipsoids
        Segments of the paths of the links of interest [m], and where these may be.
    axes : mapping of str to ndarray of shape (N, 7)
        Where objects were in the demonstrations.
    size : float
        Diagonal of all that is drawn [m].
    middle : ndarray of shape (3,)
        Where to look, mostly at the action, a little at the robot [m].
    distance, ground : float
        From where to look, and height of the floor [m].
    """

    trajectory: Trajectory
    time: Array
    nodes: Mapping[str, Node]
    lines: Mapping[str, Array]
    ellipsoids: Mapping[str, Ellipsoids]
    axes: Mapping[str, Array]
    size: float
    middle: Array
    distance: float
    ground: float

    def picture(self, seconds: float) -> int:
        """Return the number of the picture at some ``seconds`` after the start."""
        return min(int(np.searchsorted(self.time, seconds - 1e-9)), len(self.time) - 1)


@dataclass(eq=False)
class MotionScene:
    """Draw a model's reproductions.

    Parameters
    ----------
    model : TaskParameterizedGMM
        Fitted, with a robot or with tracked poses.
    demonstrations : sequence of Demonstration, default=()
        Whose paths and frames are drawn.
    objects : mapping of str to Shape, optional
        Shapes of the objects, by the name of their frame; a small box stands for others.
    meshes : Path, optional
        Folder with the files of the robot's meshes.
    fps : float, default=25.0
        Pictures per second.
    obstacles : tpgmm_control.obstacles.Scene, optional
        Whose boxes, spheres, cylinders and capsules are drawn, as far as they stand still.

    Raises
    ------
    DataError
        If the model has no links: joints alone have no place in space.
    """

    model: TaskParameterizedGMM
    demonstrations: Sequence[Demonstration] = ()
    objects: Mapping[str, Shape] | None = None
    meshes: Path | None = None
    fps: float = 25.0
    obstacles: Scene | None = None
    _size: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        kinematics = self.model.kinematics_
        if not kinematics.links:
            raise DataError(
                "the model knows joints only, which have no place in space: to look at its "
                "motion, fit it with a robot and links (tpgmm fit --robot URDF --link NAME)"
            )
        if missing := set(self.objects or ()) - set(self.model.frame_names_):
            raise DataError(
                f"there are shapes for {sorted(missing)}, but the model's frames are "
                f"{list(self.model.frame_names_)}"
            )
        self._links = kinematics.links
        self._body, self._shapes = whole_body(kinematics, self.meshes)
        self._shown = [one.reorder(kinematics.joint_names) for one in self.demonstrations]
        links = range(len(self._links))  # the first of the body's
        self._paths = [
            as_array(self._body.state(one.joints).positions)[:, links] for one in self._shown
        ]

    def draw(self, situation: Situation) -> Drawing:
        """Reproduce the skill in a ``situation``."""
        skill = self.model.skill
        [trajectory] = rollout(skill, [situation], bounds="robot", blend=1.0, candidates=True)
        time, joints = trajectory.time.cpu(), trajectory.joints.cpu()
        steps = _steps(time, self.fps)
        state = self._body.state(joints[steps])
        links = _poses(state.positions, state.orientations)  # (F, L, 7)
        objects = dict(self._object_poses(situation.frames_at(time), state, steps, time))
        action = [links[:, : len(self._links), :3], *self._paths]
        low, high = _bounds([*action, *(poses[..., :3] for poses in objects.values())])
        ground, top = _bounds([links[..., :3], low, high])
        if not self._size:
            self._size = max(float(np.linalg.norm(top - ground)), 0.1)
        lines, where = dict(self._demonstrated_paths()), {}
        every = self._body.state(joints)
        few = np.linspace(0, len(steps) - 1, min(ELLIPSOIDS, len(steps))).astype(int)
        covariance = trajectory.covariance.cpu().to(joints)[steps[few]]
        for link in self._links:
            path = as_array(every.position(link))
            lines[f"/reproduction/{_node(link)}"] = _segments(time, path)
            half_axes, turns = map(as_array, ellipsoids(state[few], covariance, link))
            centres = as_array(state.position(link))[few]
            where[f"/covariance/{_node(link)}"] = Ellipsoids(
                centres, half_axes.clip(min=THINNEST), turns
            )
        return Drawing(
            trajectory,
            as_array(time)[steps] - float(time[0]),
            dict((*self._robot(links), *self._objects(objects), *self._surroundings())),
            lines,
            where,
            dict(self._demonstrated_frames()),
            self._size,
            0.6 * (low + high) / 2 + 0.4 * (ground + top) / 2,
            max(2.1 * float(np.linalg.norm(high - low)), 1.1 * self._size),
            float(ground[2]),
        )

    def robot_poses(self, joints: Tensor) -> dict[str, Array]:
        """Return the poses (1, 7) of all links at ``joints`` (n_joints,), by their path."""
        state = self._body.state(joints.cpu())
        poses = _poses(state.positions, state.orientations)[None]
        return {path: node.poses for path, node in self._robot(poses)}

    def _robot(self, poses: Array) -> Iterator[tuple[str, Node]]:
        for at, link in enumerate(self._body.links):
            solids = {str(n): shape for n, shape in enumerate(self._shapes.get(link, ()))}
            axes = 0.04 * self._size if link in self._links else 0.0
            yield f"/robot/{_node(link)}", Node(poses[:, at], solids, axes)

    def _objects(self, poses: Mapping[str, Array]) -> Iterator[tuple[str, Node]]:
        edges = (0.06 * self._size,) * 3
        unknown = Shape("box", edges, np.eye(4), OBJECT_COLOR, OBJECT_OPACITY)
        for name, some in poses.items():
            solids = {"shape": (self.objects or {}).get(name, unknown)}
            yield f"/frames/{_node(name)}", Node(some, solids, 0.09 * self._size, name)

    def _surroundings(self) -> Iterator[tuple[str, Node]]:
        """Make nodes of obstacles that stand still."""
        known = [] if self.obstacles is None else self.obstacles.shapes
        for number, one in enumerate(known):
            if one.carrier is None and one.kind in DRAWN:
                pose = _poses(one.pose.position, one.pose.orientation)[None]
                yield (
                    f"/obstacles/{number}",
                    Node(pose, dict(_obstacle_solids(one)), label=one.name),
                )

    def _object_poses(
        self, frames: Mapping[str, Frame], state: RobotState, steps: Tensor, time: Tensor
    ) -> Iterator[tuple[str, Array]]:
        """Return poses (F, 7) or (1, 7): recorded until an object is held, then the link's."""
        shown = {name: f[steps] if f.batch_shape else f for name, f in frames.items()}
        holds = [one for one in self.model.holds_ if one.frame in frames]
        taken = {one.frame: one.begin for one in reversed(holds)}
        instants = time[steps]
        rows = {
            name: int((instants < at).sum().clamp(max=len(steps) - 1))
            for name, at in taken.items()
        }
        still = {name: shown[name].expand(steps.shape)[row] for name, row in rows.items()}
        carried, _ = held_objects(state, instants, still, holds)
        for name, frame in shown.items():
            poses = _poses(frame.position, frame.orientation)
            if name in rows:
                pose, free = carried.pose(name), np.arange(len(steps)) < rows[name]
                there = _poses(pose.position, pose.orientation)
                poses = np.where(free[:, None], poses, there)
            yield name, np.atleast_2d(poses)

    def _demonstrated_paths(self) -> Iterator[tuple[str, Array]]:
        for index, link in enumerate(self._links if self._shown else ()):
            pairs = zip(self._shown, self._paths, strict=True)
            segments = [_segments(one.time, path[:, index]) for one, path in pairs]
            yield f"/demonstrations/{_node(link)}", np.concatenate(segments)

    def _demonstrated_frames(self) -> Iterator[tuple[str, Array]]:
        """Collect where objects stood at first: why paths differ."""
        for name in self._shown[0].frames if self._shown else ():
            frames = [one.frames[name] for one in self._shown]
            first = [frame[0] if frame.batch_shape else frame for frame in frames]
            poses = [_poses(frame.position, frame.orientation) for frame in first]
            yield f"/demonstrations/{_node(name)}", np.stack(poses)


def _obstacle_solids(one: Obstacle) -> Iterator[tuple[str, Shape]]:
    """Make the solids that an obstacle is drawn as."""

    def solid(kind: Any, size: tuple[float, ...], height: float = 0.0) -> Shape:
        pose = np.eye(4)
        pose[2, 3] = height
        return Shape(kind, size, pose, OBSTACLE_COLOR, OBJECT_OPACITY)

    radius, *lengths = one.size
    if one.kind == "box":
        yield "box", solid("box", tuple(2 * x for x in one.size))
        return
    half = lengths[0] if lengths else 0.0
    if half:
        yield "side", solid("cylinder", (radius, 2 * half))
    for height in {half, -half} if one.kind != "cylinder" else ():
        yield f"end {height}", solid("sphere", (radius,), height)


def _steps(time: Tensor, fps: float) -> Tensor:
    """Select the time steps to show: the first at or after each picture's instant, the last."""
    instants = torch.arange(float(time[0]), float(time[-1]), 1 / fps, dtype=time.dtype)
    steps = torch.searchsorted(time, instants)
    return torch.cat((steps, torch.tensor([len(time) - 1]))).unique()


def _bounds(points: Sequence[Array]) -> tuple[Array, Array]:
    """Return the least and greatest x, y, z."""
    rows = np.concatenate([some.reshape(-1, 3) for some in points])
    return rows.min(axis=0), rows.max(axis=0)


def _segments(time: Tensor, path: Array) -> Array:
    """Cut a path (T, 3) into segments (N, 2, 3) of equal duration along a cubic spline."""
    instants = as_array(time)
    if len(path) > 1:
        even = np.linspace(instants[0], instants[-1], POINTS)
        path = np.asarray(CubicSpline(instants, path)(even))
    return np.stack((path[:-1], path[1:]), axis=1)


def _poses(positions: Tensor, orientations: Tensor) -> Array:
    return as_array(torch.cat((positions, orientations), dim=-1))


def _node(name: str) -> str:
    """Write a name as one step of a path in the scene."""
    return name.replace("/", "_")


def ellipsoids(state: RobotState, covariance: Tensor, link: str) -> tuple[Tensor, Tensor]:
    """Compute contours of the covariance of a link's position, ``J_p Sigma J_p^T``.

    Parameters
    ----------
    state : RobotState
        At the reproduction's joints, of leading shape (...).
    covariance : Tensor of shape (..., n_joints, n_joints)
        Of the joints, :attr:`Trajectory.covariance`.
    link : str
        Of the robot.

    Returns
    -------
    half_axes : Tensor of shape (..., 3)
        ``STANDARD_DEVIATIONS`` standard deviations along the principal axes, ascending [m].
    orientations : Tensor of shape (..., 4)
        Unit quaternions that turn x, y, z into the principal axes.
    """
    jacobian = state.linear_jacobian(link)
    variances, axes = torch.linalg.eigh(jacobian @ covariance @ jacobian.mT)
    # eigenvectors have a sign to choose: the one that makes them a rotation
    axes = torch.cat(
        (axes[..., :2], axes[..., 2:] * torch.linalg.det(axes)[..., None, None]), -1
    )
    half_axes = STANDARD_DEVIATIONS * variances.clamp(min=0).sqrt()
    return half_axes, quaternions.from_matrix(axes)

"""The scene: what stands still in it, and what moves with time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from torch import Tensor

from tpgmm_tools.viewing.visuals import OBJECT_COLOR, OBJECT_OPACITY, Shape, whole_body
from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.robots.kinematics import RobotState

__all__ = ["COLORS", "STANDARD_DEVIATIONS", "MotionScene", "ellipsoids"]

COLORS = {
    "demonstrations": (120, 120, 120),
    "reproduction": (214, 39, 40),
    "covariance": (31, 119, 180),
}
#: Half axes of the ellipsoids, in standard deviations.
STANDARD_DEVIATIONS = 2.0
#: Ellipsoids along a path, and points of a path, of reproductions and demonstrations.
ELLIPSOIDS, POINTS, DEMONSTRATED_POINTS = 40, 400, 200
#: Edge of the box that stands for an object of no other shape, in a scene of size 1.
EDGE = 0.06
#: Half axes of ellipsoids that would be too thin to be drawn [m].
THINNEST = 5e-4


class MotionScene:
    """A model's motion on a viser server.

    Parameters
    ----------
    server : viser.ViserServer
        Where it is drawn.
    model : TaskParameterizedGMM
        Fitted, with a robot or with tracked poses.
    demonstrations : sequence of Demonstration, default=()
        Whose paths and frames are drawn.
    meshes : Path, optional
        Folder with the files of the robot's meshes.
    fps : float, default=25.0
        Pictures per second.
    on_drag : callable, optional
        Makes frames that stand still movable by hand: called with the name of one and its new
        pose, a :class:`Frame`, when it is let go.
    objects : mapping of str to Shape, optional
        What the objects look like, by the name of their frame; a small box stands for others.
    root : str, optional
        Begins the path of all that is drawn, where several scenes share a server: "/second".
    origin : sequence of float, optional
        Where it is drawn, x, y, z [m].

    Attributes
    ----------
    time : ndarray of shape (F,)
        Instants of the pictures that :meth:`move_to` shows [s]; empty before :meth:`show`.
    frames : dict of str to viser.SceneNodeHandle
        The objects that are shown.
    server : viser.ViserServer
    root : str
    size : float
        Diagonal of what is drawn [m]; 0 before :meth:`show`.

    Raises
    ------
    DataError
        If the model has no links: joints alone have no place in space.
    """

    def __init__(
        self,
        server: Any,
        model: TaskParameterizedGMM,
        demonstrations: Sequence[Demonstration] = (),
        meshes: Path | None = None,
        fps: float = 25.0,
        on_drag: Callable[[str, Frame], None] | None = None,
        *,
        objects: Mapping[str, Shape] | None = None,
        root: str = "",
        origin: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        kinematics = model.kinematics_
        if not kinematics.links:
            raise DataError(
                "the model knows joints only, which have no place in space: to look at its "
                "motion, fit it with a robot and links (tpgmm fit --robot URDF --link NAME)"
            )
        self.server, self._scene, self._model = server, server.scene, model
        self._fps, self._on_drag, self.root, self.size = fps, on_drag, root, 0.0
        self._objects = dict(objects or {})
        if missing := self._objects.keys() - set(model.frame_names_):
            raise DataError(
                f"there are shapes for {sorted(missing)}, but the model's frames are "
                f"{list(model.frame_names_)}"
            )
        if root:
            self._scene.add_frame(root, show_axes=False, position=tuple(origin))
        self._of_interest = kinematics.links
        self._body, self._shapes = whole_body(kinematics, meshes)
        self._demonstrations = [one.reordered(kinematics.joint_names) for one in demonstrations]
        self._links: list[Any] = []
        self.frames: dict[str, Any] = {}
        self._frame_poses: dict[str, Array] = {}
        self.time: Array = np.zeros(0)

    def show(self, situation: Situation) -> Trajectory:
        """Reproduce the skill in a situation and draw it, in place of the one before."""
        [trajectory] = self._model.predict([situation])
        steps = _steps(trajectory.time.cpu(), self._fps)
        state = self._body.state(trajectory.joints.cpu()[steps])
        covariance = trajectory.covariance.cpu().to(state.joints)[steps]
        self.time = as_array(trajectory.time)[steps]
        self._link_poses = _poses(state.positions, state.orientations)  # (F, L, 7)
        frames = situation.frames_at(trajectory.time.cpu())
        self._still = {name for name, frame in frames.items() if not frame.batch_shape}
        self._frame_poses = {name: _poses_at(f, steps) for name, f in frames.items()}
        for hold in self._model.holds_:
            if hold.frame in self._still:
                carried = _carried(hold, frames[hold.frame], state, self.time)
                self._frame_poses[hold.frame] = carried
        if not self._links:
            self._set_up()
        every = self._body.state(trajectory.joints.cpu())
        few = np.linspace(0, len(steps) - 1, min(ELLIPSOIDS, len(steps))).astype(int)
        for link in self._of_interest:
            path = as_array(state.position(link))
            smooth = _smooth(trajectory.time, as_array(every.position(link)), POINTS)
            self._draw_paths("reproduction", link, [smooth], thickness=3.5)
            half_axes, turns = ellipsoids(state[few], covariance[few], link)
            self._draw_ellipsoids(link, path[few], as_array(half_axes), as_array(turns))
        self._replace_frames()
        self.move_to(0)
        return trajectory

    def move_to(self, picture: int) -> None:
        """Put everything that moves where it is at ``time[picture]``."""
        self._place_links(self._link_poses[picture])
        self._move_frames(picture)

    def move_robot(self, joints: Tensor, picture: int) -> None:
        """Put the robot at ``joints`` (n_joints,) instead, and objects as at a picture."""
        state = self._body.state(joints.cpu())
        self._place_links(_poses(state.positions, state.orientations))
        self._move_frames(picture)

    def _place_links(self, poses: Array) -> None:
        for handle, pose in zip(self._links, poses, strict=True):
            _place(handle, pose)

    def _move_frames(self, picture: int) -> None:
        for name, poses in self._frame_poses.items():
            if len(poses) > 1:
                _place(self.frames[name], poses[picture])

    def _set_up(self) -> None:
        """Everything that is the same in all situations."""
        links = range(len(self._of_interest))  # the first of the body's
        self._demonstrated = [
            as_array(self._body.state(one.joints).positions)[:, links]
            for one in self._demonstrations
        ]
        action = [self._link_poses[:, links, :3], *self._demonstrated]
        action += [poses[..., :3] for poses in self._frame_poses.values()]
        low, high = _bounds(action)
        ground, top = _bounds([self._link_poses[..., :3], low, high])
        self.size = size = max(float(np.linalg.norm(top - ground)), 0.1)
        # mostly at the action, a little at the robot
        middle = 0.6 * (low + high) / 2 + 0.4 * (ground + top) / 2
        distance = max(2.1 * float(np.linalg.norm(high - low)), 1.1 * size)
        if not self.root:
            self._set_view(middle, distance, size, float(ground[2]))
        self._draw_robot()
        self._draw_demonstrations()

    def _set_view(self, middle: Array, distance: float, size: float, ground: float) -> None:
        """Camera, lights and floor."""
        camera = self.server.initial_camera
        camera.look_at = middle
        camera.position = middle + distance * np.array([0.8, 0.5, 0.35])
        camera.fov = 0.75
        self._scene.configure_default_lights(cast_shadow=False)
        cell = 10.0 ** np.floor(np.log10(size / 2))
        self._scene.add_grid(
            "/ground",
            *(2 * np.ceil(size / cell) * cell,) * 2,
            cell_size=cell,
            section_size=10 * cell,
            cell_color=(225, 225, 225),
            section_color=(190, 190, 190),
            position=(*np.round(middle[:2] / cell) * cell, ground - 0.02 * size),
        )

    def _draw_robot(self) -> None:
        for link in self._body.links:
            handle = self._axes(
                f"{self.root}/robot/{_node(link)}", 0.04, link in self._of_interest
            )
            self._links.append(handle)
            for number, shape in enumerate(self._shapes.get(link, ())):
                _add_solid(self._scene, f"{handle.name}/{number}", shape)

    def _draw_demonstrations(self) -> None:
        """Paths, and where objects stood, small: why paths differ."""
        for index, link in enumerate(self._of_interest if self._demonstrated else ()):
            paths = [
                _smooth(one.time, path[:, index], DEMONSTRATED_POINTS)
                for one, path in zip(self._demonstrations, self._demonstrated, strict=True)
            ]
            self._draw_paths("demonstrations", link, paths, thickness=1.2)
        for name in self._demonstrations[0].frames if self._demonstrations else ():
            frames = [one.frames[name] for one in self._demonstrations]
            poses = np.stack([_poses_at(frame, torch.tensor([0]))[0] for frame in frames])
            self._scene.add_batched_axes(
                f"{self.root}/demonstrations/{_node(name)}",
                batched_wxyzs=poses[:, 3:],
                batched_positions=poses[:, :3],
                axes_length=0.025 * self.size,
                axes_radius=0.0012 * self.size,
            )

    def _draw_paths(
        self, kind: str, link: str, paths: Sequence[Array], thickness: float
    ) -> None:
        pieces = [np.stack((path[:-1], path[1:]), axis=1) for path in paths]
        self._scene.add_line_segments(
            f"{self.root}/{kind}/{_node(link)}",
            points=np.concatenate(pieces),
            colors=COLORS[kind],
            thickness=thickness,
            thickness_units="screen",
        )

    def _draw_ellipsoids(
        self, link: str, centres: Array, half_axes: Array, turns: Array
    ) -> None:
        vertices, faces = _unit_sphere()
        self._scene.add_batched_meshes_simple(
            f"{self.root}/covariance/{_node(link)}",
            vertices,
            faces,
            batched_positions=centres,
            batched_wxyzs=turns,
            batched_scales=half_axes.clip(min=THINNEST),
            batched_colors=COLORS["covariance"],
            opacity=0.35,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def _replace_frames(self) -> None:
        """Objects of the situation; what is there already only changes its place."""
        for name in self.frames.keys() - self._frame_poses.keys():
            self.frames.pop(name).remove()
        for name, poses in self._frame_poses.items():
            if name not in self.frames:
                self.frames[name] = self._add_frame(name, moves=name not in self._still)
            _place(self.frames[name], poses[0])

    def _add_frame(self, name: str, moves: bool) -> Any:
        path, drag = f"{self.root}/frames/{_node(name)}", self._on_drag
        if drag is None or moves:
            handle = self._axes(path, 0.09)
        else:
            handle = self._scene.add_transform_controls(
                path, scale=0.12 * self.size, disable_sliders=True
            )
            self._axes(f"{path}/axes", 0.09)
            handle.on_update(partial(_let_go, drag, name))
        self._scene.add_label(f"{path}/label", name)
        edges = (EDGE * self.size,) * 3
        unknown = Shape("box", edges, np.eye(4), OBJECT_COLOR, OBJECT_OPACITY)
        _add_solid(self._scene, f"{path}/shape", self._objects.get(name, unknown))
        return handle

    def _axes(self, path: str, length: float, show: bool = True) -> Any:
        """Axes of a length, and of the radius that goes with it, for a scene of size 1."""
        length *= self.size
        return self._scene.add_frame(
            path, show, axes_length=length, axes_radius=0.03 * length, origin_radius=0.0
        )


def _let_go(drag: Callable[[str, Frame], None], name: str, event: Any) -> None:
    if event.phase == "end":
        drag(name, Frame(event.target.position, event.target.wxyz))


def _steps(time: Tensor, fps: float) -> Tensor:
    """Which time steps are shown: the first at or after each picture's instant, the last."""
    wanted = torch.arange(float(time[0]), float(time[-1]), 1 / fps, dtype=time.dtype)
    steps = torch.searchsorted(time, wanted)
    return torch.cat((steps, torch.tensor([len(time) - 1]))).unique()


def _bounds(points: Sequence[Array]) -> tuple[Array, Array]:
    """Least and greatest x, y, z."""
    rows = np.concatenate([some.reshape(-1, 3) for some in points])
    return rows.min(axis=0), rows.max(axis=0)


def _smooth(time: Tensor, path: Array, points: int) -> Array:
    """A path (T, 3) at so many evenly spaced instants, by a cubic spline through all of it."""
    if len(path) < 2:
        return path[[0, 0]]
    instants = as_array(time)
    spline = CubicSpline(instants, path)
    return np.asarray(spline(np.linspace(instants[0], instants[-1], points)))


def _carried(hold: Hold, frame: Frame, state: RobotState, time: Array) -> Array:
    """Poses (F, 7) of an object that stands at a frame until a link takes it along."""
    link = Frame(state.position(hold.link), state.orientation(hold.link))
    poses = np.tile(_poses_at(frame, torch.zeros(0)), (len(time), 1))
    [held] = np.nonzero((time >= hold.begin) & (time <= hold.end))
    if len(held):
        in_link = frame.seen_from(link[int(held[0])])
        moved = link[torch.from_numpy(held)].compose(in_link.expand((len(held),)))
        poses[held] = _poses(moved.position, moved.orientation)
        poses[held[-1] :] = poses[held[-1]]
    return poses


def _poses(positions: Tensor, orientations: Tensor) -> Array:
    return as_array(torch.cat((positions, orientations), dim=-1))


def _poses_at(frame: Frame, steps: Tensor) -> Array:
    """(F, 7) of a frame that moves, (1, 7) of one that stands still."""
    poses = _poses(frame.position, frame.orientation)
    return poses[steps.numpy()] if frame.batch_shape else poses[None]


def _place(handle: Any, pose: Array) -> None:
    handle.position, handle.wxyz = pose[:3], pose[3:]


def _node(name: str) -> str:
    """A name as one step of a path in the scene."""
    return name.replace("/", "_")


def ellipsoids(state: RobotState, covariance: Tensor, link: str) -> tuple[Tensor, Tensor]:
    """Contours of the covariance of a link's position, ``J_p Sigma J_p^T`` to first order.

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


def _add_solid(scene: Any, name: str, shape: Shape) -> Any:
    """Add a shape below the node of its link; a file that cannot be read is a DataError."""
    turn = torch.from_numpy(np.ascontiguousarray(shape.pose[:3, :3]))
    placed: dict[str, Any] = {
        "position": shape.pose[:3, 3],
        "wxyz": quaternions.from_matrix(turn).numpy(),
        "color": shape.color,
        "opacity": None if shape.opacity >= 1 else shape.opacity,
    }
    match shape.kind:
        case "box":
            return scene.add_box(name, dimensions=shape.size, **placed)
        case "sphere":
            return scene.add_icosphere(name, *shape.size, **placed)
        case "cylinder":
            radius, length = shape.size
            return scene.add_cylinder(name, radius, length, **placed)
    vertices, faces = _mesh(shape)
    return scene.add_mesh_simple(name, vertices, faces, **placed)


def _unit_sphere() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (F, 3) of a ball of radius 1."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(ball.vertices), np.asarray(ball.faces)


def _mesh(shape: Shape) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) [m] and triangles (F, 3); of the formats COLLADA alone tells its unit."""
    import trimesh

    try:
        mesh = trimesh.load_mesh(shape.file)
        unit = trimesh.units.unit_conversion(mesh.units, "meters") if mesh.units else 1.0
        return np.asarray(mesh.vertices) * unit * shape.size, np.asarray(mesh.faces)
    except ImportError as error:
        raise DependencyError(
            f"the mesh {shape.file} needs pycollada: pip install 'tpgmm-torch[collada]'"
        ) from error
    except Exception as error:  # whatever a reader of one of many formats raises
        raise DataError(f"the mesh {shape.file} cannot be read: {error}") from error

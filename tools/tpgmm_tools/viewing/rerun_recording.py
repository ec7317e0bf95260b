"""The same motion as a Rerun recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tpgmm_tools.viewing.curves import motion_marks, motion_panels
from tpgmm_tools.viewing.scene import MotionScene
from tpgmm_tools.viewing.visuals import Shape
from tpgmm_torch.atomic import replacing
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DependencyError

__all__ = ["write_rerun"]

#: Of the time line.
TIME = "time"
#: Where what happens, or begins, is logged.
MARKS = "marks"


def write_rerun(
    path: str | Path,
    model: TaskParameterizedGMM,
    situation: Situation,
    demonstrations: Sequence[Demonstration] = (),
    *,
    objects: Mapping[str, Shape] | None = None,
    meshes: Path | None = None,
    fps: float = 25.0,
    title: str = "tpgmm",
) -> Trajectory:
    """Write what :func:`~tpgmm_tools.viewing.write_motion` shows as a ``.rrd`` file.

    Parameters
    ----------
    path : str or Path
        The file; replaced if it exists. ``rerun FILE`` opens it.
    model, situation, demonstrations, objects, meshes, fps
        As for :func:`~tpgmm_tools.viewing.write_motion`, of one situation.
    title : str, default="tpgmm"
        Of the recording.

    Returns
    -------
    Trajectory
        What the file shows.

    Raises
    ------
    DependencyError, DataError
        If rerun-sdk is not installed, or the model has no links that can be drawn.
    """
    try:
        import rerun
    except ImportError as error:
        raise DependencyError(
            "Rerun recordings need rerun-sdk: pip install 'tpgmm-torch[rerun]'"
        ) from error
    with replacing(path) as new:
        recording = rerun.RecordingStream("tpgmm", send_properties=True)
        recording.save(new)
        recording.send_recording_name(title)
        drawing = _Drawing(rerun, recording)
        server = SimpleNamespace(scene=drawing, initial_camera=SimpleNamespace())
        scene = MotionScene(server, model, demonstrations, meshes, fps, objects=objects)
        trajectory = scene.show(situation)
        for picture, now in enumerate(scene.time - scene.time[0]):
            recording.set_time(TIME, duration=float(now))
            scene.move_to(picture)
        for panel in motion_panels(model, trajectory):
            for curve in panel.curves:
                entity = f"curves/{panel.title}/{curve.label or panel.title}".replace(" ", "_")
                rgb = [int(curve.color[at : at + 2], 16) for at in (1, 3, 5)]
                style = rerun.SeriesLines(colors=[rgb], names=[curve.label or panel.title])
                recording.log(entity, style, static=True)
                times = rerun.TimeColumn(TIME, duration=panel.time)
                values = rerun.Scalars.columns(scalars=curve.values)
                recording.send_columns(entity, [times], values)
        for mark in motion_marks(model, trajectory):
            recording.set_time(TIME, duration=mark.time)
            recording.log(MARKS, rerun.TextLog(mark.label))
        recording.flush()
        recording.disconnect()
    return trajectory


class _Node:
    """A node of the scene; what is assigned to its pose is recorded at the present instant."""

    def __init__(self, drawing: _Drawing, name: str, pose: Mapping[str, Any]) -> None:
        self._drawing, self.name = drawing, name
        self._position = pose.get("position", (0.0, 0.0, 0.0))
        self._wxyz = pose.get("wxyz", (1.0, 0.0, 0.0, 0.0))

    @property
    def position(self) -> Any:
        return self._position

    @position.setter
    def position(self, value: Any) -> None:
        self._position = value  # the orientation is always assigned after it

    @property
    def wxyz(self) -> Any:
        return self._wxyz

    @wxyz.setter
    def wxyz(self, value: Any) -> None:
        self._wxyz = value
        self._drawing.place(self.name, self._position, value)


class _Drawing:
    """As much of viser's scene as :class:`MotionScene` uses, drawn by Rerun.

    Parameters
    ----------
    rerun : module
    recording : rerun.RecordingStream
    """

    def __init__(self, rerun: Any, recording: Any) -> None:
        self._rr, self._recording = rerun, recording

    def place(self, name: str, position: ArrayLike, wxyz: ArrayLike) -> None:
        """Put a node somewhere in its parent, from now on."""
        w, x, y, z = np.asarray(wxyz, dtype=float)
        pose = self._rr.Transform3D(translation=np.asarray(position), quaternion=[x, y, z, w])
        self._recording.log(name, pose)

    def _add(self, name: str, *parts: Any, **placed: Any) -> _Node:
        node = _Node(self, name, placed)
        w, x, y, z = np.asarray(node.wxyz, dtype=float)
        pose = self._rr.Transform3D(
            translation=np.asarray(node.position), quaternion=[x, y, z, w]
        )
        if placed:
            self._recording.log(name, pose, static=True)
        for part in parts:
            self._recording.log(name, part, static=True)
        return node

    def _solid(self, placed: dict[str, Any]) -> tuple[list[Any], Any]:
        """Colour, and how solids are filled."""
        opacity = placed.pop("opacity", None)
        red, green, blue = placed.pop("color")
        alpha = 255 if opacity is None else round(255 * opacity)
        return [(red, green, blue, alpha)], self._rr.components.FillMode.Solid

    def configure_default_lights(self, **_options: Any) -> None:
        """The viewer has its own."""

    def add_grid(self, *_place: Any, **_options: Any) -> None:
        """The viewer has its own."""

    def add_frame(
        self, name: str, show_axes: bool = True, *, axes_length: float = 0.0, **_options: Any
    ) -> _Node:
        axes = self._rr.TransformAxes3D(axes_length) if show_axes else ()
        return self._add(name, *([axes] if show_axes else ()))

    def add_label(self, name: str, text: str) -> _Node:
        return self._add(name, self._rr.Points3D([[0, 0, 0]], labels=[text], radii=[0]))

    def add_line_segments(
        self, name: str, points: Any, colors: Any, thickness: float, **_options: Any
    ) -> _Node:
        radii = self._rr.Radius.ui_points(thickness / 2)
        return self._add(name, self._rr.LineStrips3D(points, colors=[colors], radii=radii))

    def add_batched_axes(
        self, name: str, *, batched_wxyzs: Any, batched_positions: Any, axes_length: float,
        **_options: Any,
    ) -> _Node:  # fmt: skip
        for number, pose in enumerate(zip(batched_positions, batched_wxyzs, strict=True)):
            node = f"{name}/{number}"
            self._add(
                node, self._rr.TransformAxes3D(axes_length), position=pose[0], wxyz=pose[1]
            )
        return self._add(name)

    def add_batched_meshes_simple(
        self, name: str, vertices: Any, faces: Any, *, batched_positions: Any,
        batched_wxyzs: Any, batched_scales: Any, batched_colors: Any, opacity: float,
        **_options: Any,
    ) -> _Node:  # fmt: skip
        """Ellipsoids: the mesh that is scaled is a ball."""
        ellipsoids = self._rr.Ellipsoids3D(
            half_sizes=batched_scales,
            centers=batched_positions,
            quaternions=np.roll(batched_wxyzs, -1, axis=1),
            colors=[(*batched_colors, round(255 * opacity))],
            fill_mode=self._rr.components.FillMode.Solid,
        )
        return self._add(name, ellipsoids)

    def add_box(self, name: str, *, dimensions: Any, **placed: Any) -> _Node:
        colors, fill = self._solid(placed)
        box = self._rr.Boxes3D(sizes=[dimensions], colors=colors, fill_mode=fill)
        return self._add(name, box, **placed)

    def add_icosphere(self, name: str, radius: float, **placed: Any) -> _Node:
        colors, fill = self._solid(placed)
        ball = self._rr.Ellipsoids3D(radii=[radius], colors=colors, fill_mode=fill)
        return self._add(name, ball, **placed)

    def add_cylinder(self, name: str, radius: float, length: float, **placed: Any) -> _Node:
        colors, fill = self._solid(placed)
        solid = self._rr.Cylinders3D(
            lengths=[length], radii=[radius], colors=colors, fill_mode=fill
        )
        return self._add(name, solid, **placed)

    def add_mesh_simple(self, name: str, vertices: Any, faces: Any, **placed: Any) -> _Node:
        colors, _ = self._solid(placed)
        mesh = self._rr.Mesh3D(
            vertex_positions=vertices, triangle_indices=faces, albedo_factor=colors[0]
        )
        return self._add(name, mesh, **placed)

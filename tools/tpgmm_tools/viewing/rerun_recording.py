"""The same motion as a Rerun recording, for LeRobot's own viewer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tpgmm_tools.viewing.curves import motion_marks, motion_panels
from tpgmm_tools.viewing.scene import COLORS, MotionScene
from tpgmm_tools.viewing.visuals import Shape, mesh
from tpgmm_torch import quaternions
from tpgmm_torch.atomic import replacing
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DependencyError

__all__ = ["write_rerun"]

#: Of the time line.
TIME = "time"


def write_rerun(
    path: str | Path,
    model: TaskParameterizedGMM,
    situation: Situation,
    demonstrations: Sequence[Demonstration] = (),
    *,
    title: str = "tpgmm",
    **how: Any,
) -> Trajectory:
    """Write a reproduction as a Rerun recording, a ``.rrd`` file.

    It shows the same as :func:`~tpgmm_tools.viewing.write_motion`.

    Parameters
    ----------
    path : str or Path
        The file; replaced if it exists. ``rerun FILE`` opens it.
    model, situation, demonstrations
        As for :func:`~tpgmm_tools.viewing.write_motion`, of one situation.
    title : str, default="tpgmm"
        Of the recording.
    **how
        ``objects``, ``meshes``, ``fps`` and ``obstacles``, as for :class:`MotionScene`.

    Returns
    -------
    Trajectory
        The reproduction.

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
    drawing = MotionScene(model, demonstrations, **how).draw(situation)

    def pose(values: Array) -> Any:
        return rerun.Transform3D(translation=values[:3], quaternion=np.roll(values[3:], -1))

    with replacing(path) as new:
        recording = rerun.RecordingStream("tpgmm", send_properties=True)
        recording.save(new)
        recording.send_recording_name(title)

        def log(entity: str, *parts: Any) -> None:
            for part in parts:
                recording.log(entity, part, static=True)

        for name, node in drawing.nodes.items():
            if node.axes:
                log(name, rerun.TransformAxes3D(node.axes))
            if node.label:
                origin = [[0.0, 0.0, 0.0]]
                log(f"{name}/label", rerun.Points3D(origin, labels=[node.label], radii=[0]))
            for solid, shape in node.solids.items():
                turn = torch.from_numpy(np.ascontiguousarray(shape.pose[:3, :3]))
                turned = quaternions.from_matrix(turn).numpy()
                placed = pose(np.concatenate((shape.pose[:3, 3], turned)))
                log(f"{name}/{solid}", placed, _solid(rerun, shape))
        for name, lines in drawing.lines.items():
            radii = rerun.Radius.ui_points(lines.thickness / 2)
            log(name, rerun.LineStrips3D(lines.points, colors=[lines.color], radii=radii))
        for name, some in drawing.ellipsoids.items():
            parts = rerun.Ellipsoids3D(
                half_sizes=some.half_axes,
                centers=some.centres,
                quaternions=np.roll(some.orientations, -1, axis=1),
                colors=[(*COLORS["covariance"], 90)],
                fill_mode=rerun.components.FillMode.Solid,
            )
            log(name, parts)
        for name, poses in drawing.axes.items():
            for number, values in enumerate(poses):
                axes = rerun.TransformAxes3D(0.025 * drawing.size)
                log(f"{name}/{number}", pose(values), axes)
        for picture, now in enumerate(drawing.time):
            recording.set_time(TIME, duration=float(now))
            for name, node in drawing.nodes.items():
                if picture == 0 or len(node.poses) > 1:
                    recording.log(name, pose(node.poses[picture]))
        for panel in motion_panels(model, drawing.trajectory):
            for curve in panel.curves:
                label = curve.label or panel.title
                entity = f"curves/{panel.title}/{label}".replace(" ", "_")
                rgb = [int(curve.color[at : at + 2], 16) for at in (1, 3, 5)]
                log(entity, rerun.SeriesLines(colors=[rgb], names=[label]))
                times = rerun.TimeColumn(TIME, duration=panel.time)
                values = rerun.Scalars.columns(scalars=curve.values)
                recording.send_columns(entity, [times], values)
        for mark in motion_marks(model, drawing.trajectory):
            recording.set_time(TIME, duration=mark.time)
            recording.log("marks", rerun.TextLog(mark.label))
        recording.flush()
        recording.disconnect()
    return drawing.trajectory


def _solid(rerun: Any, shape: Shape) -> Any:
    color = (*shape.color, round(255 * shape.opacity))
    look = {"colors": [color], "fill_mode": rerun.components.FillMode.Solid}
    if shape.kind == "box":
        return rerun.Boxes3D(sizes=[shape.size], **look)
    if shape.kind == "sphere":
        return rerun.Ellipsoids3D(radii=[shape.size[0]], **look)
    if shape.kind == "cylinder":
        return rerun.Cylinders3D(radii=[shape.size[0]], lengths=[shape.size[1]], **look)
    vertices, faces = mesh(shape)
    return rerun.Mesh3D(vertex_positions=vertices, triangle_indices=faces, albedo_factor=color)

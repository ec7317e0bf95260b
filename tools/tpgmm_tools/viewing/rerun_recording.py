"""The same motion as a Rerun recording, for LeRobot's own viewer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tpgmm_tools.viewing.curves import Mark, Panel, motion_marks, motion_panels
from tpgmm_tools.viewing.scene import COLORS, Drawing, MotionScene, Node
from tpgmm_tools.viewing.visuals import Shape, mesh
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
    trajectory = drawing.trajectory
    with replacing(path) as new:
        recording = rerun.RecordingStream("tpgmm", send_properties=True)
        recording.save(new)
        recording.send_recording_name(title)
        writer = _Writer(rerun, recording)
        for name, node in drawing.nodes.items():
            writer.write_node(name, node)
        writer.write_paths(drawing)
        writer.write_motion(drawing)
        writer.write_curves(motion_panels(model, trajectory), motion_marks(model, trajectory))
        recording.flush()
        recording.disconnect()
    return trajectory


class _Writer:
    """Write parts of a drawing into a recording.

    Parameters
    ----------
    rerun, recording : module, rerun.RecordingStream
        Imported late, as it is optional; and where to write.
    """

    def __init__(self, rerun: Any, recording: Any) -> None:
        self.rerun, self.recording = rerun, recording

    def write_node(self, name: str, node: Node) -> None:
        """Write a coordinate system and its solids, but not where it is."""
        rerun = self.rerun
        if node.axes:
            self._log(name, rerun.TransformAxes3D(node.axes))
        if node.label:
            label = rerun.Points3D([[0.0, 0.0, 0.0]], labels=[node.label], radii=[0])
            self._log(f"{name}/label", label)
        for solid, shape in node.solids.items():
            self._log(f"{name}/{solid}", self._pose(shape.placement), self._solid(shape))

    def write_paths(self, drawing: Drawing) -> None:
        """Write paths, ellipsoids, and where objects were."""
        rerun = self.rerun
        for name, lines in drawing.lines.items():
            radii = rerun.Radius.ui_points(lines.thickness / 2)
            strips = rerun.LineStrips3D(lines.points, colors=[lines.color], radii=radii)
            self._log(name, strips)
        for name, some in drawing.ellipsoids.items():
            ellipsoids = rerun.Ellipsoids3D(
                half_sizes=some.half_axes,
                centers=some.centres,
                quaternions=np.roll(some.orientations, -1, axis=1),
                **self._look(COLORS["covariance"], 90),
            )
            self._log(name, ellipsoids)
        axes = rerun.TransformAxes3D(0.025 * drawing.size)
        for name, poses in drawing.axes.items():
            for number, pose in enumerate(poses):
                self._log(f"{name}/{number}", self._pose(pose), axes)

    def write_motion(self, drawing: Drawing) -> None:
        """Write where the nodes are in each picture."""
        for picture, now in enumerate(drawing.time):
            self.recording.set_time(TIME, duration=float(now))
            for name, node in drawing.nodes.items():
                if picture == 0 or len(node.poses) > 1:
                    self.recording.log(name, self._pose(node.poses[picture]))

    def write_curves(self, panels: Iterable[Panel], marks: Iterable[Mark]) -> None:
        """Write curves over time, and events."""
        rerun = self.rerun
        for panel, curve in ((one, curve) for one in panels for curve in one.curves):
            label = curve.label or panel.title
            entity = f"curves/{panel.title}/{label}".replace(" ", "_")
            rgb = [int(curve.color[at : at + 2], 16) for at in (1, 3, 5)]
            self._log(entity, rerun.SeriesLines(colors=[rgb], names=[label]))
            times = rerun.TimeColumn(TIME, duration=panel.time)
            values = rerun.Scalars.columns(scalars=curve.values)
            self.recording.send_columns(entity, [times], values)
        for mark in marks:
            self.recording.set_time(TIME, duration=mark.time)
            self.recording.log("marks", rerun.TextLog(mark.label))

    def _log(self, entity: str, *parts: Any) -> None:
        for part in parts:
            self.recording.log(entity, part, static=True)

    def _pose(self, pose: Array) -> Any:
        turn = np.roll(pose[3:], -1)
        return self.rerun.Transform3D(translation=pose[:3], quaternion=turn)

    def _look(self, color: Sequence[int], opacity: int) -> dict[str, Any]:
        solid = self.rerun.components.FillMode.Solid
        return {"colors": [(*color, opacity)], "fill_mode": solid}

    def _solid(self, shape: Shape) -> Any:
        rerun, look = self.rerun, self._look(shape.color, round(255 * shape.opacity))
        match shape.kind:
            case "box":
                return rerun.Boxes3D(sizes=[shape.size], **look)
            case "sphere":
                return rerun.Ellipsoids3D(radii=[shape.size[0]], **look)
            case "cylinder":
                return rerun.Cylinders3D(radii=[shape.size[0]], lengths=[shape.size[1]], **look)
        points, faces = mesh(shape)
        [color] = look["colors"]
        return rerun.Mesh3D(
            vertex_positions=points, triangle_indices=faces, albedo_factor=color
        )

"""A motion in the browser, by viser: one HTML file, or live, with objects to move by hand."""

from __future__ import annotations

import html
import io
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from tpgmm_control.loop.command import Command
from tpgmm_control.loop.controller import Controller
from tpgmm_tools.viewing.curves import as_html, motion_marks, motion_panels
from tpgmm_tools.viewing.scene import (
    COLORS,
    STANDARD_DEVIATIONS,
    THICKNESSES,
    Drawing,
    MotionScene,
    Node,
)
from tpgmm_tools.viewing.visuals import Shape, mesh, unit_ball
from tpgmm_torch.atomic import replacing
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DependencyError

__all__ = ["write_motion"]

#: How long the last picture stands before the motion starts again [s].
PAUSE = 1.0
OnDrag = Callable[[str, Any], None]


def write_motion(
    path: str | Path,
    model: TaskParameterizedGMM,
    situation: Situation,
    demonstrations: Sequence[Demonstration] = (),
    *,
    title: str = "tpgmm",
    **how: Any,
) -> Trajectory:
    """Write a reproduction as an HTML file with a time line, which needs nothing else.

    Beside the scene are stiffness and each operator's share over time, with the events of the
    demonstrations.

    Parameters
    ----------
    path : str or Path
        The file; replaced if it exists.
    model : TaskParameterizedGMM
        Fitted, with a robot or with tracked poses.
    situation : Situation
        Where the skill is reproduced.
    demonstrations : sequence of Demonstration, default=()
        Whose paths and frames are drawn.
    title : str, default="tpgmm"
        Of the page.
    **how
        ``objects``, ``meshes``, ``fps`` and ``obstacles``, as for :class:`MotionScene`.

    Returns
    -------
    Trajectory
        The reproduction.

    Raises
    ------
    DependencyError, DataError
        If viser is not installed, or the model has no links that can be drawn.
    """
    drawing = MotionScene(model, demonstrations, **how).draw(situation)
    trajectory, clock = drawing.trajectory, drawing.time
    with viser_server("127.0.0.1", 0) as server:
        handles = draw(server.scene, drawing)
        _set_view(server, drawing)
        recording = server.get_scene_serializer()
        for picture, pause in enumerate([*np.diff(clock), PAUSE]):
            move(handles, drawing.nodes, picture)
            recording.insert_sleep(float(pause))
        page = recording.as_html()
    curves = as_html(motion_panels(model, trajectory), motion_marks(model, trajectory))
    before, body, after = page.rpartition("</body>")
    page = before + _legend(title, bool(demonstrations), curves) + body + after
    title = f"<title>{html.escape(title)}</title>"
    with replacing(path) as new:
        new.write_text(page.replace("<title>Viser</title>", title, 1), encoding="utf-8")
    return trajectory


def _legend(title: str, with_demonstrations: bool, curves: str) -> str:
    """Write the colours' meaning, and the curves, along the lower edge."""
    entries = {
        "reproduction": "reproduction",
        "covariance": f"where the link may be: {STANDARD_DEVIATIONS:g} standard deviations",
    }
    if with_demonstrations:
        entries["demonstrations"] = "demonstrations; small axes: where objects stood"
    lines = "".join(
        f'<div><span style="color:rgb{COLORS[kind]}">&#9632;</span> {text}</div>'
        for kind, text in entries.items()
    )
    style = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
    return (
        f'<style>{style}</style><div id="legend">'
        f"<div><b>{html.escape(title)}</b>{lines}</div>{curves}</div>"
    )


@contextmanager
def viser_server(host: str, port: int) -> Iterator[Any]:
    """Serve by viser on ``host`` and ``port`` (0 for any that is free), and stop in the end.

    Raises
    ------
    DependencyError
        If viser is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise DependencyError(
            "looking at motions needs viser: pip install 'tpgmm-torch[cli]'"
        ) from error
    with redirect_stdout(io.StringIO()):  # it prints, whatever its options say
        server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def draw(
    scene: Any,
    drawing: Drawing,
    handles: Mapping[str, Any] | None = None,
    on_drag: OnDrag | None = None,
) -> dict[str, Any]:
    """Draw into a viser scene, and return its nodes by their path.

    Parameters
    ----------
    scene : viser.SceneApi
        Where it is drawn.
    drawing : Drawing
        The motion.
    handles : mapping of str to viser.SceneNodeHandle, optional
        Nodes that are there already, of another motion of the same model.
    on_drag : callable, optional
        Makes objects movable by hand: called with the name of one, and viser's event.
    """
    nodes = dict(handles or {})
    for gone in nodes.keys() - drawing.nodes.keys():
        nodes.pop(gone).remove()
    for path, node in drawing.nodes.items():
        if path not in nodes:
            nodes[path] = _add_node(scene, path, node, drawing.size, on_drag)
    for path, lines in drawing.lines.items():
        kind = path.split("/")[1]
        scene.add_line_segments(
            path, points=lines, colors=COLORS[kind], thickness=THICKNESSES[kind],
            thickness_units="screen",
        )  # fmt: skip
    for path, some in drawing.ellipsoids.items():
        scene.add_batched_meshes_simple(
            path, *unit_ball(), batched_positions=some.centres,
            batched_wxyzs=some.orientations, batched_scales=some.half_axes,
            batched_colors=COLORS["covariance"], opacity=0.35, lod="off", cast_shadow=False,
            receive_shadow=False,
        )  # fmt: skip
    for path, poses in drawing.axes.items():
        scene.add_batched_axes(
            path, batched_wxyzs=poses[:, 3:], batched_positions=poses[:, :3],
            axes_length=0.025 * drawing.size, axes_radius=0.0012 * drawing.size,
        )  # fmt: skip
    for path, node in drawing.nodes.items():
        place(nodes[path], node.poses[0])
    return nodes


def move(handles: Mapping[str, Any], nodes: Mapping[str, Node], picture: int) -> None:
    """Put the nodes that move where they are in a picture.

    Parameters
    ----------
    handles : mapping of str to viser.SceneNodeHandle
        As :func:`draw` gives them.
    nodes, picture : mapping of str to Node, int
        Of the drawing, and which of its pictures.
    """
    for path, node in nodes.items():
        if len(node.poses) > 1:
            place(handles[path], node.poses[picture])


def place(handle: Any, pose: Array) -> None:
    """Put a node (its ``handle``) at a ``pose`` (7,)."""
    handle.position, handle.wxyz = pose[:3], pose[3:]


def _add_node(scene: Any, path: str, node: Node, size: float, on_drag: OnDrag | None) -> Any:
    axes = {"axes_length": node.axes, "axes_radius": 0.03 * node.axes, "origin_radius": 0.0}
    if on_drag is not None and path.startswith("/frames/"):
        handle = scene.add_transform_controls(path, scale=0.12 * size, disable_sliders=True)
        scene.add_frame(f"{path}/axes", **axes)
        handle.on_update(partial(on_drag, node.label))
    else:
        handle = scene.add_frame(path, node.axes > 0, **axes)
    if node.label:
        scene.add_label(f"{path}/label", node.label)
    for name, shape in node.solids.items():
        _add_solid(scene, f"{path}/{name}", shape)
    return handle


def _add_solid(scene: Any, path: str, shape: Shape) -> None:
    pose = shape.placement
    placed: dict[str, Any] = {
        "position": pose[:3],
        "wxyz": pose[3:],
        "color": shape.color,
        "opacity": None if shape.opacity >= 1 else shape.opacity,
    }
    if shape.kind == "box":
        scene.add_box(path, dimensions=shape.size, **placed)
    elif shape.kind == "mesh":
        scene.add_mesh_simple(path, *mesh(shape), **placed)
    else:
        add = scene.add_icosphere if shape.kind == "sphere" else scene.add_cylinder
        add(path, *shape.size, **placed)


def _set_view(server: Any, drawing: Drawing) -> None:
    """Set camera, lights and floor."""
    size, camera = drawing.size, server.initial_camera
    camera.look_at = drawing.middle
    camera.position = camera.look_at + drawing.distance * np.array([0.8, 0.5, 0.35])
    camera.fov = 0.75
    server.scene.configure_default_lights(cast_shadow=False)
    cell = 10.0 ** np.floor(np.log10(size / 2))
    server.scene.add_grid(
        "/ground", *(2 * np.ceil(size / cell) * cell,) * 2, cell_size=cell,
        section_size=10 * cell, cell_color=(225, 225, 225), section_color=(190, 190, 190),
        position=(*np.round(drawing.middle[:2] / cell) * cell, drawing.ground - 0.02 * size),
    )  # fmt: skip


class LiveView:
    """Serve motions to a browser; a context manager.

    The page has a time line, a choice of situations, and a handle on every object: where that
    is let go, the object stands from then on, and the skill is reproduced again. With
    "controller", a :class:`Controller` leads the robot instead: objects can be moved meanwhile,
    and the robot be held.

    Parameters
    ----------
    model, situations : TaskParameterizedGMM, sequence of Situation
        Fitted, with a robot or with tracked poses; and where to reproduce.
    demonstrations : sequence of Demonstration, default=()
        Whose paths and frames are drawn.
    first : int, default=0
        Which of the situations is shown first.
    host : str, default="127.0.0.1"
        Address to listen on: this machine only, or "0.0.0.0" for all that can reach it.
    port : int, default=8080
        The next free one from here on; 0 for any that is free.
    **how
        ``objects``, ``meshes``, ``fps`` and ``obstacles``, as for :class:`MotionScene`.

    Attributes
    ----------
    url : str
        Address of the page.
    drawing : Drawing
        The motion that is shown.
    situation : Situation
        With the objects where they are now.
    command : Command or None
        The controller's last, if one leads.
    statuses : list of str
        Each status of that controller, and from which instant of the skill on.
    clock : float
        The instant that is shown, from the start of the motion [s].

    Raises
    ------
    DependencyError, DataError
        If viser is not installed, or the model has no links that can be drawn.
    """

    def __init__(
        self,
        model: TaskParameterizedGMM,
        situations: Sequence[Situation],
        demonstrations: Sequence[Demonstration] = (),
        *,
        first: int = 0,
        host: str = "127.0.0.1",
        port: int = 8080,
        **how: Any,
    ) -> None:
        self._model, self._situations = model, list(situations)
        self._scene = MotionScene(model, demonstrations, **how)
        self._handles: dict[str, Any] = {}
        self._dragged = ""
        self._controller: Controller | None = None
        self.command: Command | None = None
        self.statuses: list[str] = []
        self.clock, self._posture = 0.0, self._situations[first].joints
        self._lock = threading.RLock()
        with ExitStack() as stack:
            self.server = stack.enter_context(viser_server(host, port))
            self.url = f"http://{host}:{self.server.get_port()}"
            self._add_controls(self.server.gui, first)
            self.show(first)
            _set_view(self.server, self.drawing)
            self.server.on_client_connect(self._step_back)
            self._resources = stack.pop_all()

    def __enter__(self) -> Self:
        """Return the view, which runs since it was made."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self._resources.close()

    def show(self, index: int) -> None:
        """Show the situation of that ``index``."""
        with self._lock:
            self._reproduce(self._situations[index])
            if self._controller is not None:
                self.start_controller()

    def move_frame(self, name: str, frame: Frame) -> None:
        """Put an object, by its ``name``, at another ``frame``, and reproduce again."""
        frames = {**self.situation.frames, name: frame}
        self._reproduce(replace(self.situation, frames=frames))

    def run(self, seconds: float = math.inf) -> None:
        """Play the motion in a loop, for a number of ``seconds``."""
        last = time.monotonic()
        end = last + seconds
        while last < end:
            time.sleep(1 / self._scene.fps)
            now = time.monotonic()
            if self._play.value:
                self.step(now - last)
            last = now

    def step(self, seconds: float) -> None:
        """Advance by a number of ``seconds``, along the time line or with the controller."""
        with self._lock:
            if self._controller is None:
                self._move_to(self.clock + seconds)
                return
            last = self.command
            self.command = self._controller.step(seconds, self._posture, self._frames_now())
            if not self.hold.value:
                self._posture = self.command.reference
            self.clock = float(self.command.time - self.drawing.trajectory.time[0])
            if last is None or self.command.status != last.status:
                self.statuses.append(f"{self.clock:.1f} s: {self.command.status}")
            self._status.content = "  \n".join((*self.statuses[-5:], self.command.reason()))
            self._move_to(self.clock)
            for path, poses in self._scene.robot_poses(self._posture).items():
                place(self._handles[path], poses[0])

    def start_controller(self) -> None:
        """Let a controller lead the robot, from the skill's start."""
        with self._lock:
            self.clock, self._posture = 0.0, self.situation.joints
            self._controller = Controller(
                self._model.skill,
                self._posture,
                self._frames_now(),
                obstacles=self._scene.obstacles,
            )
            self.command, self.statuses, self._run.value = None, [], True

    def stop_controller(self) -> None:
        """Go back to the reproduction and its time line."""
        with self._lock:
            self._controller = self.command = None
            self._run.value, self._status.content = False, ""
            self._move_to(self.clock)

    def _frames_now(self) -> dict[str, Frame]:
        """Return poses of the model's objects at the instant that is shown."""
        instants = self.drawing.trajectory.time
        at = min(int((instants - instants[0] < self.clock).sum()), len(instants) - 1)
        frames = self.situation.frames_at(instants)
        return {
            name: frames[name][at] if frames[name].batch_shape else frames[name]
            for name in self._model.frame_names_
            if name in frames
        }

    def _reproduce(self, situation: Situation) -> None:
        with self._lock:
            self.situation, self.drawing = situation, self._scene.draw(situation)
            self._handles = draw(self.server.scene, self.drawing, self._handles, self._drag)
            trajectory = self.drawing.trajectory
            marks = motion_marks(self._model, trajectory)
            self._marks.content = "  \n".join(f"{m.time:.1f} s: {m.label}" for m in marks)
            self._slider.max = max(float(self.drawing.time[-1]), 0.01)
            self._move_to(self.clock)

    def _move_to(self, clock: float) -> None:
        """Show an instant, in seconds since the start; after the end that is the start."""
        with self._lock:
            self.clock = clock if clock <= self.drawing.time[-1] else 0.0
            nodes = {p: n for p, n in self.drawing.nodes.items() if p != self._dragged}
            move(self._handles, nodes, self.drawing.picture(self.clock))
            self._slider.value = round(self.clock, 2)

    def _add_controls(self, gui: Any, first: int) -> None:
        self._play = gui.add_checkbox("play", True)
        self._slider = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0)
        self._marks = gui.add_markdown("")
        self._run = gui.add_checkbox("controller", False)
        self.hold = gui.add_checkbox("hold the robot", False)
        self._status = gui.add_markdown("")
        if len(self._situations) > 1:
            numbers = [str(index) for index in range(len(self._situations))]
            chosen = gui.add_dropdown("situation", numbers, initial_value=numbers[first])
            chosen.on_update(lambda event: self.show(int(event.target.value)))
        self._slider.on_update(self._seek)
        self._run.on_update(self._switch_controller)

    def _step_back(self, client: Any) -> None:
        """See both arms on a page that is higher than wide, as on a phone."""
        camera, middle = client.camera, self.drawing.middle
        away = (self.server.initial_camera.position - middle) / min(1.0, camera.aspect) ** 0.5
        camera.position, camera.look_at = middle + away, middle

    def _drag(self, name: str, event: Any) -> None:
        self._dragged = "" if event.phase == "end" else event.target.name
        if not self._dragged:
            self.move_frame(name, Frame(event.target.position, event.target.wxyz))

    def _seek(self, event: Any) -> None:
        if event.client is not None:  # moved by hand, not by the clock
            self._play.value, self.clock = False, event.target.value
            self.stop_controller()

    def _switch_controller(self, event: Any) -> None:
        if event.client is not None:
            (self.start_controller if event.target.value else self.stop_controller)()

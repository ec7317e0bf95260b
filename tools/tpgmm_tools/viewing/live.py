"""A motion in the browser while the program runs: objects can be moved by hand."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from tpgmm_tools.viewing.curves import Panel, motion_marks, motion_panels
from tpgmm_tools.viewing.recording import viser_server
from tpgmm_tools.viewing.scene import MotionScene
from tpgmm_tools.viewing.visuals import Shape
from tpgmm_torch.control.command import Command
from tpgmm_torch.control.controller import Controller
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.estimator import TaskParameterizedGMM

__all__ = ["LiveView"]

#: Of each panel of curves [pixels].
PLOT_HEIGHT = 160
SPEEDS = ("0.25", "0.5", "1", "2", "4")


class LiveView:
    """Serve motions to a browser; a context manager.

    The page has a time line, a choice of situations, and a handle on every object that stands
    still: where it is let go, the skill is reproduced again. Beside it are the stiffness that
    is asked for and each operator's share over time. With "controller", a :class:`Controller`
    leads the robot instead: objects can be moved meanwhile, and the robot be held.

    Parameters
    ----------
    model, situations : TaskParameterizedGMM, sequence of Situation
        What to reproduce, and for what; fitted, with a robot or with tracked poses.
    demonstrations, objects, meshes : sequence of Demonstration, mapping, Path
        As for :class:`MotionScene`.
    first : int, default=0
        Which of the situations is shown first.
    fps : float, default=25.0
        Pictures per second.
    host : str, default="127.0.0.1"
        Address to listen on: this machine only, or "0.0.0.0" for all that can reach it.
    port : int, default=8080
        The next free one from here on; 0 for any that is free.

    Attributes
    ----------
    url : str
        What to open.
    trajectory : Trajectory
        What is shown.
    scene : MotionScene
    situation : Situation
        What is shown, and where the objects are in it by now.
    command : Command or None
        What the controller sent last, if one leads.
    plots : list of viser.GuiUplotHandle
        Stiffness and shares, :func:`~tpgmm_tools.viewing.curves.motion_panels`.
    marks : viser.GuiMarkdownHandle
        Below the time line: :func:`~tpgmm_tools.viewing.curves.motion_marks`.
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
        objects: Mapping[str, Shape] | None = None,
        meshes: Path | None = None,
        first: int = 0,
        fps: float = 25.0,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        self._model, self._situations, self._fps = model, list(situations), fps
        self.clock = 0.0
        self.plots: list[Any] = []
        self.command: Command | None = None
        self._controller: Controller | None = None
        self._posture = self._situations[first].joints
        self._lock = threading.RLock()
        with ExitStack() as stack:
            server = stack.enter_context(viser_server(host, port))
            self.scene = MotionScene(
                server, model, demonstrations, meshes, fps, self.move_frame, objects=objects
            )
            self.url = f"http://{host}:{server.get_port()}"
            self._add_controls(server.gui, first)
            self.show(first)
            self._resources = stack.pop_all()

    def __enter__(self) -> Self:
        """Nothing: it runs since it was made."""
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
        """Put an object elsewhere in the situation that is shown, and reproduce again."""
        with self._lock:
            frames = {**self.situation.frames, name: frame}
            self._reproduce(replace(self.situation, frames=frames))

    def run(self, seconds: float = math.inf) -> None:
        """Play the motion again and again, for so many ``seconds``."""
        last = time.monotonic()
        end = last + seconds
        while last < end:
            time.sleep(1 / self._fps)
            now = time.monotonic()
            if self._play.value:
                self.step((now - last) * float(self._speed.value))
            last = now

    def step(self, seconds: float) -> None:
        """Go on by so many ``seconds``, along the time line or with the controller."""
        with self._lock:
            if self._controller is None:
                self._move_to(self.clock + seconds)
                return
            self.command = self._controller.step(seconds, self._posture, self._frames_now())
            if not self._hold.value:
                self._posture = self.command.reference
            reason = self.command.reason()
            self._status.value = self.command.status + (f": {reason}" if reason else "")
            self.clock = float(self.command.time - self.trajectory.time[0])
            self.scene.move_robot(self._posture, self._picture())
            self._slider.value = round(self.clock, 2)

    def start_controller(self) -> None:
        """Let a controller lead the robot, from the skill's start."""
        with self._lock:
            self.clock, self._posture = 0.0, self.situation.joints
            self._controller = self._model.controller(self._posture, self._frames_now())
            self._run.value = True

    def stop_controller(self) -> None:
        """Go back to the reproduction and its time line."""
        with self._lock:
            self._controller = self.command = None
            self._run.value, self._status.value = False, ""
            self._move_to(self.clock)

    def _frames_now(self) -> dict[str, Frame]:
        """Poses of the model's objects at the instant that is shown."""
        time = self.trajectory.time
        at = min(int((time - time[0] < self.clock).sum()), len(time) - 1)
        frames = self.situation.frames_at(time)
        return {
            name: frames[name][at] if frames[name].batch_shape else frames[name]
            for name in self._model.frame_names_
            if name in frames
        }

    def _reproduce(self, situation: Situation) -> None:
        with self._lock:
            self.situation = situation
            self.trajectory = self.scene.show(situation)
            self._plot(motion_panels(self._model, self.trajectory))
            marks = motion_marks(self._model, self.trajectory)
            self.marks.content = "  \n".join(f"{m.time:.1f} s: {m.label}" for m in marks)
            self._slider.max = max(float(np.ptp(self.scene.time)), 0.01)
            if self._controller is None:
                self._move_to(self.clock)

    def _move_to(self, clock: float) -> None:
        """Show an instant, in seconds since the start; after the end that is the start."""
        with self._lock:
            self.clock = clock if clock <= np.ptp(self.scene.time) else 0.0
            self.scene.move_to(self._picture())
            self._slider.value = round(self.clock, 2)

    def _picture(self) -> int:
        """Which picture of the scene is of the instant that is shown."""
        instants = self.scene.time - self.scene.time[0]
        return min(int(np.searchsorted(instants, self.clock)), len(instants) - 1)

    def _plot(self, panels: Sequence[Panel]) -> None:
        """Draw the curves, in place of those before."""
        drawn = [_plot_options(panel) for panel in panels]
        if not self.plots:
            gui = self.scene.server.gui
            self.plots = [gui.add_uplot(height=PLOT_HEIGHT, **options) for options in drawn]
        for plot, options in zip(self.plots, drawn, strict=True):
            plot.scales, plot.data = options["scales"], options["data"]

    def _add_controls(self, gui: Any, first: int) -> None:
        self._play = gui.add_checkbox("play", True)
        self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self._slider = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0)
        self.marks = gui.add_markdown("")

        self._run = gui.add_checkbox("controller", False)
        self._hold = gui.add_checkbox("hold the robot", False)
        self._status = gui.add_text("status", "", disabled=True)

        self._slider.on_update(self._slid)
        self._run.on_update(self._switched)
        if len(self._situations) > 1:
            numbers = [str(index) for index in range(len(self._situations))]
            chosen = gui.add_dropdown("situation", numbers, initial_value=numbers[first])
            chosen.on_update(lambda event: self.show(int(event.target.value)))

    def _slid(self, event: Any) -> None:
        if event.client is not None:  # moved by hand, not by the clock
            self._play.value = False
            self.clock = event.target.value
            self.stop_controller()

    def _switched(self, event: Any) -> None:
        if event.client is not None:
            (self.start_controller if event.target.value else self.stop_controller)()


def _plot_options(panel: Panel) -> dict[str, Any]:
    """A panel as viser's plots have it."""
    lines = [{"label": c.label, "stroke": c.color, "width": 1.5} for c in panel.curves]
    return {
        "title": panel.title,
        "data": (panel.time, *(curve.values for curve in panel.curves)),
        "series": ({"label": "time [s]"}, *lines),
        "padding": (12, 24, 0, 0),
        "scales": {"x": {"time": False}, "y": {"range": (0.0, panel.top)}},
    }

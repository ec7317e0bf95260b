"""A motion as one HTML file."""

from __future__ import annotations

import html
import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from tpgmm_tools.viewing.curves import as_html, motion_marks, motion_panels
from tpgmm_tools.viewing.scene import COLORS, STANDARD_DEVIATIONS, MotionScene
from tpgmm_tools.viewing.visuals import Shape
from tpgmm_torch.atomic import replacing
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DependencyError

__all__ = ["viser_server", "write_motion"]

#: How long the last picture stands before the motion starts again [s].
PAUSE = 1.0
#: Distance of situations that are shown side by side, in a scene of size 1.
APART = 0.9
#: The page is light in any browser. On a narrow one the curves go above the legend.
STYLE = """
#legend{position:fixed;left:1em;right:1em;bottom:4em;z-index:10;pointer-events:none;
display:flex;flex-wrap:wrap-reverse;justify-content:space-between;align-items:end;gap:.5em;
font:14px sans-serif;color:#333}
#legend>*{background:rgba(255,255,255,.9);padding:.5em;box-sizing:border-box;max-width:100%}
#curves{width:24em;font-size:12px;overflow-wrap:anywhere}
#curves summary{pointer-events:auto;cursor:pointer}
#curves .row{display:flex;justify-content:space-between;gap:1em}
#curves .row :last-child{white-space:nowrap}
#curves svg{display:block;width:100%;height:3.5em;overflow:visible;
border-bottom:1px solid currentColor}
#curves polyline,#curves line{fill:none;stroke-width:1.5;vector-effect:non-scaling-stroke}
#curves line{stroke:currentColor;stroke-width:1}
#curves .mark{stroke-dasharray:3 3;opacity:.6}
"""


def write_motion(
    path: str | Path,
    model: TaskParameterizedGMM,
    situation: Situation | Sequence[Situation],
    demonstrations: Sequence[Demonstration] = (),
    *,
    objects: Mapping[str, Shape] | None = None,
    meshes: Path | None = None,
    fps: float = 25.0,
    title: str = "tpgmm",
) -> Trajectory:
    """Write a reproduction as an HTML file with a time line, which needs nothing else.

    Beside the scene are the stiffness that is asked for and each operator's share over time,
    and in them where parts begin and when what the demonstrations name happens.

    Parameters
    ----------
    path : str or Path
        The file; replaced if it exists.
    model : TaskParameterizedGMM
        Fitted, with a robot or with tracked poses.
    situation : Situation or sequence of Situation
        For what to reproduce the skill; several are shown side by side, and the curves are of
        the first.
    demonstrations, objects, meshes, fps : sequence of Demonstration, mapping, Path, float
        As for :class:`MotionScene`.
    title : str, default="tpgmm"
        Of the page.

    Returns
    -------
    Trajectory
        What the file shows, of the first situation.

    Raises
    ------
    DependencyError, DataError
        If viser is not installed, or the model has no links that can be drawn.
    """
    with viser_server("127.0.0.1", 0) as server:
        situations = [situation] if isinstance(situation, Situation) else list(situation)
        first = MotionScene(server, model, demonstrations, meshes, fps, objects=objects)
        trajectory, scenes = first.show(situations[0]), [first]
        for number, other in enumerate(situations[1:], start=1):
            aside = (0.0, number * APART * first.size, 0.0)
            scene = MotionScene(
                server, model, demonstrations, meshes, fps, objects=objects,
                root=f"/{number}", origin=aside,
            )  # fmt: skip
            scene.show(other)
            scenes.append(scene)
        for number, scene in enumerate(scenes if len(scenes) > 1 else ()):
            server.scene.add_label(f"{scene.root}/number", f"{number + 1} of {len(scenes)}")
        _look_at_all(server.initial_camera, len(scenes), APART * first.size)
        recording = server.get_scene_serializer()
        clock = max((scene.time - scene.time[0] for scene in scenes), key=lambda t: t[-1])
        for now, pause in zip(clock, [*np.diff(clock), PAUSE], strict=True):
            for scene in scenes:
                picture = np.searchsorted(scene.time - scene.time[0], now - 1e-9)
                scene.move_to(min(int(picture), len(scene.time) - 1))
            recording.insert_sleep(float(pause))
        page = recording.as_html()
    curves = as_html(motion_panels(model, trajectory), motion_marks(model, trajectory))
    legend = _legend(title, bool(demonstrations), curves)
    with replacing(path) as new:
        new.write_text(_entitled(page, title, legend), encoding="utf-8")
    return trajectory


def _look_at_all(camera: Any, n_scenes: int, distance: float) -> None:
    """Move a camera that sees one of scenes that stand beside one another along y."""
    away = np.asarray(camera.position) - np.asarray(camera.look_at)
    aside = np.array([0.0, (n_scenes - 1) * distance / 2, 0.0])
    camera.look_at = np.asarray(camera.look_at) + aside
    camera.position = np.asarray(camera.look_at) + away * (1 + 0.5 * (n_scenes - 1))


@contextmanager
def viser_server(host: str, port: int) -> Iterator[Any]:
    """A viser server on ``host`` and ``port`` (0 for any that is free) that stops in the end.

    Raises
    ------
    DependencyError
        If viser is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise DependencyError(
            "looking at motions needs viser: pip install 'tpgmm-torch[view]'"
        ) from error
    with _quiet():
        server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        yield server
    finally:
        with _quiet():
            server.stop()


def _quiet() -> Any:
    """Viser prints when it starts and stops, whatever it is told."""
    return redirect_stdout(io.StringIO())


def _entitled(page: str, title: str, beside: str) -> str:
    """The page with a title, and what stands beside the scene."""
    before, body, after = page.rpartition("</body>")
    page = before + beside + body + after
    return page.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>", 1)


def _legend(title: str, with_demonstrations: bool, curves: str) -> str:
    """What the colours mean, and the curves, along the lower edge."""
    entries = {
        "reproduction": "reproduction",
        "covariance": f"where the link may be: {STANDARD_DEVIATIONS:g} standard deviations",
    }
    if with_demonstrations:
        entries["demonstrations"] = "demonstrations"
    lines = "".join(
        f'<div><span style="color:rgb{COLORS[kind]}">&#9632;</span> {text}</div>'
        for kind, text in entries.items()
    )
    return (
        f'<style>{STYLE}</style><div id="legend">'
        f"<div><b>{html.escape(title)}</b>{lines}</div>{curves}</div>"
    )

"""Pictures of a MuJoCo model on machines without a display."""

from __future__ import annotations

import atexit
import functools
import importlib
import os
import subprocess
import sys
import warnings
import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.exceptions import DependencyError

try:
    import mujoco
except ModuleNotFoundError as error:
    raise DependencyError(
        "the simulated robots need MuJoCo: pip install lerobot_env_bimanual"
    ) from error


#: What is shown where nothing can be drawn.
BLANK = (16, 16, 3)
#: Tried in this order, unless the environment variable MUJOCO_GL names one of them.
PLATFORMS = ("egl", "osmesa")


@functools.cache
def offscreen() -> str | None:
    """Find a way to draw without a display.

    Returns
    -------
    str or None
        ``"egl"``, ``"osmesa"`` or what the environment variable MUJOCO_GL names; None, with a
        warning, if that is missing, or without one if MUJOCO_GL is ``disable``.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in ("disable", "disabled", "off", "false", "0"):
        return None
    candidates = (wanted,) if wanted not in ("", "on", "enable", "true", "1") else PLATFORMS
    for platform in candidates:
        # in another process: PyOpenGL knows one platform per process, and drivers may crash
        attempt = f"from mujoco.{platform} import GLContext; GLContext(8, 8).make_current()"
        command = [sys.executable, "-c", attempt]
        if subprocess.run(command, capture_output=True, check=False).returncode == 0:
            return platform
    warnings.warn(
        f"cannot draw, frames are blank: {' and '.join(candidates)} did not work; install the "
        "system's EGL or OSMesa (Debian: libegl1 and libgl1-mesa-dri, or libosmesa6)",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


class Renderer:
    """Draws a model as one of its cameras sees it, or nothing where that is impossible."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, camera: str) -> None:
        self._model = model
        self._context: Any = None
        platform = offscreen()
        if platform is None:
            return
        self._context = importlib.import_module(f"mujoco.{platform}").GLContext(width, height)
        self._context.make_current()
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawing)
        # before what the line that made the context has registered takes the library down
        atexit.register(_close, weakref.ref(self))
        self._scene = mujoco.MjvScene(model, maxgeom=2 * model.ngeom)
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = model.camera(camera).id
        self._view = mujoco.MjrRect(0, 0, width, height)

    def __call__(self, data: mujoco.MjData, camera: str | None = None) -> NDArray[np.uint8]:
        """Draw a picture (height, width, 3), black and small where nothing can be drawn.

        Parameters
        ----------
        data : mujoco.MjData
        camera : str, optional
            Another camera of the model, from now on.
        """
        if self._context is None:
            return np.zeros(BLANK, np.uint8)
        if camera is not None:
            self._camera.fixedcamid = self._model.camera(camera).id
        self._context.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, everything, self._scene
        )
        mujoco.mjr_render(self._view, self._scene, self._drawing)
        picture = np.empty((self._view.height, self._view.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, self._view, self._drawing)
        return np.ascontiguousarray(picture[::-1])  # OpenGL counts rows from below

    def close(self) -> None:
        """Free what the graphics library holds."""
        if self._context is not None:
            self._context.make_current()
            self._drawing.free()
            self._context.free()
            self._context = None

    def __del__(self) -> None:
        self.close()


def _close(renderer: weakref.ref[Renderer]) -> None:
    if (alive := renderer()) is not None:
        alive.close()

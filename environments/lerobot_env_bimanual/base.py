"""Base of the environments: joints and objects are observed, and can be drawn."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_env_bimanual.rendering import Renderer
from tpgmm_torch.exceptions import DataError, ShapeError

Array = NDArray[np.float64]
#: Arrays of numbers; ``pixels`` are pictures by the names of cameras.
Observation = dict[str, Any]


class StateEnv(gym.Env[Observation, NDArray[np.float32]]):
    """An environment whose observations are ``agent_pos`` and ``environment_state``.

    Parameters
    ----------
    fps : int
        Actions per second.
    episode_length : int
        In actions.
    camera : str
        Of the simulated model, from which pictures are taken.
    render_mode : {"rgb_array"}, optional
    render_width, render_height : int, default=320, 240
        Of the pictures.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        fps: int,
        episode_length: int,
        camera: str,
        render_mode: str | None = None,
        render_width: int = 320,
        render_height: int = 240,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise DataError(f"render_mode is None or 'rgb_array', got {render_mode!r}")
        self.fps, self.episode_length, self.render_mode = fps, episode_length, render_mode
        self.metadata = {**type(self).metadata, "render_fps": fps}
        self._max_episode_steps = episode_length  # the name that LeRobot looks for
        self._camera, self._picture_size = camera, (render_width, render_height)
        self._renderer: Renderer | None = None
        self._picture: NDArray[np.uint8] | None = None
        self._pictured = 0  # the step of it
        self._steps = 0

    def _simulation(self) -> tuple[Any, Any]:
        """MuJoCo's model and data."""
        raise NotImplementedError

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Draw a picture, at most 25 new ones per simulated second.

        Returns
        -------
        ndarray of shape (height, width, 3)
            None without a render mode; small and black where nothing can be drawn.
        """
        if self.render_mode is None:
            return None
        model, data = self._simulation()
        if self._renderer is None:
            self._renderer = Renderer(model, *self._picture_size, self._camera)
        old = self._steps - self._pictured >= max(1, round(self.fps / 25))
        if self._picture is None or old:
            self._picture, self._pictured = self._renderer(data), self._steps
        return self._picture

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def finite_vector(name: str, values: ArrayLike, length: int) -> Array:
    """Copy ``length`` values, which have to be finite."""
    vector = np.array(values, dtype=np.float64)
    if vector.shape != (length,):
        raise ShapeError(f"{name} needs {length} values, shape ({length},), got {vector.shape}")
    if not np.isfinite(vector).all():
        raise DataError(f"{name} is not finite, it holds NaN or infinity: {vector.tolist()}")
    return vector

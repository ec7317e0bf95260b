"""Pictures of a ChArUco board as a camera with a distorting lens takes them."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tpgmm_vision.camera import Camera
from tpgmm_vision.poses import Array, rigid
from tpgmm_vision.targets import Board

#: Dots of the print in a metre, and samples of a pixel to a side.
DENSITY, SAMPLES = 6000, 2


class BoardCamera:
    """Takes pictures of a board, blurred and noisy."""

    def __init__(self, camera: Camera, board: Board, stretch: float = 1.0) -> None:
        self.camera, self.stretch = camera, stretch
        self.size = np.array([board.columns, board.rows]) * board.square
        self.print = board.drawn.generateImage(tuple((self.size * DENSITY).astype(int)))
        steps = [(np.arange(n * SAMPLES) + 0.5) / SAMPLES - 0.5
                 for n in (camera.width, camera.height)]  # fmt: skip
        grid = np.stack(np.meshgrid(*steps), -1)
        self.rays = camera.rays(grid.reshape(-1, 2)).reshape(grid.shape)

    def picture(self, pose: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The board at a pose in the camera's frame, x to the right and y down on it."""
        turn, place = pose[:3, :3], pose[:3, 3]
        normal = turn[:, 2]
        depth = normal @ place / (self.rays @ normal[:2] + normal[2])
        points = np.concatenate((self.rays, np.ones_like(self.rays[..., :1])), -1)
        local = (points * depth[..., None] - place) @ turn[:, :2]
        where = (local * DENSITY * (self.stretch, 1.0) - 0.5).astype(np.float32)
        blur = max(0.5, DENSITY * place[2] / self.camera.focal_length[0] / 4)
        drawn = cv2.GaussianBlur(self.print, (0, 0), blur)
        found = cv2.remap(drawn, where, None, cv2.INTER_LINEAR, borderValue=190)
        found = cv2.resize(
            found, (self.camera.width, self.camera.height), interpolation=cv2.INTER_AREA
        )
        found = cv2.GaussianBlur(found.astype(np.float32), (0, 0), 0.6)
        return (found + 3 * rng.standard_normal(found.shape)).clip(0, 255).astype(np.uint8)

    def pose(
        self, rng: np.random.Generator, tilt: tuple[float, float] = (10, 45), away: float = 1.0
    ) -> Array:
        """Somewhere before the camera, tilted by so many degrees."""
        lean, side, roll = (
            *np.radians(rng.uniform(*tilt, 1)),
            rng.uniform(0, 7),
            rng.uniform(-1, 1),
        )
        turn = Rotation.from_rotvec([lean * np.cos(side), lean * np.sin(side), 0])
        turn = turn * Rotation.from_rotvec([0, 0, roll / 2])
        z = rng.uniform(0.3, 0.6)
        x, y = rng.uniform(-0.25, 0.25) * z * away, rng.uniform(-0.18, 0.18) * z * away
        return rigid(turn.as_matrix(), (x, y, z) - turn.apply([*self.size / 2, 0]))

    def pictures(
        self, n: int, rng: np.random.Generator, **where: object
    ) -> dict[str, NDArray[np.uint8]]:
        return {f"{k:02}.png": self.picture(self.pose(rng, **where), rng) for k in range(n)}


def ray_error(camera: Camera, true: Camera) -> float:
    """How far rays are off after the best rotation, mean over the picture [m at 1 m]."""
    across, down = np.linspace(20, true.width - 20, 12), np.linspace(20, true.height - 20, 9)
    grid = np.stack(np.meshgrid(across, down), -1).reshape(-1, 2)
    one, other = (
        np.concatenate((each.rays(grid), np.ones((len(grid), 1))), 1) for each in (camera, true)
    )
    one, other = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (one, other))
    turn, _ = Rotation.align_vectors(other, one)
    return float(np.linalg.norm(other - turn.apply(one), axis=1).mean())

"""Pictures of tags as a camera sees them: distorted, blurred, noisy."""

from collections.abc import Iterable

import cv2
import numpy as np

from tpgmm_vision.camera import Camera
from tpgmm_vision.poses import inverse, rigid, transform
from tpgmm_vision.targets import FAMILIES, Target, modules_of

CAMERA = Camera(640, 480, (554.0, 556.0), (322.0, 237.0), (0.08, -0.15, 0.0006, -0.0004, 0.0))
#: Pixels of a drawn tag on a side of a module; how much finer pictures are drawn at first.
TEXTURE, FINE = 8, 3


def look_at(eye, target) -> np.ndarray:
    """``base_from_camera`` of a camera that looks at a point, its x axis horizontal."""
    z = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    x = np.cross(z, (0, 0, 1)) / np.linalg.norm(np.cross(z, (0, 0, 1)))
    return rigid(np.stack((x, np.cross(z, x), z), axis=1), eye)


def drawn(
    camera: Camera,
    base_from_camera: np.ndarray,
    things: Iterable[tuple[Target, np.ndarray]],
    rng: np.random.Generator,
    *,
    noise: float = 3.0,
    blur: float = 0.6,
) -> np.ndarray:
    """An RGB picture of targets at poses in the base frame, before a grey background."""
    height, width = camera.height, camera.width
    grey = cv2.resize(
        rng.uniform(90, 160, (6, 8)).astype(np.float32), (width, height),
        interpolation=cv2.INTER_CUBIC,
    )  # fmt: skip
    faces = [
        (transform(inverse(base_from_camera) @ pose, corners), number, target.family)
        for target, pose in things
        for number, corners in target.corners.items()
    ]
    for points, number, family in sorted(faces, key=lambda face: -face[0][:, 2].mean()):
        normal = np.cross(points[1] - points[0], points[3] - points[0])
        if normal @ points.mean(0) > 0 and (points[:, 2] > 0.01).all():
            _draw(grey, camera, points, number, family)
    grey = cv2.GaussianBlur(grey, (0, 0), blur) + noise * rng.standard_normal(grey.shape)
    return np.clip(grey, 0, 255).astype(np.uint8)[..., None].repeat(3, axis=2)


def _draw(grey, camera, points, number, family) -> None:
    """Draw a tag with a white module around it, each part of a pixel for itself."""
    modules = modules_of(family)
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    marker = cv2.aruco.generateImageMarker(dictionary, number, modules * TEXTURE)
    texture = np.pad(marker, TEXTURE, constant_values=255)
    pixels = camera.project(points)
    reach = np.ptp(pixels, axis=0).max() / 3 + 3
    low = np.maximum(np.floor(pixels.min(0) - reach), 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(0) + reach), (camera.width, camera.height)).astype(int)
    if (high <= low).any():
        return
    shape = (high - low)[::-1] * FINE
    v, u = (np.indices(shape) + 0.5) / FINE - 0.5
    rays = camera.rays(np.stack((u.ravel() + low[0], v.ravel() + low[1]), axis=1))
    # where rays meet the plane of the tag, in shares of its edges
    edges = np.stack((points[1] - points[0], points[3] - points[0], points[0]), axis=1)
    across, down, scale = (
        np.column_stack((rays, np.ones(len(rays)))) @ np.linalg.inv(edges).T
    ).T
    x = (across / scale * modules + 1) * TEXTURE - 0.5
    y = (down / scale * modules + 1) * TEXTURE - 0.5
    seen = cv2.remap(
        texture.astype(np.float32), x.reshape(shape).astype(np.float32),
        y.reshape(shape).astype(np.float32), cv2.INTER_LINEAR, borderValue=-1000,
    )  # fmt: skip
    inside = (seen > -1).astype(np.float32)
    small = high - low
    share = cv2.resize(inside, small, interpolation=cv2.INTER_AREA)
    value = cv2.resize(inside * (40 + 0.7 * seen), small, interpolation=cv2.INTER_AREA)
    part = grey[low[1] : high[1], low[0] : high[0]]
    part[:] = part * (1 - share) + value

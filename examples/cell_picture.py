"""A picture of a simulated cell with what was found in it.

    python examples/cell_picture.py docs/images/cell.webp

It needs the plugin ``lerobot_env_bimanual``, the extra ``vision`` of tpgmm-torch,
and EGL or OSMesa to draw with.
"""

import sys

import cv2
import gymnasium as gym
import numpy as np

import lerobot_env_bimanual
from lerobot_env_bimanual.eyes.cells import cell_of
from tpgmm_vision.cell import cell_from
from tpgmm_vision.detection.tag_source import TagSource
from tpgmm_vision.poses import inverse, pose_matrix, transform

assert lerobot_env_bimanual  # registers the environments
#: How much the picture is enlarged before lines are drawn, and the size of it that is kept.
SCALE, SIZE = 2, (800, 600)
#: Length of the axes [m], and the colours of Okabe and Ito, which all readers tell apart.
AXIS = 0.08
GREEN, COLOURS = (0, 158, 115), ((213, 94, 0), (0, 158, 115), (0, 114, 178))


def drawn(
    environment: str = "lerobot_env_bimanual/CarryAndPut-v0", seed: int = 0
) -> np.ndarray:
    """The first picture of an episode with corners of tags and poses of objects (RGB)."""
    env = gym.make(environment, cameras="front", fps=25)
    picture = env.reset(seed=seed)[0]["pixels"]["front"]
    cell = cell_from(cell_of(env))
    env.close()
    source, front = TagSource(cell), cell.cameras["front"]
    found = source.poses({front.key: picture}, {}, 0.0)
    shown = cv2.resize(picture, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_CUBIC)
    for detections in source.detections["front"].values():
        for corners in detections.corners.values():
            cv2.polylines(shown, [_pixels(corners)], True, GREEN, 3, cv2.LINE_AA)
    for name, one in found.items():
        ends = transform(pose_matrix(one.pose), AXIS * np.eye(4, 3, k=-1))
        ends = _pixels(front.camera.project(transform(inverse(front.pose), ends)))
        for end, colour in zip(ends[1:], COLOURS, strict=True):
            cv2.line(shown, ends[0].tolist(), end.tolist(), colour, 4, cv2.LINE_AA)
        for colour, width in (((255,) * 3, 5), ((20,) * 3, 2)):
            place = (ends[0] + (14, 30)).tolist()
            font = cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(shown, name, place, font, 0.9, colour, width, cv2.LINE_AA)
    return cv2.resize(shown, SIZE, interpolation=cv2.INTER_AREA)


def _pixels(points: np.ndarray) -> np.ndarray:
    return np.rint((points + 0.5) * SCALE - 0.5).astype(int)


if __name__ == "__main__":
    [_, out] = sys.argv
    bgr = cv2.cvtColor(drawn(), cv2.COLOR_RGB2BGR)
    cv2.imwrite(out, bgr, [cv2.IMWRITE_WEBP_QUALITY, 82])

"""A source of poses that are written into the pictures themselves, and where it finds them."""

from importlib.metadata import EntryPoint

import numpy as np
import torch

from tpgmm_vision.sources import SOURCES, ObservedPose

KEY, WIDTH, HEIGHT = "observation.images.front", 32, 24
ENTRY = EntryPoint("planted", "tests.support.planted_poses:Planted", SOURCES)


class Planted:
    """Reads seven numbers from the first bytes of a picture."""

    def __init__(self, cell, robot):
        self.names, self.problem, self.calls, self.resets = list(cell.objects), "", [], 0

    def reset(self):
        self.resets += 1

    def poses(self, images, joints, time):
        self.calls.append((joints, time))
        values = np.frombuffer(images[KEY].tobytes()[: 7 * 8]).copy()
        seen = bool(np.isfinite(values).all())
        found = ObservedPose(values, 1e-6 * np.eye(6), seen, "" if seen else "a hand hides it")
        return dict.fromkeys(self.names, found)


def picture(values):
    """A picture (height, width, 3) of an object at a pose (7,), or of none (NaN)."""
    shown = np.zeros(HEIGHT * WIDTH * 3, np.uint8)
    shown[: 7 * 8] = np.frombuffer(np.asarray(values, np.float64).tobytes(), np.uint8)
    return shown.reshape(HEIGHT, WIDTH, 3)


def pictures(poses, kind=torch.float32):
    """As LeRobot gives them: (B, 3, height, width)."""
    stack = torch.from_numpy(np.stack([picture(one) for one in poses])).permute(0, 3, 1, 2)
    return stack if kind is torch.uint8 else stack.to(kind) / 255


def cell_content(**changed):
    """A cell with one camera, of a bottle."""
    camera = {
        "key": KEY, "size": [WIDTH, HEIGHT], "focal_length": [30, 30],
        "principal_point": [15.5, 11.5], "pose": [1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0],
    }  # fmt: skip
    bottle = {"target": {"tag": 3, "size": 0.06}}
    return {
        "cameras": {"front": camera}, "objects": {"bottle": bottle}, "source": "planted",
    } | changed  # fmt: skip

"""Skills with parts that are known: a tracked hand that goes from place to place, and rests."""

import numpy as np

from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.robots import Poses

HAND = Poses(["hand"], orientation=False)


def motion(time, way_points):
    """Minimum jerk through (begin, end, place), at rest in between."""
    path, here = np.zeros((len(time), 3)), np.zeros(3)
    for begin, end, place in way_points:
        u = np.clip((time - begin) / (end - begin), 0, 1)[:, None]
        path += (np.asarray(place, float) - here) * u**3 * (10 - 15 * u + 6 * u**2)
        here = np.asarray(place, float)
    return path


def errands(n=6, seed=0, shift=0.0):
    """To the cup, a rest sooner or later, and to the tray; both stand elsewhere each time."""
    rng, time, shown = np.random.default_rng(seed), np.linspace(0, 6, 121), []
    for number in range(n):
        cup, tray = rng.uniform(-0.3, 0.3, (2, 3)) + np.array([[0.4, 0.3, 0], [0.4, -0.3, 0]])
        moved = shift * (-1) ** number
        path = motion(time, [(0, 2.5 + moved, cup), (3.5 + moved, 6, tray)])
        path += 0.002 * rng.normal(size=path.shape)
        frames = {"cup": Frame(cup), "tray": Frame(tray)}
        events = {"taken": 3.0 + moved}
        shown.append(Demonstration(time, path, frames, HAND.joint_names, events))
    return shown

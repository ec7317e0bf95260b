"""Where cameras stand before a robot at a table, and the tags by which a knock is noticed."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from lerobot_env_bimanual.eyes.carriers import Carrier, cube_at
from lerobot_env_bimanual.eyes.rig import View, looking
from tpgmm_torch.exceptions import UnknownNameError

#: The middle of what happens on the table [m].
CENTRE = (0.28, 0.0, 0.15)
#: Tags that stand still beside the table, as they would at the base of the robot.
CHECK: Mapping[str, Carrier] = {"world": cube_at(0, 0.3, 0.43, 0.05, size=0.06)}


def around(centre: ArrayLike, distance: float, azimuth: float, elevation: float) -> View:
    """Place a camera that looks at a point.

    Parameters
    ----------
    centre : array-like of shape (3,)
        [m]
    distance : float
        [m]
    azimuth, elevation : float
        Where it is, seen from there: from the x axis to the left, and up [deg].
    """
    turn, rise = np.radians((azimuth, elevation))
    level = np.cos(rise)
    away = np.array((level * np.cos(turn), level * np.sin(turn), np.sin(rise)))
    return View(looking(np.asarray(centre) + distance * away, centre))


#: Two cameras opposite the robot, to its left and to its right. On 640 pixels, cubes of 40 mm
#: tags are found everywhere on the table from 0.9 m; from 1 m some that are turned badly not.
VIEWS: Mapping[str, View] = {
    "front": around(CENTRE, 0.9, 25.0, 35.0),
    "side": around(CENTRE, 0.9, -45.0, 40.0),
}


def chosen_views(cameras: str | Sequence[str]) -> dict[str, View]:
    """Choose the views of cameras by their names.

    Parameters
    ----------
    cameras : str or sequence of str
        A text has names with commas between them.

    Raises
    ------
    UnknownNameError
        If there is no such camera.
    """
    names = re.findall(r"[\w.-]+", cameras) if isinstance(cameras, str) else cameras
    for name in names:
        if name not in VIEWS:
            raise UnknownNameError("camera", name, "the environments", VIEWS)
    return {name: VIEWS[name] for name in names}

"""The cell of a policy: frames that are found in the pictures of its cameras."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature

from lerobot_policy_tpgmm.configuration_tpgmm import NO_CELL
from lerobot_policy_tpgmm.observations import FrameFeatures
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.persistence import decode, encode
from tpgmm_torch.robots import Kinematics, Robot
from tpgmm_vision.cell import Cell, cell_of
from tpgmm_vision.watching import Watch

__all__ = ["cell_of", "image_features", "take_over", "watch"]

log = logging.getLogger(__name__)


def take_over(given: Mapping[str, Any] | str, learned: Mapping[str, Any]) -> dict[str, Any]:
    """The cell of a policy that was learned with another one; what differs is a warning.

    Parameters
    ----------
    given : mapping or str
        The content of a file, its path, or "none" for the cell without its cameras.
    learned : mapping
        The content of the other one.
    """
    if given == NO_CELL:
        return {**learned, "source": NO_CELL}
    cell = cell_of(given)
    if told := cell_of(learned).differences(cell):
        log.warning(
            "the policy was learned with another cell: %s. What was wrong with that one is a "
            "part of what it learned: if it misses, track and learn its demonstrations again",
            "; ".join(told),
        )
    return dict(cell.content)


def image_features(cell: Cell) -> dict[str, PolicyFeature]:
    """The pictures that a cell needs."""
    return {
        one.key: PolicyFeature(FeatureType.VISUAL, (3, one.camera.height, one.camera.width))
        for one in cell.cameras.values()
        if cell.source != NO_CELL
    }


def watch(cell: Cell, robot: Kinematics, frames: FrameFeatures) -> Watch | None:
    """What finds the frames of a policy, if its cell has a source of poses."""
    if cell.source == NO_CELL:
        return None
    links = [one for one in cell.links if one not in robot.links]
    if links and isinstance(robot, Robot):
        robot = decode(encode(robot) | {"links": [*robot.links, *links]})
    read, known = frames.in_environment, frames.default is not None
    try:
        return Watch(cell, robot, [n for n in read if n in cell.objects or not known])
    except DataError as error:
        raise DataError(
            f"{error}. --policy.cell={NO_CELL} takes poses that are observed otherwise"
        ) from error

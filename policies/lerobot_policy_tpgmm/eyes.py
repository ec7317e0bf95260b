"""Frames that are found in the pictures of a cell's cameras."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from lerobot.configs import FeatureType, PolicyFeature

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.observations import FrameFeatures, JointFeatures
from tpgmm_torch.atomic import read_whole
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.persistence import decode, encode
from tpgmm_torch.robots import Kinematics, Robot
from tpgmm_vision.cell import cell_of
from tpgmm_vision.watching import Watch

__all__ = ["open_eyes", "recalibrate"]

log = logging.getLogger(__name__)


def open_eyes(config: TPGMMConfig, robot: Kinematics, frames: FrameFeatures) -> Watch:
    """What finds the frames of a policy that has a cell.

    The configuration gets the content of the cell, and the pictures that are needed.
    """
    cell = cell_of(config.cell or {})
    links = [one for one in cell.links if one not in robot.links]
    if links and isinstance(robot, Robot):
        robot = decode(encode(robot) | {"links": [*robot.links, *links]})
    read, known = frames.in_environment, frames.default is not None
    try:
        watch = Watch(cell, robot, [n for n in read if n in cell.objects or not known])
    except DataError as error:
        raise DataError(
            f"{error}. --policy.cell=none takes poses that are observed otherwise"
        ) from error
    config.cell = dict(cell.content)
    config.input_features = (config.input_features or {}) | {
        one.key: PolicyFeature(FeatureType.VISUAL, (3, one.camera.height, one.camera.width))
        for one in cell.cameras.values()
    }
    return watch


def recalibrate(config: TPGMMConfig, joints: JointFeatures, saved: Path) -> None:
    """Take over another cell than that of the ``saved`` configuration: say what differs.

    Joints are measured with the offsets of the new one.
    """
    learned = json.loads(read_whole(saved)).get("cell")
    before, now = (
        cell_of(one if isinstance(one, dict) else {}) for one in (learned, config.cell)
    )
    if before.content and (told := before.differences(now)):
        log.warning(
            "the policy was learned with another cell: %s. What was wrong with that one is a "
            "part of what it learned: if it misses, track and learn its demonstrations again",
            "; ".join(told),
        )
    if units := joints.shift(before.shifts(now)):
        given = {"*": config.units} if isinstance(config.units, str) else config.units
        config.units = {**(given or {}), **units}

"""The cell of a policy: frames that are found in the pictures of its cameras."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature

from lerobot_policy_tpgmm.configuration_tpgmm import NO_CELL, TPGMMConfig
from lerobot_policy_tpgmm.observations import FrameFeatures
from tpgmm_torch.persistence import decode, encode
from tpgmm_torch.robots import Kinematics, Robot

# tpgmm_vision, which needs OpenCV, is imported where there is a cell

log = logging.getLogger(__name__)


def open_cell(config: TPGMMConfig) -> Any:
    """Open the cell, if there is one; its content, and the pictures that it needs, are kept."""
    inputs, visual = config.input_features or {}, FeatureType.VISUAL
    config.input_features = {key: one for key, one in inputs.items() if one.type is not visual}
    if config.cell in (None, NO_CELL):
        return None
    from tpgmm_vision.cell import cell_of

    cell = cell_of(config.cell or {})
    config.cell = dict(cell.content)
    for one in cell.cameras.values() if cell.source != NO_CELL else ():
        shape = 3, one.camera.height, one.camera.width
        config.input_features[one.key] = PolicyFeature(visual, shape)
    return cell


def take_over(given: Any, learned: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cell of a policy that was learned with another one; warn of what differs.

    Parameters
    ----------
    given : mapping or str, optional
        The content of a file, its path, or "none" for the cell without its cameras.
    learned : mapping
        The content of the other one.
    """
    from tpgmm_vision.cell import cell_of

    if given in (None, NO_CELL):
        return {**learned, "source": NO_CELL}
    cell = cell_of(given)
    if differences := cell_of(learned).differences(cell):
        log.warning(
            "the policy was learned with another cell: %s. What was wrong with that one is a "
            "part of what it learned: if it misses, track and learn its demonstrations again",
            "; ".join(differences),
        )
    return dict(cell.content)


def make_watch(cell: Any, robot: Kinematics, frames: FrameFeatures) -> Any:
    """Return the source of a policy's frames, if it has a cell with a source of poses."""
    if cell is None or cell.source == NO_CELL:
        return None
    from tpgmm_vision.watching import Watch

    links = [one for one in cell.links if one not in robot.links]
    if links and isinstance(robot, Robot):
        robot = decode(encode(robot) | {"links": [*robot.links, *links]})
    read, known = frames.in_environment, frames.default is not None
    return Watch(cell, robot, [name for name in read if name in cell.objects or not known])

"""Names, units and rate that a policy takes from its data set."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.eyes import take_over
from lerobot_policy_tpgmm.observations import is_at_start
from tpgmm_datasets.lerobot.calibration import calibrated_units
from tpgmm_datasets.names import value_names
from tpgmm_datasets.signals import CELL
from tpgmm_torch.atomic import read_whole
from tpgmm_torch.data.pose_names import pose_groups
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.robots import Kinematics
from tpgmm_torch.robots.kinematics import JointSpace
from tpgmm_torch.structure.choices import operators_or_default

log = logging.getLogger(__name__)

NAMES = {OBS_STATE: "state_names", ACTION: "action_names", OBS_ENV_STATE: "environment_names"}


def adopt(config: TPGMMConfig, dataset: Any) -> tuple[Kinematics, list[Operator]]:
    """Complete the configuration of a policy that is to be trained, from its data set.

    What is given stays.

    Returns
    -------
    kinematics : Kinematics
        The robot, or the joints alone.
    operators : list of Operator
        Those that are given, or the candidates.
    """
    for key, field in NAMES.items():
        if getattr(config, field) is None:
            setattr(config, field, _names(dataset.features, key))
    _check_rate(config, dataset)
    config.fps = float(dataset.fps)
    if (file := Path(dataset.root) / CELL).exists():
        config.cell = take_over(config.cell or str(file), json.loads(read_whole(file)))
    _adopt_units(config, dataset)
    config.validate_features()
    config.input_features = {
        key: feature
        for key, feature in (config.input_features or {}).items()
        if key in (OBS_STATE, OBS_ENV_STATE)
    }
    kinematics = _make_kinematics(config, dataset)
    _check_links(config, kinematics)
    given = config.decoded_operators() or ()
    frames = _frames(config, kinematics, given)
    operators = operators_or_default(given, kinematics, frames)
    log.info("joints %s, links %s, frames %s", kinematics.joint_names, kinematics.links, frames)
    log.info("units %s, operators %s", config.units, list(map(format_operator, operators)))
    return kinematics, operators


def _adopt_units(config: TPGMMConfig, dataset: Any) -> None:
    """Take the units that the data set declares, or those of LeRobot's calibration file."""
    if config.units is None:
        config.units = read_declared(config, dataset.features, "units")
    elif isinstance(config.units, str) and config.units.endswith(".json"):
        scales = calibrated_units(config.units, tuple(config.state_names or ()))
        config.units = {name: [scale.factor, scale.offset] for name, scale in scales.items()}


def _make_kinematics(config: TPGMMConfig, dataset: Any) -> Kinematics:
    """Return the robot of the configuration, or the joints alone."""
    kinematics = config.kinematics()
    if kinematics is None:
        size = dataset.features[OBS_STATE]["shape"][0]
        return JointSpace(config.state_names or [f"joint_{i}" for i in range(size)])
    _check_names(config, kinematics)
    return kinematics


def _check_links(config: TPGMMConfig, kinematics: Kinematics) -> None:
    """Refuse frames at links that cannot be made, or are not observed later."""
    for name, pose in config.link_poses().items():
        if pose.link not in kinematics.links:
            raise UnknownNameError(
                "link", pose.link, f"the robot (frame {name!r})", kinematics.links
            )
        clear = is_at_start(pose) or config.environment_names or not config.frames
        if not clear and name not in (config.frames or ()):
            raise DataError(
                f"frame {name!r} is at {config.training.link_frames[name]!r} in the episodes; "
                "say where a running policy observes it, too: --policy.frames="
                f"""'{{"{name}": [0, 1, 2, 3, 4, 5, 6], ...}}'"""
            )


def check_dataset(config: TPGMMConfig, dataset: Any) -> None:
    """Refuse a data set of other signals than those of a fitted policy."""
    for key, field in NAMES.items():
        expected, names = getattr(config, field), _names(dataset.features, key)
        if expected and names and list(expected) != names:
            raise DataError(
                f"{key} of the data set has the entries {names}, the policy was made for "
                f"{list(expected)}. If they are the same joints in another order or spelling, "
                f"--policy.{field}='[...]' says so; else fit a policy to this data set"
            )
    _check_rate(config, dataset)


def _check_rate(config: TPGMMConfig, dataset: Any) -> None:
    if config.fps is not None and abs(dataset.fps - config.fps) > 1e-3 * config.fps:
        raise DataError(
            f"the data set has {dataset.fps:g} steps per second, the policy was made for "
            f"{config.fps:g}: resample it, tpgmm dataset convert SOURCE TARGET --rate "
            f"{config.fps:g}"
        )


def _names(features: Mapping[str, Any], key: str) -> list[str] | None:
    feature = features.get(key)
    if feature is None or len(feature["shape"]) != 1:
        return None
    names, wrong = value_names(feature.get("names"), feature["shape"][0], key)
    if wrong:
        raise DataError(
            f"the names of {key} in the data set cannot be used, {wrong}: mend them in "
            f"meta/info.json, or say them, --policy.{NAMES[key]}='[...]'"
        )
    return None if names is None else list(names)


def _check_names(config: TPGMMConfig, kinematics: Kinematics) -> None:
    """Refuse a robot of several joints whose values have no names."""
    unnamed = {key: f"--policy.{NAMES[key]}='[...]'" for key in (OBS_STATE, ACTION)}
    unnamed = {k: text for k, text in unnamed.items() if getattr(config, NAMES[k]) is None}
    if unnamed and kinematics.n_joints > 1:
        raise DataError(
            f"the data set does not name the values of {' and '.join(unnamed)}, and nothing "
            f"else tells which are the robot's joints, {list(kinematics.joint_names)}: say "
            f"their names in order, {' '.join(unnamed.values())}"
        )


def read_declared(
    config: TPGMMConfig, features: Mapping[str, Any], what: str
) -> dict[str, Any]:
    """Return units or offsets by name, where the data set (of our writer) declares them."""
    found: dict[str, Any] = {}
    for key in (OBS_STATE, ACTION):
        values = (features.get(key, {}).get("info") or {}).get(what)
        names = getattr(config, NAMES[key])
        if names and isinstance(values, list) and len(values) == len(names):
            found |= dict(zip(names, values, strict=True))
    return found


def _frames(config: TPGMMConfig, kinematics: Kinematics, given: Sequence[Any]) -> list[str]:
    """Return the names of the frames that there are."""
    if config.frames:
        return list(dict.fromkeys((*config.frames, *config.training.link_frames)))
    groups = pose_groups(config.environment_names) if config.environment_names else {}
    if not groups and config.env_state_feature is not None:
        if given or not kinematics.links:
            return [OBS_ENV_STATE]
        raise DataError(
            f"the names of {OBS_ENV_STATE} tell of no pose: name the frames, "
            """--policy.frames='{"bottle": [0, 1, 2, 3, 4, 5, 6]}'"""
        )
    return list(dict.fromkeys((*groups, *config.training.link_frames)))

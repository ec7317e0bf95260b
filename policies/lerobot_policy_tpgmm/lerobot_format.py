"""``tpgmm fit ... --format lerobot``: a model as a pretrained directory."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tpgmm_datasets.signals import Signals
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.atomic import contents, read_whole
from tpgmm_torch.exceptions import ModelFileError


def write_pretrained(model: Any, path: Path, signals: Signals) -> None:
    """Write the directory that LeRobot's commands take as ``--policy.path``.

    Parameters
    ----------
    model : TaskParameterizedGMM or Skill
        Fitted.
    signals : Signals
        Of the data set that the model was fitted to.

    Raises
    ------
    ModelFileError
        If something else is there.
    DataError
        If the data set's actions are not the model's joints.
    """
    if path.exists() and not _replaceable(path):
        raise ModelFileError(
            f"{path} exists and is not a tpgmm policy; choose another directory"
        )
    skill = model.skill if isinstance(model, TaskParameterizedGMM) else model
    policy = TPGMMPolicy.from_estimator(
        model,
        fps=signals.fps,
        state_names=signals.state_names,
        action_names=signals.action_names,
        environment_names=signals.environment_names,
        frames={n: p for n, p in signals.frames.items() if n in skill.frame_names},
        units={name: list(scale) for name, scale in signals.units.items()} or None,
        cell=signals.cell and str(signals.cell),
    )
    policy.save_pretrained(path)


def _replaceable(path: Path) -> bool:
    """Return True for a folder that is empty or holds a policy of this type."""
    if not path.is_dir():
        return False
    config = path / "config.json"
    try:
        is_policy = json.loads(read_whole(config)).get("type") == TPGMMPolicy.name
    except (OSError, ValueError, AttributeError, RecursionError):
        is_policy = False
    return is_policy or not contents(path)

"""The folder of a policy: LeRobot's configuration and processors, and a model's folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from huggingface_hub.constants import CONFIG_NAME, SAFETENSORS_SINGLE_FILE

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.processor_tpgmm import make_tpgmm_pre_post_processors
from tpgmm_torch.atomic import read_whole, replacing
from tpgmm_torch.exceptions import ModelFileError
from tpgmm_torch.persistence import FILES, load, save

__all__ = ["PATTERNS", "read_model", "write_files"]

#: Folder of the model, as :func:`tpgmm_torch.save` writes it.
MODEL = "model"
#: Files of a policy, as the hub selects them.
PATTERNS = ("*.json", *(f"{MODEL}/{name}" for name in FILES))


def write_files(config: TPGMMConfig, model: Any, directory: Path) -> None:
    """Write configuration, both processors and the model, all in one step.

    Other files in the directory stay.
    """
    with replacing(directory.resolve(), keep=True) as folder:
        save(model, folder / MODEL)
        config.save_pretrained(folder)
        for processor in make_tpgmm_pre_post_processors(config):
            processor.save_pretrained(folder)


def read_model(directory: Path) -> Any:
    """The model or skill of a policy.

    Raises
    ------
    ModelFileError
        If it is missing, damaged, or of release 0.1 or 0.2.
    """
    folder, config = directory / MODEL, directory / CONFIG_NAME
    if config.exists():
        try:
            json.loads(read_whole(config))
        except (OSError, ValueError, RecursionError) as error:
            raise ModelFileError(f"{config} cannot be read: {error!r}") from error
    if folder.is_dir():
        return load(folder)
    if config.exists() and (directory / SAFETENSORS_SINGLE_FILE).exists():
        raise ModelFileError(
            f"{directory} is a policy of release 0.1 or 0.2, which is not read any more: fit "
            "it again, by lerobot-train or tpgmm fit --format lerobot"
        )
    raise ModelFileError(
        f"{directory} is not a saved policy, or was saved before it was fitted: {folder} is "
        "missing"
    )

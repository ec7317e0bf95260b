"""The folder of a policy: LeRobot's configuration and processors, and a model's folder.

A file of digests says which of them were saved together: files of two saves, or one that was
changed afterwards, are refused.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from huggingface_hub.constants import CONFIG_NAME, SAFETENSORS_SINGLE_FILE
from lerobot.utils.constants import (
    POLICY_POSTPROCESSOR_DEFAULT_NAME,
    POLICY_PREPROCESSOR_DEFAULT_NAME,
)

from lerobot_policy_tpgmm.configuration_tpgmm import OLD, TPGMMConfig
from lerobot_policy_tpgmm.processor_tpgmm import make_tpgmm_pre_post_processors
from tpgmm_torch.atomic import read_whole, replacing
from tpgmm_torch.exceptions import ModelFileError
from tpgmm_torch.persistence import FILES, load, save

#: Folder of the model, as :func:`tpgmm_torch.save` writes it.
MODEL = "model"
PROCESSORS = tuple(
    f"{name}.json"
    for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME)
)
#: Of a step of a processor: lerobot-train writes these files again, on its device, with its
#: names and statistics, so only what could change numbers counts.
STEP = ("norm_map", "float_dtype")
DIGESTS = "digests.json"
COMPARED = (CONFIG_NAME, *PROCESSORS, f"{MODEL}/{CONFIG_NAME}")
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
        digests = {name: _digest(folder / name) for name in COMPARED}
        (folder / DIGESTS).write_text(json.dumps(digests, indent=1))


def _digest(file: Path) -> str:
    """Return the digest of a file; of a processor's, of what could change numbers."""
    try:
        content = read_whole(file)
        if file.name in PROCESSORS:
            steps = [
                [step["registry_name"], {k: step["config"].get(k) for k in STEP}]
                for step in json.loads(content)["steps"]
            ]
            content = json.dumps(steps, sort_keys=True).encode()
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ModelFileError(f"{file} cannot be read: {error!r}") from error
    return hashlib.sha256(content).hexdigest()


def _check_digests(directory: Path) -> None:
    """Refuse files that were not saved together, or were changed since."""
    try:
        digests = json.loads(read_whole(directory / DIGESTS))
        expected = {name: digests[name] for name in COMPARED}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ModelFileError(f"{directory / DIGESTS} cannot be read: {error!r}") from error
    changed = [name for name in expected if _digest(directory / name) != expected[name]]
    if changed:
        raise ModelFileError(
            f"{directory} holds files of different saves, or one was changed afterwards: "
            f"{', '.join(changed)} is not what was saved. Save the policy again; settings are "
            "changed when it is loaded, --policy.FIELD=VALUE"
        )


def read_model(directory: Path) -> Any:
    """Read the model or skill of a policy.

    Raises
    ------
    ModelFileError
        If it is missing, damaged, or of release 0.1 or 0.2.
    """
    folder, config = directory / MODEL, directory / CONFIG_NAME
    if folder.is_dir():
        model = load(folder)
        _check_digests(directory)
        return model
    if config.exists() and (directory / SAFETENSORS_SINGLE_FILE).exists():
        if b'"tpgmm-torch model"' in read_whole(config):
            raise ModelFileError(
                f"{directory} is a model, not a policy: tpgmm_torch.load(path) opens it, and "
                "TPGMMPolicy.from_estimator(model) makes a policy of it"
            )
        raise ModelFileError(f"{directory}: {OLD}")
    raise ModelFileError(
        f"{directory} is not a saved policy, or was saved before it was fitted: {folder} is "
        "missing"
    )

"""The files of a policy on disk: written whole, read strictly.

The numbers carry the digests of all that was written with them, so that files of two saves,
or one that was changed later, are refused.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from huggingface_hub.constants import CONFIG_NAME, SAFETENSORS_SINGLE_FILE
from lerobot.utils.constants import (
    POLICY_POSTPROCESSOR_DEFAULT_NAME,
    POLICY_PREPROCESSOR_DEFAULT_NAME,
)
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.processor_tpgmm import make_tpgmm_pre_post_processors
from tpgmm_torch.atomic import consistent, read_whole, replacing
from tpgmm_torch.exceptions import ModelFileError

__all__ = ["check_files", "read_tensors", "write_files"]

log = logging.getLogger(__name__)

PROCESSORS = tuple(
    f"{name}.json"
    for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME)
)
#: Of a step of a processor: lerobot-train writes these files again, on its device, with its
#: names and statistics, so only what could change numbers counts.
STEP = ("norm_map", "float_dtype")
#: Where the numbers carry the digests.
DIGESTS = "digests"


def write_files(config: TPGMMConfig, tensors: Mapping[str, Tensor], directory: Path) -> None:
    """Write configuration, ``state_dict`` and both processors, all in one step.

    Other files in the directory stay.
    """
    with replacing(directory.resolve(), keep=True) as folder:
        config.save_pretrained(folder)
        for processor in make_tpgmm_pre_post_processors(config):
            processor.save_pretrained(folder)
        contiguous = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
        digests = {name: _digest(folder / name) for name in (CONFIG_NAME, *PROCESSORS)}
        digests[SAFETENSORS_SINGLE_FILE] = _digest_of_numbers(save(contiguous))
        blob = save(contiguous, metadata={DIGESTS: json.dumps(digests)})
        (folder / SAFETENSORS_SINGLE_FILE).write_bytes(blob)


def check_files(directory: Path) -> bytes:
    """Check that the files of a policy were saved together and not changed since.

    A policy of release 0.1.0 carries no digests: the log says that nothing could be compared.

    Returns
    -------
    bytes
        Of the file of numbers.

    Raises
    ------
    ModelFileError
        If one cannot be read, or is not the one that was saved with the numbers.
    """
    return consistent(directory, lambda: _checked(directory))


def _checked(directory: Path) -> bytes:
    file = directory / SAFETENSORS_SINGLE_FILE
    try:
        blob = read_whole(file)
        metadata = _header(blob).get("__metadata__", {})
        if DIGESTS not in metadata and metadata in ({}, {"format": "pt"}):
            log.warning("%s was saved without digests: its files are taken as they are", file)
            return blob
        digests = json.loads(metadata[DIGESTS])
        # what was fetched from the hub comes file by file, the numbers before the processors
        names = [name for name in digests if name == CONFIG_NAME or (directory / name).exists()]
        found = {name: _digest(directory / name) for name in names}
        found[SAFETENSORS_SINGLE_FILE] = _digest_of_numbers(blob)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        if isinstance(error, ModelFileError):
            raise
        raise ModelFileError(f"{file} cannot be read: {error!r}") from error
    changed = sorted(name for name in found if found[name] != digests.get(name))
    if SAFETENSORS_SINGLE_FILE in changed:
        raise ModelFileError(f"{file} is truncated or was changed after it was saved")
    if changed:
        raise ModelFileError(
            f"{directory} holds files of different saves, or one was changed afterwards: "
            f"{', '.join(changed)} is not what was saved with {SAFETENSORS_SINGLE_FILE}. Save "
            "the policy again; settings are changed when it is loaded, --policy.FIELD=VALUE"
        )
    return blob


def read_tensors(file: str, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Read the numbers of a policy, all that are expected and no other.

    Parameters
    ----------
    expected : mapping of str to Tensor
        The ``state_dict`` that they are for.

    Raises
    ------
    ModelFileError
        If the file is damaged or does not belong to those beside it, an entry is missing, too
        many, or of another shape or dtype, or the policy was not fitted.
    """
    try:
        tensors = load(check_files(Path(file).parent))
    except (SafetensorError, ValueError, KeyError) as error:
        if isinstance(error, ModelFileError):
            raise
        raise ModelFileError(f"{file} cannot be read: {error}") from error
    read = {name: _signature(tensor) for name, tensor in tensors.items()}
    wanted = {name: _signature(tensor) for name, tensor in expected.items()}
    wrong = [
        f"{name} is {read.get(name, 'missing')}, expected {wanted.get(name, 'nothing')}"
        for name in sorted(read.keys() | wanted.keys())
        if read.get(name) != wanted.get(name)
    ]
    if wrong:
        raise ModelFileError(
            f"{file} does not belong to the configuration beside it: {'; '.join(wrong)}. Was "
            "n_components, the robot or an operator changed? Fit again"
        )
    if not all(bool(value) for name, value in tensors.items() if name.endswith(".fitted")):
        raise ModelFileError(
            f"{file} holds a policy that was saved before it was fitted: train it to the end "
            "of the first epoch"
        )
    return tensors


def _digest(file: Path) -> str:
    """Of a whole file; of a processor's, of what could change numbers."""
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


def _header(blob: bytes) -> dict[str, Any]:
    """The JSON in front of the numbers."""
    header: dict[str, Any] = json.loads(blob[8 : 8 + int.from_bytes(blob[:8], "little")])
    return header


def _digest_of_numbers(blob: bytes) -> str:
    """Of names, shapes and bytes, whatever else the header says."""
    header = _header(blob)
    header.pop("__metadata__", None)
    data = blob[8 + int.from_bytes(blob[:8], "little") :]
    return hashlib.sha256(json.dumps(header, sort_keys=True).encode() + data).hexdigest()


def _signature(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {tuple(tensor.shape)}"

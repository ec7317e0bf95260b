"""The numbers of a policy on disk: written whole, read strictly."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.processor_tpgmm import make_tpgmm_pre_post_processors
from tpgmm_torch.atomic import replacing
from tpgmm_torch.exceptions import ModelFileError

__all__ = ["read_tensors", "write_files"]


def write_files(config: TPGMMConfig, tensors: Mapping[str, Tensor], directory: Path) -> None:
    """Write configuration, ``state_dict`` and both processors, all in one step.

    Other files in the directory stay.
    """
    with replacing(directory.resolve(), keep=True) as folder:
        config.save_pretrained(folder)
        blob = save({k: v.detach().cpu().contiguous() for k, v in tensors.items()})
        (folder / SAFETENSORS_SINGLE_FILE).write_bytes(blob)
        for processor in make_tpgmm_pre_post_processors(config):
            processor.save_pretrained(folder)


def read_tensors(file: str, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Read the numbers of a policy, all that are expected and no other.

    Parameters
    ----------
    expected : mapping of str to Tensor
        The ``state_dict`` that they are for.

    Raises
    ------
    ModelFileError
        If the file is damaged, an entry is missing, too many, or of another shape or dtype,
        or the policy was not fitted.
    """
    try:
        tensors = load_file(file)
    except (OSError, SafetensorError) as error:
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
    if not bool(tensors["mixture.fitted"]):
        raise ModelFileError(
            f"{file} holds a policy that was saved before it was fitted: train it to the end "
            "of the first epoch"
        )
    return tensors


def _signature(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {tuple(tensor.shape)}"

"""Folders of two files: JSON for words and settings, safetensors for numbers.

An interrupted save leaves the old folder or the new one, never a mixture. Reading takes
numbers and names, never code, and refuses whatever was cut off or changed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from tpgmm_torch.atomic import consistent, read_whole, replacing
from tpgmm_torch.exceptions import ModelFileError

__all__ = ["Folder"]

CONFIG = "config.json"


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _canonical(config: Mapping[str, Any]) -> bytes:
    body = {key: value for key, value in config.items() if key != "digest"}
    return json.dumps(body, sort_keys=True, allow_nan=False).encode()


@dataclass(frozen=True)
class Folder:
    """One kind of folder: ``config.json`` and ``KIND.safetensors``.

    Parameters
    ----------
    kind : str
        What is in it, "model" for example.
    version : int
        Of its format; others are refused.
    """

    kind: str
    version: int

    @property
    def _format(self) -> str:
        return f"tpgmm-torch {self.kind}"

    @property
    def tensors(self) -> str:
        """Name of the file of numbers."""
        return f"{self.kind}.safetensors"

    def write(
        self, path: str | Path, config: Mapping[str, Any], tensors: Mapping[str, Tensor]
    ) -> None:
        """Write a folder atomically, replacing one of its kind that is there.

        Parameters
        ----------
        path : str or Path
            The directory.
        config : mapping
            JSON values.
        tensors : mapping of str to Tensor
            On any device.

        Raises
        ------
        ModelFileError
            If ``path`` exists and is no folder of this kind, or holds other files too: it is
            left alone. If the configuration is not of JSON's values.
        """
        path = Path(path)
        blob = safetensors.torch.save(
            {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
        )
        shapes = {
            k: {"shape": list(v.shape), "dtype": str(v.dtype)} for k, v in tensors.items()
        }
        full = {"format": self._format, "version": self.version, **config}
        full |= {"tensors": shapes, "tensors_sha256": _digest(blob)}
        try:
            full["digest"] = _digest(_canonical(full))
        except (TypeError, ValueError, RecursionError) as error:
            raise ModelFileError(
                f"the {self.kind} cannot be described in JSON: {error}"
            ) from error
        with replacing(path) as new:
            if path.exists() and not self._replaceable(path):
                raise ModelFileError(
                    f"{path} exists and is not a saved {self.kind} alone; choose another "
                    "directory"
                )
            new.mkdir()
            (new / CONFIG).write_text(json.dumps(full, indent=1, allow_nan=False))
            (new / self.tensors).write_bytes(blob)

    def _replaceable(self, path: Path) -> bool:
        """Whether nothing but one of this kind, or nothing at all, is lost by replacing it."""
        files = {CONFIG, self.tensors}
        if not path.is_dir() or {item.name for item in path.iterdir()} - files:
            return False
        try:
            return bool(json.loads(read_whole(path / CONFIG))["format"] == self._format)
        except FileNotFoundError:
            return not any(path.iterdir())
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            return False

    def read(self, path: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Read a folder, checking version, digests, names, shapes and dtypes.

        Parameters
        ----------
        path : str or Path
            The directory.

        Returns
        -------
        config : dict
        tensors : dict of str to Tensor

        Raises
        ------
        ModelFileError
            If a file is missing, truncated, changed, or of another version.
        """
        path = Path(path)
        return consistent(path, lambda: self._checked(path))

    def _checked(self, path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
        config = self._read(path / CONFIG, json.loads)
        blob = self._read(path / self.tensors, bytes)
        if not isinstance(config, dict) or config.get("format") != self._format:
            raise ModelFileError(f"{path / CONFIG} does not describe a {self._format}")
        if config.get("version") != self.version:
            raise ModelFileError(
                f"{path} is a {self.kind} of format version {config.get('version')!r}, this "
                f"release reads version {self.version}: load it with the release that wrote "
                "it, or fit again"
            )
        try:
            digest = _digest(_canonical(config))
        except (ValueError, RecursionError):  # NaN or infinity, which no model has, or too deep
            digest = ""
        if config.get("digest") != digest:
            raise ModelFileError(f"{path / CONFIG} was changed after it was saved")
        if config.get("tensors_sha256") != _digest(blob):
            raise ModelFileError(
                f"{path / self.tensors} is truncated or was changed after it was saved"
            )
        try:
            tensors = safetensors.torch.load(blob)
        except (SafetensorError, ValueError, KeyError) as error:
            raise ModelFileError(f"{path / self.tensors} cannot be read: {error}") from error
        described = {
            k: {"shape": list(v.shape), "dtype": str(v.dtype)} for k, v in tensors.items()
        }
        if described != config.get("tensors"):
            raise ModelFileError(
                f"{path / self.tensors} holds {described}, expected {config.get('tensors')}"
            )
        return config, tensors

    def _read[T](self, file: Path, parse: Callable[[bytes], T]) -> T:
        try:
            return parse(read_whole(file))
        except (FileNotFoundError, NotADirectoryError):
            raise ModelFileError(
                f"{file.parent} is not a saved {self.kind}: {file} is missing"
            ) from None
        except (ValueError, OSError, RecursionError, MemoryError) as error:
            raise ModelFileError(f"{file} cannot be read: {error}") from error

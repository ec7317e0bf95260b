"""Fitted models on disk: tensors as safetensors, everything else as JSON.

A model is a directory of ``config.json`` and ``model.safetensors``. It is written beside its
destination and moved there in one step, so an interrupted save leaves the old model or none.
Loading reads numbers and names, never code, and refuses whatever does not fit together.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from tpgmm_torch import operators as builtin_operators
from tpgmm_torch.exceptions import ModelFileError
from tpgmm_torch.joint_space import JointSpace
from tpgmm_torch.kinematics import Kinematics
from tpgmm_torch.mixture import BlockGaussianMixture
from tpgmm_torch.operators import Operator, Stack
from tpgmm_torch.poses import Poses
from tpgmm_torch.robots import Robot

__all__ = [
    "decode",
    "encode",
    "load_estimator",
    "read_model",
    "save_estimator",
    "write_model",
]

FORMAT, VERSION = "tpgmm-torch model", 1
CONFIG, TENSORS = "config.json", "model.safetensors"
KNOWN: dict[str, type] = {
    name: getattr(builtin_operators, name)
    for name in builtin_operators.__all__
    if issubclass(getattr(builtin_operators, name), Operator)
} | {"Robot": Robot, "Poses": Poses, "JointSpace": JointSpace}


def encode(thing: Operator | Kinematics) -> dict[str, Any]:
    """Describe an operator or a robot by its class name and its fields, ready for JSON.

    Raises
    ------
    ModelFileError
        If it has no such description.
    """
    name = type(thing).__name__
    if isinstance(thing, Stack):
        return {"type": name, "operators": [encode(member) for member in thing.operators]}
    if isinstance(thing, Operator):
        return {"type": name} | {f.name: getattr(thing, f.name) for f in fields(thing)}  # type: ignore[arg-type]
    if hasattr(thing, "config"):
        return {"type": name, "config": thing.config()}
    raise ModelFileError(
        f"{name} cannot be saved: give it config() and a classmethod from_config()"
    )


def decode(description: Mapping[str, Any], custom: Sequence[type] = ()) -> Any:
    """The inverse of :func:`encode`.

    Parameters
    ----------
    description : mapping
        What :func:`encode` gave.
    custom : sequence of type
        User-defined classes that may occur; no other code is ever looked up.

    Raises
    ------
    ModelFileError
        If the class is not known or does not take these fields.
    """
    known = KNOWN | {cls.__name__: cls for cls in custom}
    arguments = dict(description)
    name = arguments.pop("type", None)
    if name not in known:
        raise ModelFileError(
            f"the model uses the class {name!r}, which is not known here: pass it, "
            f"load(path, custom=[{name}]); known are {sorted(known)}"
        )
    try:
        if name == "Stack":
            return Stack(*(decode(member, custom) for member in arguments["operators"]))
        if "config" in arguments:
            return known[name].from_config(arguments["config"])  # type: ignore[attr-defined]
        return known[name](**arguments)
    except (TypeError, KeyError, ValueError) as error:
        raise ModelFileError(f"the model's {name} cannot be rebuilt: {error}") from error


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _canonical(config: Mapping[str, Any]) -> bytes:
    body = {key: value for key, value in config.items() if key != "digest"}
    return json.dumps(body, sort_keys=True, allow_nan=False).encode()


def write_model(
    path: str | Path, config: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> None:
    """Write a model directory atomically, replacing one that is there.

    Parameters
    ----------
    path : str or Path
        The directory.
    config : mapping
        JSON values.
    tensors : mapping of str to Tensor

    Raises
    ------
    ModelFileError
        If ``path`` exists and is no model directory: it is left alone.
    """
    path = Path(path)
    if (
        path.exists()
        and not (path / CONFIG).is_file()
        and (not path.is_dir() or any(path.iterdir()))
    ):
        raise ModelFileError(
            f"{path} exists and is not a saved model; choose another directory"
        )
    blob = safetensors.torch.save(
        {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    )
    shapes = {k: {"shape": list(v.shape), "dtype": str(v.dtype)} for k, v in tensors.items()}
    full = {"format": FORMAT, "version": VERSION, **config}
    full |= {"tensors": shapes, "tensors_sha256": _digest(blob)}
    full["digest"] = _digest(_canonical(full))
    path.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    try:
        (staging / "new").mkdir()
        (staging / "new" / CONFIG).write_text(json.dumps(full, indent=1, allow_nan=False))
        (staging / "new" / TENSORS).write_bytes(blob)
        if path.exists():
            path.rename(staging / "old")
        (staging / "new").rename(path)
    except BaseException:
        if (staging / "old").exists() and not path.exists():
            (staging / "old").rename(path)
        raise
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def read_model(path: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read a model directory, checking version, digests, names, shapes and dtypes.

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
    try:
        config = json.loads((path / CONFIG).read_text())
        blob = (path / TENSORS).read_bytes()
    except FileNotFoundError as error:
        raise ModelFileError(
            f"{path} is not a saved model: {error.filename} is missing"
        ) from None
    except (ValueError, OSError) as error:
        raise ModelFileError(f"{path / CONFIG} cannot be read: {error}") from error
    if not isinstance(config, dict) or config.get("format") != FORMAT:
        raise ModelFileError(f"{path / CONFIG} does not describe a {FORMAT}")
    if config.get("version") != VERSION:
        raise ModelFileError(
            f"{path} is a model of format version {config.get('version')!r}, this release "
            f"reads version {VERSION}: load it with the release that wrote it, or fit again"
        )
    if config.get("digest") != _digest(_canonical(config)):
        raise ModelFileError(f"{path / CONFIG} was changed after it was saved")
    if config.get("tensors_sha256") != _digest(blob):
        raise ModelFileError(f"{path / TENSORS} is truncated or was changed after it was saved")
    try:
        tensors = safetensors.torch.load(blob)
    except SafetensorError as error:
        raise ModelFileError(f"{path / TENSORS} cannot be read: {error}") from error
    found = {k: {"shape": list(v.shape), "dtype": str(v.dtype)} for k, v in tensors.items()}
    if found != config["tensors"]:
        raise ModelFileError(f"{path / TENSORS} holds {found}, expected {config['tensors']}")
    return config, tensors


def save_estimator(model: Any, path: str | Path) -> None:
    """Write a fitted :class:`TaskParameterizedGMM`; its method ``save`` calls this."""
    parameters = model.get_params(deep=False)
    for name in ("operators", "robot"):
        parameters.pop(name)
    if not isinstance(model.random_state, int):
        parameters["random_state"] = None
    config = {
        "parameters": parameters,
        "operators": [encode(operator) for operator in model.operators_],
        "kinematics": encode(model.kinematics_),
        "frames": list(model.frame_names_),
        "n_iter": model.n_iter_,
        "converged": bool(model.converged_),
        "lower_bound": float(model.lower_bound_),
    }
    tensors = {"weights": model.weights_, "time": model.time_}
    for j, (mean, covariance) in enumerate(zip(model.means_, model.covariances_, strict=True)):
        tensors |= {f"means.{j}": mean, f"covariances.{j}": covariance}
    write_model(path, config, tensors)


def load_estimator(cls: type[Any], path: str | Path, custom: Sequence[type] = ()) -> Any:
    """Read a fitted :class:`TaskParameterizedGMM`; its method ``load`` calls this."""
    config, tensors = read_model(path)
    operators = [decode(item, custom) for item in config["operators"]]
    kinematics = decode(config["kinematics"], custom)
    robot = None if isinstance(kinematics, JointSpace) else kinematics
    try:
        model = cls(operators=operators, robot=robot, **config["parameters"])
        model._validate_params()
        tensors = {name: tensor.to(model.device) for name, tensor in tensors.items()}
        model.weights_, model.time_ = tensors["weights"], tensors["time"]
        model.means_ = [tensors[f"means.{j}"] for j in range(len(operators))]
        model.covariances_ = [tensors[f"covariances.{j}"] for j in range(len(operators))]
        model.mixture_ = BlockGaussianMixture.from_parameters(
            model.weights_,
            model.means_,
            model.covariances_,
            **model._mixture_parameters(operators, kinematics),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f"{path} does not fit together: {error}") from error
    model.operators_ = tuple(operators)
    model.kinematics_ = kinematics.to(model.time_.dtype, model.device)
    model.frame_names_ = tuple(config["frames"])
    for name in ("n_iter", "converged", "lower_bound"):
        setattr(model, f"{name}_", config[name])
    return model

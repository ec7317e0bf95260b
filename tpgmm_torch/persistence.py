"""Fitted models on disk: tensors as safetensors, everything else as JSON.

A model is a directory of ``config.json`` and ``model.safetensors``. It is written beside its
destination and moved there in one step, so an interrupted save leaves the old model or none.
Loading reads numbers and names, never code, and refuses whatever does not fit together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from tpgmm_torch import operators as builtin_operators
from tpgmm_torch.exceptions import ModelFileError
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.operators import Canonical, Operator, Stack
from tpgmm_torch.operators.base import frame_names
from tpgmm_torch.robots.joint_space import JointSpace
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.tracked_poses import Poses
from tpgmm_torch.storage import CONFIG, Folder

__all__ = [
    "CONFIG",
    "TENSORS",
    "decode",
    "encode",
    "load_estimator",
    "read_model",
    "restore",
    "save_estimator",
    "write_model",
]

MODEL = Folder("model", 1)
TENSORS = MODEL.tensors
KNOWN: dict[str, type] = {
    name: getattr(builtin_operators, name)
    for name in builtin_operators.__all__
    if issubclass(getattr(builtin_operators, name), Operator)
} | {"Robot": Robot, "Poses": Poses, "JointSpace": JointSpace}


def encode(thing: Operator | Kinematics) -> dict[str, Any]:
    """Describe an operator or a robot by its class name and its fields, ready for JSON.

    Parameters
    ----------
    thing : Operator or Kinematics

    Returns
    -------
    dict

    Raises
    ------
    ModelFileError
        If it has no such description.

    Examples
    --------
    >>> from tpgmm_torch import RelativePosition
    >>> encode(RelativePosition("hand", "cup"))
    {'type': 'RelativePosition', 'link': 'hand', 'frame': 'cup'}
    """
    name = type(thing).__name__
    if KNOWN.get(name, type(thing)) is not type(thing):
        raise ModelFileError(f"your class {name} has the name of a built-in one: rename it")
    if type(thing) is Stack:
        return {"type": name, "operators": [encode(member) for member in thing.operators]}
    if isinstance(thing, Operator) and is_dataclass(thing):
        return {"type": name} | {f.name: getattr(thing, f.name) for f in fields(thing)}  # type: ignore[arg-type]
    if hasattr(thing, "config"):
        return {"type": name, "config": thing.config()}
    raise ModelFileError(
        f"{name} cannot be saved: make an operator a frozen dataclass, give a robot config() "
        "and a classmethod from_config()"
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
        return known[name](**{key: _frozen(value) for key, value in arguments.items()})
    except (TypeError, KeyError, ValueError) as error:
        raise ModelFileError(f"the model's {name} cannot be rebuilt: {error}") from error


def _frozen(value: Any) -> Any:
    """JSON has lists, operators have tuples."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


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
        If ``path`` exists and is no model directory, or holds other files too: it is left
        alone. If the configuration is not of JSON's values.
    """
    MODEL.write(path, config, tensors)


def read_model(path: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read a model directory, checking version, digests, names, shapes and dtypes.

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
    return MODEL.read(path)


def save_estimator(model: Any, path: str | Path) -> None:
    """Write a fitted :class:`TaskParameterizedGMM`; its method ``save`` calls this.

    Parameters
    ----------
    model : TaskParameterizedGMM
    path : str or Path
        The directory.

    Raises
    ------
    ModelFileError
        If something is there that is no model, or an operator or robot cannot be described.
    """
    parameters = {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in model.get_params(deep=False).items()
        if name not in ("operators", "robot")
    }
    if not isinstance(parameters["random_state"], int):
        parameters["random_state"] = None
    config = {
        "parameters": parameters,
        "operators": [encode(operator) for operator in model.operators_],
        "kinematics": encode(model.kinematics_),
        "frames": list(model.frame_names_),
        "n_iter": model.n_iter_,
        "converged": bool(model.converged_),
        "lower_bound": None if math.isnan(model.lower_bound_) else float(model.lower_bound_),
    }
    tensors = {"weights": model.weights_, "time": model.time_}
    for j, (mean, covariance) in enumerate(zip(model.means_, model.covariances_, strict=True)):
        tensors |= {f"means.{j}": mean, f"covariances.{j}": covariance}
    write_model(path, config, tensors)


def restore(
    model: Any,
    kinematics: Kinematics,
    weights: Tensor,
    means: Sequence[Tensor],
    covariances: Sequence[Tensor],
    time: Tensor,
) -> None:
    """Make a :class:`TaskParameterizedGMM` a fitted one, from parameters known elsewhere.

    What EM reports is not among them: ``n_iter_`` becomes 0, ``converged_`` False and
    ``lower_bound_`` NaN.

    Parameters
    ----------
    model : TaskParameterizedGMM
        With its operators; fitted or not.
    kinematics : Kinematics
        What the operators act on.
    weights, means, covariances, time
        As in the attributes of the model; they are kept as they are.

    Raises
    ------
    DataError, ShapeError
        If they are no mixture, or do not fit the operators.
    """
    operators = (Canonical(),) if model.operators is None else tuple(model.operators)
    mixture = BlockGaussianMixture.from_parameters(
        weights, means, covariances, **model._mixture_parameters(operators, kinematics)
    )
    # it checked them; what it keeps went through their factors, and was rounded
    mixture.means_, mixture.covariances_ = list(means), list(covariances)
    mixture.weights_ = weights
    model.mixture_, model.operators_, model.weights_ = mixture, operators, weights
    model.means_, model.covariances_ = mixture.means_, mixture.covariances_
    model.time_ = time
    model.kinematics_ = kinematics.to(time.dtype, model.device)
    model.frame_names_ = frame_names(operators, kinematics)
    model.n_iter_, model.converged_, model.lower_bound_ = 0, False, math.nan


def load_estimator(
    kind: type[Any], path: str | Path, custom: Sequence[type] = (), device: str | None = None
) -> Any:
    """Read a fitted :class:`TaskParameterizedGMM`; its method ``load`` calls this.

    Parameters
    ----------
    kind : type
        The class of the model.
    path : str or Path
        The directory.
    custom : sequence of type
        User-defined operator and robot classes that the model uses.
    device : str, optional
        Instead of the one that the model was saved from.

    Returns
    -------
    TaskParameterizedGMM

    Raises
    ------
    ModelFileError
        If the files are damaged, or do not fit together.
    """
    config, tensors = read_model(path)
    try:
        operators = [decode(item, custom) for item in config["operators"]]
        kinematics = decode(config["kinematics"], custom)
        robot = None if isinstance(kinematics, JointSpace) else kinematics
        for operator in operators:
            operator.check(kinematics, config["frames"])
        if len(tensors) != 2 + 2 * len(operators) or not operators:
            raise ModelFileError(
                f"{path} does not fit together: {len(operators)} operators, but the tensors "
                f"{sorted(tensors)}"
            )
        model = kind(operators=operators, robot=robot, **config["parameters"])
        model.device = device or model.device
        model._validate_params()
        tensors = {name: tensor.to(model.device) for name, tensor in tensors.items()}
        restore(
            model,
            kinematics,
            tensors["weights"],
            [tensors[f"means.{j}"] for j in range(len(operators))],
            [tensors[f"covariances.{j}"] for j in range(len(operators))],
            tensors["time"],
        )
        model.n_iter_, model.converged_ = config["n_iter"], config["converged"]
        known = config["lower_bound"] is not None
        model.lower_bound_ = config["lower_bound"] if known else math.nan
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, ModelFileError):
            raise
        raise ModelFileError(f"{path} does not fit together: {error}") from error
    return model

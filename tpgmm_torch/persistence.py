"""Models on disk: tensors as safetensors, everything else as JSON.

A model, fitted or wrapped, is a folder of ``config.json`` and ``model.safetensors``. It is
written beside its destination and moved there in one step, so that an interrupted save leaves
the old model or none. Loading reads numbers and names, never code, and refuses whatever does
not fit together.
"""

from __future__ import annotations

import json
import math
from collections import abc
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from tpgmm_torch import operators as builtin_operators
from tpgmm_torch.atomic import read_whole
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import ModelFileError
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.operators import Operator, Stack
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, InformationFusion
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.joint_space import JointSpace
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.tracked_poses import Poses
from tpgmm_torch.skills.sequence import Sequence
from tpgmm_torch.skills.via_point import ViaPoint
from tpgmm_torch.skills.via_points import ViaPoints
from tpgmm_torch.skills.ways import Ways
from tpgmm_torch.storage import CONFIG, Folder

__all__ = ["FILES", "decode", "encode", "load", "load_model", "load_skill", "save"]

#: Files of a model; version 1 was written up to 0.2.
MODEL = Folder("model", 2)
FILES = CONFIG, MODEL.tensors
OPERATORS = (getattr(builtin_operators, name) for name in builtin_operators.__all__)
KNOWN: dict[str, type] = {
    each.__name__: each
    for each in (
        *(each for each in OPERATORS if issubclass(each, Operator)),
        Robot, Poses, JointSpace, Hold, TrainingSummary, MotionBounds, Conditionals, Regression,
        InformationFusion, CovarianceFusion, ViaPoint, ViaPoints, Sequence, Ways,
        TaskParameterizedGMM,
    )
}  # fmt: skip
#: What an estimator has learned, as :meth:`TaskParameterizedGMM.from_parameters` takes it.
LEARNING = "n_iter_", "converged_", "lower_bound_"
LEARNED = ("weights", "means", "covariances", "time", "holds", "n_demonstrations")


def save(model: Any, path: str | Path) -> None:
    """Write a fitted model or a skill to a folder, atomically.

    Parameters
    ----------
    model : TaskParameterizedGMM, or Skill
    path : str or Path
        A new folder, or one that holds a model already.

    Raises
    ------
    NotFittedError
    ModelFileError
        If something else is there, or the model has parts that cannot be described: a robot of
        your own needs ``config()`` and a classmethod ``from_config()``.
    """
    tensors: dict[str, Tensor] = {}
    description = encode(model, tensors)
    MODEL.write(path, {"model": description}, tensors)


def load(path: str | Path, custom: abc.Sequence[type] = (), device: str | None = None) -> Any:
    """Read a model or a skill; nothing in its folder is executed.

    Parameters
    ----------
    path : str or Path
    custom : sequence of type
        Your own operators and robots that occur in it; no other code is ever looked up.
    device : str, optional
        Where its tensors go; by default, to the CPU.

    Returns
    -------
    TaskParameterizedGMM, or Skill

    Raises
    ------
    ModelFileError
        If the folder is missing, damaged, of another version, or does not fit together.
    """
    path = Path(path)
    _refuse_others(path)
    config, tensors = MODEL.read(path)
    try:
        model = decode(config["model"], custom, _on_device(tensors, device, path))
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        if isinstance(error, ModelFileError):
            raise
        raise ModelFileError(f"{path} does not fit together: {error}") from error
    return model


def load_model(
    path: str | Path, custom: abc.Sequence[type] = (), device: str | None = None
) -> TaskParameterizedGMM:
    """:func:`tpgmm_torch.load` a fitted estimator.

    Parameters
    ----------
    path, custom, device
        As of :func:`tpgmm_torch.load`.

    Raises
    ------
    ModelFileError
        As :func:`tpgmm_torch.load`; or if it is another skill.
    """
    model = load(path, custom, device)
    if not isinstance(model, TaskParameterizedGMM):
        raise ModelFileError(
            f"{path} holds {type(model).__name__}, this needs a model of one way and one part"
        )
    return model


def load_skill(
    path: str | Path, custom: abc.Sequence[type] = (), device: str | None = None
) -> Any:
    """:func:`tpgmm_torch.load` what runs: a skill, or that of an estimator.

    Parameters
    ----------
    path, custom, device
        As of :func:`tpgmm_torch.load`.
    """
    model = load(path, custom, device)
    return model.skill if isinstance(model, TaskParameterizedGMM) else model


def encode(thing: Any, tensors: dict[str, Tensor] | None = None) -> Any:
    """Describe a model or a part of it by class names and fields, ready for JSON.

    Parameters
    ----------
    thing : Operator, Kinematics, Skill, TaskParameterizedGMM, number or text
    tensors : dict of str to Tensor, optional
        Takes up the tensors, by a name that the description refers to.

    Raises
    ------
    ModelFileError
        If it has no such description.

    Examples
    --------
    >>> from tpgmm_torch import RelativePosition
    >>> encode(RelativePosition("hand", "cup"))
    {'type': 'RelativePosition', 'link': 'hand', 'frame': 'cup', 'held': False, ...}
    """
    if isinstance(thing, np.generic):
        thing = thing.item()
    if thing is None or isinstance(thing, str | bool | int):
        return thing
    if isinstance(thing, float):
        return thing if math.isfinite(thing) else {"float": repr(thing)}
    if isinstance(thing, abc.Sequence | np.ndarray):
        return [encode(each, tensors) for each in thing]
    if isinstance(thing, Mapping):
        return {"mapping": {str(key): encode(each, tensors) for key, each in thing.items()}}
    if isinstance(thing, Tensor) and tensors is not None:
        name = f"{len(tensors):04d}"
        tensors[name] = thing
        return {"tensor": name}
    name = type(thing).__name__
    if KNOWN.get(name, type(thing)) is not type(thing):
        raise ModelFileError(f"your class {name} has the name of a built-in one: rename it")
    if hasattr(thing, "config"):
        return {"type": name, "config": thing.config()}
    return {"type": name} | {key: encode(each, tensors) for key, each in _parts(thing).items()}


def _parts(thing: Any) -> dict[str, Any]:
    """Arguments from which a thing can be made again."""
    if isinstance(thing, TaskParameterizedGMM):
        skill, parameters = thing.skill, thing.get_params(deep=False)
        if not isinstance(parameters["random_state"], int):
            parameters["random_state"] = None
        learned = {name: getattr(thing, f"{name}_") for name in LEARNED}
        return (
            parameters
            | learned
            | {
                "n_components": len(thing.weights_),
                "operators": thing.operators_,
                "robot": thing.kinematics_,
                "learning": {name: getattr(thing, name) for name in LEARNING},
                "peaks": skill.peaks,
                "summary": skill.summary,
            }
        )
    if isinstance(thing, ViaPoint):
        value = thing.value
        named = dict(value) if isinstance(value[0], tuple) else value  # type: ignore[arg-type]
        return vars(thing) | {"value": named}
    if isinstance(thing, ViaPoints):
        return {"skill": thing.skill, "points": thing.points, "fade": thing.fade}
    if is_dataclass(thing):
        return {each.name: getattr(thing, each.name) for each in fields(thing)}
    raise ModelFileError(
        f"{type(thing).__name__} cannot be saved: make an operator a frozen dataclass, give a "
        "robot config() and a classmethod from_config()"
    )


def decode(
    description: Any,
    custom: abc.Sequence[type] = (),
    tensors: Mapping[str, Tensor] | None = None,
) -> Any:
    """The inverse of :func:`encode`.

    Parameters
    ----------
    description : number, text, list or mapping
        What :func:`encode` gave.
    custom : sequence of type
        User-defined classes that may occur; no other code is ever looked up.
    tensors : mapping of str to Tensor, optional
        Those that were described, on the device where they are wanted.

    Raises
    ------
    ModelFileError
        If a class is not known or does not take these fields.
    """
    if isinstance(description, list):
        return tuple(decode(each, custom, tensors) for each in description)
    if not isinstance(description, Mapping):
        return description
    if "float" in description:
        return float(description["float"])
    if "tensor" in description:
        return (tensors or {})[description["tensor"]]
    if "mapping" in description:
        return {k: decode(each, custom, tensors) for k, each in description["mapping"].items()}
    known = KNOWN | {cls.__name__: cls for cls in custom}
    arguments = dict(description)
    name = arguments.pop("type", None)
    if name not in known:
        raise ModelFileError(
            f"the model uses the class {name!r}, which is not known here: pass it, "
            f"load(path, custom=[{name}]); known are {sorted(known)}"
        )
    kind: Any = known[name]
    try:
        if kind is TrainingSummary:
            return partial(TrainingSummary.from_config, arguments["config"])
        if "config" in arguments:
            return kind.from_config(arguments["config"])
        given = {key: decode(each, custom, tensors) for key, each in arguments.items()}
        if kind is Stack:
            return Stack(*given["operators"])
        if (summary := given.get("summary")) is not None:  # which needs the robot
            given["summary"] = summary(given.get("robot") or given["kinematics"])
        if kind is TaskParameterizedGMM:
            given["device"] = str(given["time"].device)
            learning = given.pop("learning")
            model = TaskParameterizedGMM.from_parameters(**given)
            for each in LEARNING:
                setattr(model, each, learning[each])
            return model
        if kind is Regression:
            given["kinematics"] = given["kinematics"].to(device=given["time"].device)
        return kind(**given)
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        if isinstance(error, ModelFileError):
            raise
        raise ModelFileError(f"the model's {name} cannot be rebuilt: {error}") from error


def _refuse_others(path: Path) -> None:
    """Say what a folder is that people take for a model's."""
    if (path / "modes").is_dir():
        raise ModelFileError(
            f"{path} is a model of several ways of version 0.2, which is not read any more: "
            "fit it again, and save Ways"
        )
    try:
        kind = json.loads(read_whole(path / CONFIG)).get("type")
    except (OSError, ValueError, AttributeError, RecursionError):
        return
    if kind == "tpgmm":
        raise ModelFileError(
            f"{path} is a LeRobot policy, not a model: load it with "
            "TPGMMPolicy.from_pretrained(path)"
        )


def _on_device(
    tensors: Mapping[str, Tensor], device: str | None, path: Path
) -> Mapping[str, Tensor]:
    """The tensors of a file on a device, which may be one of another machine."""
    if device is None:
        return tensors
    try:
        return {name: tensor.to(device) for name, tensor in tensors.items()}
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).partition("\n")[0]
        raise ModelFileError(
            f"{path} cannot be loaded onto the device {device!r}, which is not there "
            f'({reason}): use load(path, device="cpu")'
        ) from error

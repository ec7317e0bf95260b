"""Models on disk: tensors as safetensors, everything else as JSON.

A model, fitted or wrapped, is a folder of ``config.json`` and ``model.safetensors``. It is
written beside its destination and moved there in one step, so that an interrupted save leaves
the old model or none. Loading reads numbers and names, never code, and refuses whatever does
not fit together.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import abc
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from types import FunctionType, MappingProxyType, MethodType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch import operators as builtin_operators
from tpgmm_torch.atomic import consistent, contents, read_whole, replacing
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, ModelFileError, ShapeError, TPGMMError
from tpgmm_torch.motion.command_gaps import CommandGaps
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.operators import Operator, Stack
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, InformationFusion
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import JointSpace, Kinematics
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.tracked_poses import Poses
from tpgmm_torch.skills.sequence import Sequence
from tpgmm_torch.skills.skill import Skill
from tpgmm_torch.skills.via_point import ViaPoint
from tpgmm_torch.skills.via_points import ViaPoints
from tpgmm_torch.skills.ways import Ways

__all__ = ["load", "save"]

#: Files of a model.
FILES = CONFIG, TENSORS = "config.json", "model.safetensors"
#: Version 1 was written up to 0.2.
FORMAT = {"format": "tpgmm-torch model", "version": 2}
OPERATORS = (getattr(builtin_operators, name) for name in builtin_operators.__all__)
KNOWN: dict[str, type] = {
    each.__name__: each
    for each in (
        *(each for each in OPERATORS if issubclass(each, Operator)),
        Robot, Poses, JointSpace, Hold, TrainingSummary, MotionBounds, CommandGaps,
        Conditionals, Regression, InformationFusion, CovarianceFusion, ViaPoint, ViaPoints,
        Sequence, Ways, TaskParameterizedGMM,
    )
}  # fmt: skip
#: What an estimator has learned, as :meth:`TaskParameterizedGMM.from_parameters` takes it.
LEARNING = "n_iter_", "converged_", "lower_bound_"
#: What fields may hold that are annotated otherwise.
ACCEPTED: dict[Any, Any] = {float: (float, int), Any: object, Skill: object}
LEARNED = ("weights", "means", "covariances", "time", "holds", "n_demonstrations")


def save(model: TaskParameterizedGMM | Skill, path: str | Path) -> None:
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
    path, tensors = Path(path), dict[str, Tensor]()
    config = FORMAT | {"model": encode(model, tensors)}
    blob = safetensors.torch.save(
        {name: each.detach().cpu().contiguous() for name, each in tensors.items()}
    )
    config["tensors_sha256"] = hashlib.sha256(blob).hexdigest()
    config["digest"] = _digest(config)
    with replacing(path) as new:
        if path.exists() and not _replaceable(path):
            raise ModelFileError(
                f"{path} exists and is not a saved model alone; choose another directory"
            )
        new.mkdir()
        (new / CONFIG).write_text(json.dumps(config, indent=1, allow_nan=False))
        (new / TENSORS).write_bytes(blob)


def _replaceable(path: Path) -> bool:
    """Check that nothing but a model, or nothing at all, is lost by replacing what is there."""
    if not path.is_dir() or contents(path) - set(FILES):
        return False
    try:
        return bool(json.loads(read_whole(path / CONFIG))["format"] == FORMAT["format"])
    except FileNotFoundError:
        return not contents(path)
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return False


def _digest(config: Mapping[str, Any]) -> str:
    """Compute the digest of a configuration; empty if that is not of JSON's values."""
    body = {key: value for key, value in config.items() if key != "digest"}
    try:
        text = json.dumps(body, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return ""
    return hashlib.sha256(text.encode()).hexdigest()


def load(
    path: str | Path, custom: abc.Sequence[type] = (), device: str | None = None
) -> TaskParameterizedGMM | Skill:
    """Read a model or a skill; nothing in its folder is executed.

    Parameters
    ----------
    path : str or Path
        Its folder, or that of a policy of type ``tpgmm``, which holds it.
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
    config, tensors = consistent(path, lambda: _read(path))
    try:
        on_device = {name: tensor.to(device) for name, tensor in tensors.items()}
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ModelFileError(
            f"{path} cannot be loaded onto the device {device!r}: "
            f'{str(error).partition(chr(10))[0]}. Use load(path, device="cpu")'
        ) from error
    return validate(decode(config.get("model"), custom, on_device))


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read configuration and tensors of a folder; refuse what was cut off or changed."""
    config = _parse(path / CONFIG, json.loads)
    if not isinstance(config, dict) or config.get("format") != FORMAT["format"]:
        kind = config.get("type") if isinstance(config, dict) else None
        if kind == "tpgmm":  # a TPGMMPolicy
            return _read(path / "model")
        hint = f": it is a LeRobot policy of type {kind!r}, opened by its from_pretrained(path)"
        raise ModelFileError(f"{path / CONFIG} describes no model{hint if kind else ''}")
    if config.get("version") != FORMAT["version"]:
        raise ModelFileError(
            f"{path} has format version {config.get('version')!r}, this release reads "
            f"{FORMAT['version']}: load it with the release that wrote it, or fit again"
        )
    if config.get("digest") != (_digest(config) or None):
        raise ModelFileError(f"{path / CONFIG} was changed after it was saved")
    blob = _parse(path / TENSORS, bytes)
    if config.get("tensors_sha256") != hashlib.sha256(blob).hexdigest():
        raise ModelFileError(f"{path / TENSORS} was cut off or changed after it was saved")
    return config, _parse(path / TENSORS, safetensors.torch.load)


def _parse[T](file: Path, parse: Callable[[bytes], T]) -> T:
    try:
        return parse(read_whole(file))
    except (FileNotFoundError, NotADirectoryError):
        hint = ". Give the folder, not a file in it" if file.parent.is_file() else ""
        message = f"{file.parent} is not a saved model: {file} is missing{hint}"
        raise ModelFileError(message) from None
    except (SafetensorError, KeyError, ValueError, OSError, RecursionError, MemoryError) as e:
        raise ModelFileError(f"{file} cannot be read: {e}") from e


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
) -> Skill:
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
    if isinstance(thing, float) and not math.isfinite(thing):
        return {"float": repr(float(thing))}
    if isinstance(thing, str | bool | int | float | None):
        return thing
    if isinstance(thing, abc.Sequence | np.ndarray):
        return [encode(each, tensors) for each in thing]
    if isinstance(thing, Mapping):
        return {"mapping": {str(key): encode(each, tensors) for key, each in thing.items()}}
    if isinstance(thing, Tensor) and tensors is not None:
        name = f"{len(tensors):04d}"
        tensors[name] = thing
        return {"tensor": name}
    return _describe(thing, tensors)


def _describe(thing: Any, tensors: dict[str, Tensor] | None) -> Any:
    """Describe an object by the name of its class and its fields."""
    if isinstance(thing, FunctionType | MethodType):
        raise ModelFileError(
            f"the Python function {thing.__name__!r} cannot be saved, no file brings code: use "
            "conditions by name ('arrived', 'held', ...), or make the sequence where it runs"
        )
    if isinstance(thing, np.generic):
        return encode(thing.item())
    name = type(thing).__name__
    if KNOWN.get(name, type(thing)) is not type(thing):
        raise ModelFileError(f"your class {name} has the name of a built-in one: rename it")
    if hasattr(thing, "config"):
        given = {"config": thing.config()}
        if not _digest(given):
            raise ModelFileError(f"config() of {name} gives more than JSON's values: {given}")
        return {"type": name} | given
    arguments = _list_arguments(thing).items()
    return {"type": name} | {key: encode(each, tensors) for key, each in arguments}


def _list_arguments(thing: Any) -> dict[str, Any]:
    """List the arguments that make a thing again."""
    if isinstance(thing, TaskParameterizedGMM):
        skill, parameters = thing.skill, thing.get_params(deep=False)
        if not isinstance(parameters["random_state"], int):
            parameters["random_state"] = None
        learned = {name: getattr(thing, f"{name}_") for name in LEARNED}
        return parameters | learned | {
            "n_components": len(thing.weights_),
            "operators": thing.operators_,
            "robot": thing.kinematics_,
            "learning": {name: getattr(thing, name) for name in LEARNING},
            "peaks": skill.peaks,
            "summary": skill.summary,
            "gaps": skill.gaps,
        }  # fmt: skip
    if is_dataclass(thing):
        names = [each.name for each in fields(thing) if each.metadata.get("saved", True)]
        return {name: getattr(thing, name) for name in names}
    raise ModelFileError(
        f"{type(thing).__name__} cannot be saved: make an operator a frozen dataclass, give a "
        "robot config() and a classmethod from_config()"
    )


def decode(
    description: Any,
    custom: abc.Sequence[type] = (),
    tensors: Mapping[str, Tensor] = MappingProxyType({}),
    entry: str = "model",
) -> Any:
    """Make a model or a part of it again, the inverse of :func:`encode`.

    Parameters
    ----------
    description : number, text, list or mapping
        What :func:`encode` gave.
    custom : sequence of type
        User-defined classes that may occur; no other code is ever looked up.
    tensors : mapping of str to Tensor, optional
        Those that were described, on the device where they are wanted.
    entry : str, default="model"
        How errors name it.

    Raises
    ------
    ModelFileError
        If a class is not known or does not take these fields.
    """
    try:
        return _read_entry(description, entry, custom, tensors)
    except ModelFileError:
        raise
    except Exception as error:  # of classes and shapes that do not go together, of any kind
        said = error if isinstance(error, TPGMMError) else repr(error)
        raise ModelFileError(f"the entry {entry!r} does not fit together: {said}") from error


def _read_entry(
    description: Any, entry: str, custom: abc.Sequence[type], tensors: Mapping[str, Tensor]
) -> Any:
    if isinstance(description, list):
        pairs = enumerate(description)
        return tuple(decode(one, custom, tensors, f"{entry}.{k}") for k, one in pairs)
    if not isinstance(description, Mapping):
        return description
    if "float" in description:
        return float(description["float"])
    if "tensor" in description:
        return tensors[description["tensor"]]
    if "config" in description:  # of a class, which reads it itself
        return _rebuild(dict(description), custom)
    fields = description.get("mapping", description).items()
    given = {key: decode(one, custom, tensors, f"{entry}.{key}") for key, one in fields}
    return given if "mapping" in description else _rebuild(given, custom)


def _rebuild(given: dict[str, Any], custom: abc.Sequence[type]) -> Any:
    """Make an object again from its class's name and its fields."""
    known = KNOWN | {kind.__name__: kind for kind in custom}
    name = given.pop("type", None)
    if name not in known:
        raise ModelFileError(
            f"the model uses the class {name!r}, which is not known here: pass it, "
            f"load(path, custom=[{name}]); known are {sorted(known)}"
        )
    kind: Any = known[name]
    if kind is TrainingSummary:  # it needs the robot of its model
        return partial(kind.from_config, given["config"])
    if "config" in given:
        return kind.from_config(given["config"])
    if (summary := given.get("summary")) is not None:
        given["summary"] = summary(given.get("robot") or given["kinematics"])
    made = REBUILT.get(kind, kind)(**given)
    if KNOWN.get(name) is kind:
        _check_fields(made, given)
    return made


def _check_fields(made: Any, given: Mapping[str, Any]) -> None:
    """Refuse fields of other types, and numbers that do not belong together, by their names."""
    hints = get_type_hints(type(made)) if is_dataclass(made) else {}
    for each in hints.keys() & given.keys():
        if not _fits(value := getattr(made, each), hints[each]):
            raise DataError(f"{each} is {str(value)[:60]!r}, not of the type {hints[each]}")
    if isinstance(made, TaskParameterizedGMM | Regression):
        skill = getattr(made, "skill", made)
        for name, value, shape in _numbers(skill):
            if value.dtype not in (torch.float32, torch.float64) or value.shape != shape:
                raise ShapeError(f"{name}: {value.dtype} of {tuple(value.shape)}, not {shape}")
            # their squares have to be finite in float32, too
            if not value.float().square().isfinite().all():
                raise DataError(f"{name} holds NaN, or numbers that are too large")
        ends = torch.tensor([-torch.inf, skill.begin, skill.end, torch.inf]).to(skill.time)
        if not (torch.cat((ends.diff(), skill.time.diff())) > 0).all():
            raise DataError("time does not increase from the skill's beginning to its end")


def _fits(value: Any, wanted: Any) -> bool:
    """Check that a value is of an annotated type."""
    origin, inner = get_origin(wanted) or wanted, get_args(wanted)
    if origin in (Union, UnionType):
        return any(_fits(value, each) for each in inner)
    if origin in (tuple, abc.Sequence):
        if not isinstance(value, tuple):
            return False
        any_number = origin is not tuple or inner[-1] is ...
        members = inner[:1] * len(value) if any_number else inner
        return len(members) == len(value) and all(map(_fits, value, members))
    return isinstance(value, ACCEPTED.get(origin, origin))


def _numbers(skill: Regression) -> Iterator[tuple[str, Tensor, tuple[int, ...]]]:
    """List names, values and wanted shapes of what a mixture computes with."""
    robot, count = skill.kinematics, len(skill.log_weights)
    yield "log_weights", skill.log_weights, (count,)
    yield "time", skill.time, (max(len(skill.time), 2),)
    for number, peak in enumerate(skill.peaks or ()):
        yield f"peaks.{number}", peak, (robot.n_joints,)
    if skill.gaps is not None:
        instants = len(skill.gaps.time)
        of_gaps = {"time": (instants,), "lag": (robot.n_joints,)}
        for name, value in vars(skill.gaps).items():
            yield f"gaps.{name}", value, of_gaps.get(name, (instants, robot.n_joints))
    if skill.motion_bounds is not None:
        yield "motion_bounds", torch.zeros_like(skill.motion_bounds.lower), (robot.n_joints,)
    for j, (one, operator) in enumerate(zip(skill.conditionals, skill.operators, strict=True)):
        size = operator.dimension(robot)
        shapes = (count, size), (count, size), (count, size, size), (count,), (count,)
        for (name, value), shape in zip(vars(one).items(), shapes, strict=True):
            yield f"{name} of operator {j}", value, shape
        gaussians.cholesky(one.covariance, f"the covariance of operator {j}")
        yield f"time_variance of operator {j}", one.time_variance.log(), (count,)


def validate[Model: (TaskParameterizedGMM, Skill)](model: Model) -> Model:
    """Validate a model or a skill by running it once; returns it.

    Parameters
    ----------
    model : TaskParameterizedGMM, or Skill

    Raises
    ------
    ModelFileError
        If it cannot be run.
    """
    try:
        skill = model.skill if isinstance(model, TaskParameterizedGMM) else model
        robot, times = skill.kinematics, skill.time[[0, len(skill.time) // 2, -1]]
        joints = torch.zeros_like(robot.lower).clamp(robot.lower, robot.upper)
        joints[list(robot.quaternion_starts)] = 1.0
        joints = joints.expand(len(times), -1)
        frames = {name: Frame(torch.zeros(3).to(joints)) for name in skill.frame_names}
        with torch.no_grad():
            skill.start(joints, frames).estimate(times, joints, frames)
    except Exception as error:
        raise ModelFileError(f"{str(model)[:60]} cannot be run: {error!r}") from error
    return model


def _estimator(learning: Mapping[str, Any], **given: Any) -> TaskParameterizedGMM:
    given["device"] = str(given["time"].device)
    model = TaskParameterizedGMM.from_parameters(**given)
    for name in LEARNING:
        setattr(model, name, learning[name])
    return model


def _regression(kinematics: Kinematics, time: Tensor, **given: Any) -> Regression:
    return Regression(kinematics.to(device=time.device), time=time, **given)


#: How classes are made that do not take their fields as they are.
REBUILT: dict[type, Callable[..., Any]] = {
    Stack: lambda operators: Stack(*operators),
    TaskParameterizedGMM: _estimator,
    Regression: _regression,
}

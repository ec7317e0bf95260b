"""Fitted models on disk: tensors as safetensors, everything else as JSON.

A model is a directory of ``config.json`` and ``model.safetensors``. It is written beside its
destination and moved there in one step, so an interrupted save leaves the old model or none.
Loading reads numbers and names, never code, and refuses whatever does not fit together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from tpgmm_torch import operators as builtin_operators
from tpgmm_torch.exceptions import ModelFileError
from tpgmm_torch.operators import Operator, Stack
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
]

#: How a model is written and read.
MODEL = Folder("model", 1)
TENSORS = MODEL.tensors
#: Beside the models of several modes, the folder that says how one of them is chosen.
MODES = "modes"
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
    {'type': 'RelativePosition', 'link': 'hand', 'frame': 'cup', 'held': False, ...}
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

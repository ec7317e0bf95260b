"""Task-parameterised Gaussian mixtures in PyTorch: robot skills from a few demonstrations."""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

# PyTorch and scikit-learn take seconds to load: what needs them is loaded when it is first
# asked for (PEP 562), so that `import tpgmm_torch` and `tpgmm --help` are quick.
if TYPE_CHECKING:
    from tpgmm_torch.data.demonstrations import Demonstration, Situation
    from tpgmm_torch.data.frames import Frame
    from tpgmm_torch.data.holds import Hold
    from tpgmm_torch.data.trajectories import Trajectory
    from tpgmm_torch.estimator import TaskParameterizedGMM
    from tpgmm_torch.operators import (
        AbsoluteOrientation,
        AbsolutePosition,
        Canonical,
        RelativeOrientation,
        RelativePosition,
        Stack,
    )
    from tpgmm_torch.persistence import load, save
    from tpgmm_torch.robots.robot import Robot
    from tpgmm_torch.skills.sequence import Sequence
    from tpgmm_torch.skills.via_points import ViaPoints
    from tpgmm_torch.skills.ways import Ways
    from tpgmm_torch.structure.select_components import SelectComponents
    from tpgmm_torch.structure.select_operators import SelectOperators
    from tpgmm_torch.training.hold_detection import attach_holds, find_holds

    __version__: str

__all__ = [
    "AbsoluteOrientation", "AbsolutePosition", "Canonical", "Demonstration", "Frame",
    "Hold", "RelativeOrientation", "RelativePosition", "Robot", "SelectComponents",
    "SelectOperators", "Sequence", "Situation", "Stack", "TaskParameterizedGMM",
    "Trajectory", "ViaPoints", "Ways", "attach_holds", "find_holds", "load", "save",
]  # fmt: skip

_HOMES = {
    "data.demonstrations": ("Demonstration", "Situation"),
    "estimator": ("TaskParameterizedGMM",),
    "data.frames": ("Frame",),
    "data.holds": ("Hold",),
    "operators": (
        "AbsoluteOrientation", "AbsolutePosition", "Canonical", "RelativeOrientation",
        "RelativePosition", "Stack",
    ),
    "persistence": ("load", "save"),
    "robots.robot": ("Robot",),
    "skills.sequence": ("Sequence",),
    "skills.via_points": ("ViaPoints",),
    "skills.ways": ("Ways",),
    "structure.select_components": ("SelectComponents",),
    "structure.select_operators": ("SelectOperators",),
    "data.trajectories": ("Trajectory",),
    "training.hold_detection": ("attach_holds", "find_holds"),
}  # fmt: skip
_HOME = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    """A public name, the version, or a module, loaded when it is first asked for."""
    value: object
    if name == "__version__":
        value = import_module("importlib.metadata").version("tpgmm-torch")
    elif name in _HOME:
        value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    elif not name.startswith("_") and find_spec(f"{__name__}.{name}"):
        return import_module(f"{__name__}.{name}")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Public names, whether or not they are loaded yet."""
    return sorted({*globals(), *__all__, "__version__"})

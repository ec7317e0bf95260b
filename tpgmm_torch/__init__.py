"""Task-parameterised Gaussian mixtures in PyTorch: robot skills from a few demonstrations."""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

# PyTorch and scikit-learn take seconds to load: what needs them is loaded when it is first
# asked for (PEP 562), so that `import tpgmm_torch` and `tpgmm --help` are quick.
if TYPE_CHECKING:
    from tpgmm_torch.demonstrations import Demonstration, Situation
    from tpgmm_torch.estimator import TaskParameterizedGMM
    from tpgmm_torch.frames import Frame
    from tpgmm_torch.kinematics import Kinematics, RobotState
    from tpgmm_torch.mixture import BlockGaussianMixture
    from tpgmm_torch.operators import (
        AbsoluteOrientation,
        AbsolutePosition,
        Canonical,
        Linearization,
        Operator,
        RelativeOrientation,
        RelativePosition,
        Stack,
    )
    from tpgmm_torch.poses import Poses
    from tpgmm_torch.regression import Estimate
    from tpgmm_torch.robots import Robot
    from tpgmm_torch.trajectories import Candidate, Trajectory

    __version__: str

__all__ = [
    "AbsoluteOrientation",
    "AbsolutePosition",
    "BlockGaussianMixture",
    "Candidate",
    "Canonical",
    "Demonstration",
    "Estimate",
    "Frame",
    "Kinematics",
    "Linearization",
    "Operator",
    "Poses",
    "RelativeOrientation",
    "RelativePosition",
    "Robot",
    "RobotState",
    "Situation",
    "Stack",
    "TaskParameterizedGMM",
    "Trajectory",
]

_HOMES = {
    "demonstrations": ("Demonstration", "Situation"),
    "estimator": ("TaskParameterizedGMM",),
    "frames": ("Frame",),
    "kinematics": ("Kinematics", "RobotState"),
    "mixture": ("BlockGaussianMixture",),
    "operators": (
        "AbsoluteOrientation",
        "AbsolutePosition",
        "Canonical",
        "Linearization",
        "Operator",
        "RelativeOrientation",
        "RelativePosition",
        "Stack",
    ),
    "poses": ("Poses",),
    "regression": ("Estimate",),
    "robots": ("Robot",),
    "trajectories": ("Candidate", "Trajectory"),
}
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
    """What there is to ask for, whether or not it is loaded yet."""
    return sorted({*globals(), *__all__, "__version__"})

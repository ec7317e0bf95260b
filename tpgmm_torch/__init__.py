"""Task-parameterised Gaussian mixtures in PyTorch: robot skills from a few demonstrations."""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

from tpgmm_torch.late import load_late

# PyTorch and scikit-learn take seconds to load: what needs them is loaded when it is first
# asked for (PEP 562), so that `import tpgmm_torch` and `tpgmm --help` are quick.
if TYPE_CHECKING:
    from tpgmm_torch.data.demonstrations import Demonstration as Demonstration
    from tpgmm_torch.data.demonstrations import Situation as Situation
    from tpgmm_torch.data.frames import Frame as Frame
    from tpgmm_torch.data.holds import Hold as Hold
    from tpgmm_torch.data.trajectories import Trajectory as Trajectory
    from tpgmm_torch.estimator import TaskParameterizedGMM as TaskParameterizedGMM
    from tpgmm_torch.operators import AbsoluteOrientation as AbsoluteOrientation
    from tpgmm_torch.operators import AbsolutePosition as AbsolutePosition
    from tpgmm_torch.operators import Canonical as Canonical
    from tpgmm_torch.operators import RelativeOrientation as RelativeOrientation
    from tpgmm_torch.operators import RelativePosition as RelativePosition
    from tpgmm_torch.operators import Stack as Stack
    from tpgmm_torch.persistence import load as load
    from tpgmm_torch.persistence import save as save
    from tpgmm_torch.robots.robot import Robot as Robot
    from tpgmm_torch.skills.sequence import Sequence as Sequence
    from tpgmm_torch.skills.via_points import ViaPoints as ViaPoints
    from tpgmm_torch.skills.ways import Ways as Ways
    from tpgmm_torch.structure.select_components import SelectComponents as SelectComponents
    from tpgmm_torch.structure.select_operators import SelectOperators as SelectOperators
    from tpgmm_torch.training.hold_detection import attach_holds as attach_holds
    from tpgmm_torch.training.hold_detection import find_holds as find_holds

    __version__: str

_HOMES = {
    ".data.demonstrations": ("Demonstration", "Situation"),
    ".estimator": ("TaskParameterizedGMM",),
    ".data.frames": ("Frame",),
    ".data.holds": ("Hold",),
    ".operators": (
        "AbsoluteOrientation",
        "AbsolutePosition",
        "Canonical",
        "RelativeOrientation",
        "RelativePosition",
        "Stack",
    ),
    ".persistence": ("load", "save"),
    ".robots.robot": ("Robot",),
    ".skills.sequence": ("Sequence",),
    ".skills.via_points": ("ViaPoints",),
    ".skills.ways": ("Ways",),
    ".structure.select_components": ("SelectComponents",),
    ".structure.select_operators": ("SelectOperators",),
    ".data.trajectories": ("Trajectory",),
    ".training.hold_detection": ("attach_holds", "find_holds"),
}
__all__ = sorted(name for names in _HOMES.values() for name in names)
_load, _list_names = load_late(globals(), _HOMES)


def __getattr__(name: str) -> object:
    """Load a public name, the version, or a module, when it is first asked for."""
    if name == "__version__":
        version = import_module("importlib.metadata").version("tpgmm-torch")
        return globals().setdefault(name, version)
    if name in __all__ or name.startswith("_") or not find_spec(f"{__name__}.{name}"):
        return _load(name)
    return import_module(f"{__name__}.{name}")


def __dir__() -> list[str]:
    """List public names, whether or not they are loaded yet."""
    return sorted({*_list_names(), "__version__"})

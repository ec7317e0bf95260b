"""What packages built on the toolkit bring to the command line, looked up as entry points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from tpgmm_torch.data.demonstrations import Demonstration
    from tpgmm_torch.large_data.processes import Processes

__all__ = ["Recordings", "model_format", "registered", "required"]

#: The groups. A command is a typer app or a function, added under its name.
COMMANDS = "tpgmm.commands"
#: A format writes a fitted model to a folder, told the :meth:`Recordings.signals`.
FORMATS = "tpgmm.formats"
#: A reader makes :class:`Recordings` of what ``options.recordings`` is told.
READERS = "tpgmm.readers"
#: A robot is a function that returns its URDF.
ROBOTS = "tpgmm.robots"
#: The format of ``TaskParameterizedGMM.save``, which is nobody's plugin.
OWN = "tpgmm"


class Recordings(Protocol):
    """A data set as the options of a command describe it."""

    def demonstrations(self) -> list[Demonstration]:
        """All episodes that are meant."""

    def batches(
        self, size: int, processes: Processes | None = None
    ) -> Iterable[Sequence[Demonstration]]:
        """The same in batches of ``size`` episodes; a share of them for each process."""

    def corrections(self) -> list[Demonstration]:
        """What a person did, where the set tells it from what a policy did."""

    def signals(self) -> Any:
        """Names, units and rate of states and actions: what a policy must know."""


def registered(group: str) -> dict[str, EntryPoint]:
    """The entry points of a ``group`` by name."""
    return {entry.name: entry for entry in entry_points(group=group)}


def required(group: str, name: str) -> Any:
    """What this distribution itself registers in ``group`` under ``name``.

    Raises
    ------
    DependencyError
        If it does not, because an older release is installed than is run.
    """
    from tpgmm_torch.exceptions import DependencyError

    entries = registered(group)
    if name not in entries:
        raise DependencyError(
            f"nothing that is installed registers {name!r} in {group!r}: install "
            "'tpgmm-torch[cli]' again"
        )
    return entries[name].load()


def model_format(name: str) -> Callable[[Any, Path, Any], None] | None:
    """What writes a model in the format ``name``; None for the estimator's own.

    Raises
    ------
    DataError
        If there is no such format.
    DependencyError
        If its plugin cannot be loaded.
    """
    from tpgmm_torch.exceptions import DataError, DependencyError

    if name == OWN:
        return None
    plugins = registered(FORMATS)
    if name not in plugins:
        raise DataError(
            f"format {name!r} is not known here; there are {sorted({OWN, *plugins})}. "
            "'lerobot' comes with the plugin: pip install lerobot_policy_tpgmm"
        )
    try:
        writer: Callable[[Any, Path, Any], None] = plugins[name].load()
    except ImportError as error:
        raise DependencyError(
            f"the plugin of format {name!r}, {plugins[name].value}, cannot be loaded: {error}"
        ) from error
    return writer

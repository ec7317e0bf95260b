"""Commands and model formats of other distributions, found by entry points."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

#: Group of commands: a typer app or a function, added under its name.
COMMANDS = "tpgmm.commands"
#: Group of formats: a function of a fitted model, a folder, and the data set's signals.
FORMATS = "tpgmm.formats"
#: The format of a model's own folder.
OWN = "tpgmm"


def find_plugins(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a ``group`` by name."""
    return {entry.name: entry for entry in entry_points(group=group)}


def load(plugin: EntryPoint) -> Any:
    """Load the object of a ``plugin``.

    Raises
    ------
    DependencyError
        If it cannot be imported.
    """
    try:
        return plugin.load()
    except Exception as error:  # whatever is wrong with it
        from tpgmm_torch.exceptions import DependencyError

        raise DependencyError(
            f"{plugin.name!r}, a plugin in {plugin.group!r}, cannot be loaded: "
            f"{type(error).__name__}: {error}"
        ) from error


def model_format(name: str) -> Callable[[Any, Path, Any], None] | None:
    """Return the function that writes a format, None for a model's own folder.

    Parameters
    ----------
    name : str
        Of the format.

    Raises
    ------
    DataError
        If there is no such format.
    DependencyError
        If its plugin cannot be loaded.
    """
    from tpgmm_torch.exceptions import DataError

    if name == OWN:
        return None
    formats = find_plugins(FORMATS)
    if name not in formats:
        raise DataError(
            f"format {name!r} is not known here; there are {sorted({OWN, *formats})}. "
            "'lerobot' comes with the plugin: pip install lerobot_policy_tpgmm"
        )
    writer: Callable[[Any, Path, Any], None] = load(formats[name])
    return writer

"""Other formats in which ``tpgmm fit`` writes a model, each brought by a plugin."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

__all__ = ["OWN", "writer"]

#: Each entry point is a function of the fitted model, the folder, and the
#: ``tpgmm_datasets.signals.Signals`` of the data set.
ENTRY_POINTS = "tpgmm.formats"
#: The estimator's own format, ``TaskParameterizedGMM.save``.
OWN = "tpgmm"

Writer = Callable[[Any, Path, Any], None]


def writer(name: str) -> Writer | None:
    """What writes a model in a format; None for the estimator's own.

    Parameters
    ----------
    name : str

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
    plugins = {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}
    if name not in plugins:
        raise DataError(
            f"format {name!r} is not known here; there are {sorted({OWN, *plugins})}. "
            "'lerobot' comes with the plugin: pip install lerobot_policy_tpgmm"
        )
    try:
        found: Writer = plugins[name].load()
    except ImportError as error:
        raise DependencyError(
            f"the plugin of format {name!r}, {plugins[name].value}, cannot be loaded: {error}"
        ) from error
    return found

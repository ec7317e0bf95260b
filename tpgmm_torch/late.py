"""Names of a package that are loaded when they are first asked for (PEP 562).

It needs nothing but the standard library: whoever imports a package should not wait.
"""

from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from typing import Any


def load_late(
    face: dict[str, Any], homes: Mapping[str, Iterable[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Make ``__getattr__`` and ``__dir__`` of a package.

    Parameters
    ----------
    face : dict
        The ``globals()`` of the package, in which names that were loaded are kept.
    homes : mapping of str to iterable of str
        The modules, absolute or seen from the package (``.reader``), and their public names.

    Returns
    -------
    tuple of two callable
        ``__getattr__`` and ``__dir__``.

    Examples
    --------
    >>> face = {"__name__": "tpgmm_torch"}
    >>> load, names = load_late(face, {".data.frames": ["Frame"]})
    >>> load("Frame").__name__, names()
    ('Frame', ['Frame', '__name__'])
    """
    package = face["__name__"]
    home = {name: module for module, names in homes.items() for name in names}

    def load(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        face[name] = getattr(import_module(home[name], package), name)
        return face[name]

    def list_names() -> list[str]:
        return sorted({*face, *home})

    return load, list_names

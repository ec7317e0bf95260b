"""Links to other projects without asking them: inventories made of ``docs/inventory.txt``.

Each line of that file is ``project role name``; the address follows from the project's own
pattern, or stands behind. ``python docs/_ext/inventories.py`` says whether the packages that
are installed have all of these objects.
"""

from __future__ import annotations

import importlib
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

__all__ = ["PROJECTS", "Entry", "entries", "missing", "write"]

TABLE = Path(__file__).parents[1] / "inventory.txt"
#: Where the pages of a project are, and which page of it has an object.
PROJECTS = {
    "python": ("https://docs.python.org/3/", ""),
    "numpy": ("https://numpy.org/doc/stable/", "reference/generated/{0}.html#{0}"),
    "pandas": ("https://pandas.pydata.org/docs/", "reference/api/{0}.html#{0}"),
    "matplotlib": ("https://matplotlib.org/stable/", "api/_as_gen/{0}.html#{0}"),
    "sklearn": ("https://scikit-learn.org/stable/", "modules/generated/{0}.html#{0}"),
    "torch": ("https://docs.pytorch.org/docs/stable/", "generated/{0}.html#{0}"),
}
HEADER = "# Sphinx inventory version 2\n# Project: {0}\n# Version: \n# zlib\n"


class Entry(NamedTuple):
    """An object of another project: ``role`` is ``class``, ``function``, ``method``, ..."""

    project: str
    role: str
    name: str
    page: str


def entries() -> Iterator[Entry]:
    """The lines of the table."""
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            project, role, name, *page = line.split()
            yield Entry(project, role, name, (page or [PROJECTS[project][1]])[0].format(name))


def missing() -> list[str]:
    """Names in the table that the installed packages do not have."""
    return [entry.name for entry in entries() if not _exists(entry.name)]


def _exists(name: str) -> bool:
    module, _, rest = name.partition(".")
    found = importlib.import_module(module) if rest else __builtins__
    for part in rest.split(".") if rest else [module]:
        try:
            found = found[part] if isinstance(found, dict) else getattr(found, part)
        except AttributeError:
            try:
                found = importlib.import_module(f"{found.__name__}.{part}")  # type: ignore[union-attr]
            except ImportError:
                return False
        except KeyError:
            return False
    return True


def write(folder: Path) -> dict[str, tuple[str, str]]:
    """Write an inventory per project; what ``intersphinx_mapping`` takes."""
    folder.mkdir(parents=True, exist_ok=True)
    mapping = {}
    for project, (site, _) in PROJECTS.items():
        own = [entry for entry in entries() if entry.project == project]
        lines = [f"{entry.name} py:{entry.role} 1 {entry.page} -\n" for entry in own]
        path = folder / f"{project}.inv"
        head = HEADER.format(project).encode()
        path.write_bytes(head + zlib.compress("".join(lines).encode()))
        mapping[project] = (site, str(path))
    return mapping


if __name__ == "__main__":
    absent = missing()
    print(f"not there: {absent}" if absent else "all objects of the table exist")
    raise SystemExit(bool(absent))

"""Directive ``internals``: every public name that no other page of the reference has."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, get_origin

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import lerobot_env_bimanual
import lerobot_policy_tpgmm
import tpgmm_datasets
import tpgmm_evaluation
import tpgmm_tools
import tpgmm_torch
import tpgmm_vision

__all__ = ["documented", "internal_names", "modules", "setup"]

PACKAGES = (
    tpgmm_torch,
    tpgmm_datasets,
    tpgmm_vision,
    tpgmm_tools,
    lerobot_policy_tpgmm,
    lerobot_env_bimanual,
    tpgmm_evaluation,
)
PAGES = Path(__file__).parents[1] / "api"
DIRECTIVE = re.compile(r"^\.\. auto(\w+):: ([\w.]+)\n((?:   .*\n)*)", re.MULTILINE)
CURRENT = re.compile(r"^\.\. currentmodule:: ([\w.]+)$", re.MULTILINE)
#: The command line has a page of its own, of its help.
NOT_CODE = (
    "tpgmm_tools.arguments",
    "tpgmm_tools.cli",
    "tpgmm_tools.app.command",
    "tpgmm_tools.cli",
    "tpgmm_evaluation.command",
    "tpgmm_evaluation.metaworld.__main__",
)


def modules() -> Iterator[ModuleType]:
    """All modules of the packages."""
    for package in PACKAGES:
        yield package
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not found.name.startswith(NOT_CODE):
                yield importlib.import_module(found.name)


def documented() -> set[str]:
    """Full names that the pages document, as written and as defined."""
    names = set()
    for page in PAGES.glob("*.rst"):
        text = page.read_text(encoding="utf-8")
        current = CURRENT.search(text)
        for kind, name, options in DIRECTIVE.findall(text):
            if kind == "summary":
                continue
            if kind == "module":
                wanted = re.search(r":members:(.*)", options)
                chosen = re.findall(r"\w+", wanted[1]) if wanted else []
                public = importlib.import_module(name).__all__
                members = (chosen or public) if wanted else ()
                full = {f"{name}.{member}" for member in members}
            else:
                full = {name if "." in name else f"{current[1] if current else ''}.{name}"}
            names |= full | {_home(*each.rpartition(".")[::2]) for each in full}
    return names


def _home(module: str, name: str) -> str:
    """Where a name is defined; for what does not know it (constants), where it is asked for."""
    value = getattr(importlib.import_module(module), name)
    home = getattr(value, "__module__", None)
    ours = isinstance(home, str) and home.startswith(tuple(p.__name__ for p in PACKAGES))
    return f"{home if ours else module}.{name}"


def internal_names() -> dict[str, list[str]]:
    """By module, the names that are left."""
    done = documented()
    constants = {id(_value(name)) for name in done}
    left: dict[str, list[str]] = {}
    for module in modules():
        for name in getattr(module, "__all__", ()):
            home = _home(module.__name__, name)
            if home in done or id(getattr(module, name)) in constants:
                continue
            if home == f"{module.__name__}.{name}":
                left.setdefault(module.__name__, []).append(name)
    return left


def _value(name: str) -> object:
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def _entry(module: str, name: str) -> list[str]:
    """How a name is documented."""
    value, full = getattr(importlib.import_module(module), name), f"{module}.{name}"
    if get_origin(value) is not None:  # of an alias of a type autodoc makes nothing
        return [f".. py:data:: {full}", "", f"   ``{value}``"]
    if inspect.isclass(value):
        return [f".. autoclass:: {full}", "   :members:"]
    if inspect.isroutine(value):
        return [f".. autofunction:: {full}"]
    return [f".. autodata:: {full}", "   :no-value:"]


class Internals(SphinxDirective):
    """The modules of a package, and their names."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Have the names documented by autodoc; ``internals = False`` leaves them out."""
        if not self.config.internals:
            return []
        lines = []
        package = self.arguments[0]
        for module, names in internal_names().items():
            if module.partition(".")[0] != package:
                continue
            lines += [f".. rubric:: {module}", ""]
            if not (set(importlib.import_module(module).__all__) - set(names)):
                lines += [f".. automodule:: {module}", ""]
            for name in names:
                lines += [*_entry(module, name), ""]
        node = nodes.container()
        self.state.nested_parse(StringList(lines, "internals"), self.content_offset, node)
        return node.children


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    app.add_config_value("internals", True, "env", bool)
    app.add_directive("internals", Internals)
    return {"parallel_read_safe": True}

"""Short names lead to the API reference: types in docstrings, and roles like :class:`Robot`."""

from __future__ import annotations

import sys
from typing import Any

from docutils import nodes
from numpydoc.xref import DEFAULT_LINKS
from public_names import PACKAGES, exists
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode

import tpgmm_control
import tpgmm_datasets
import tpgmm_torch

__all__ = ["setup"]

#: Modules of the core of which the data sets hand on a name.
HANDED_ON = {
    value.__module__
    for value in (getattr(tpgmm_datasets, name) for name in tpgmm_datasets.__all__)
    if getattr(value, "__module__", "").startswith("tpgmm_torch")
}


def _types(app: Sphinx, config: Config) -> None:
    """Names that numpydoc links where they stand as a type."""
    config.numpydoc_xref_aliases = (
        {name: name for name in DEFAULT_LINKS}  # nobody needs a link from "int"
        | {name: f"tpgmm_torch.{name}" for name in tpgmm_torch.__all__}
        | {name: f"tpgmm_control.{name}" for name in tpgmm_control.__all__}
        | {name: f"tpgmm_datasets.{name}" for name in tpgmm_datasets.__all__}
        | {"Tensor": "torch.Tensor"}
    )


def _by_last_part(
    app: Sphinx, env: BuildEnvironment, node: Any, text: nodes.TextElement
) -> nodes.Element | None:
    """The one object of the reference whose name ends like this."""
    if node.get("refdomain") != "py":
        return None
    domain = env.domains.python_domain
    targets = [node["reftarget"]]
    if node["reftype"] == "attr":
        targets.append(targets[0].rpartition(".")[0])  # fields are explained where classes are
    found: dict[str, Any] = {}
    while targets and not found:
        ending = f".{targets.pop(0)}"
        found = {
            name: entry
            for name, entry in domain.objects.items()
            if f".{name}".endswith(ending) and not entry.aliased
        }
    if len(found) != 1:
        return None
    [(name, entry)] = found.items()
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, [text], name)


def _not_public(
    app: Sphinx, env: BuildEnvironment, node: Any, text: nodes.TextElement
) -> nodes.Element | None:
    """Let names that exist in this project and are not public stand as text, without a link."""
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py" or exists(target):
        return text if node.get("refdomain") == "py" and target.startswith(PACKAGES) else None
    first, *rest = target.split(".")
    for name, module in list(sys.modules.items()):
        if name.startswith(PACKAGES) and hasattr(module, first):
            value = getattr(module, first)
            for part in rest:
                value = getattr(value, part, None)
            if value is not None:
                return text
    return None


def _other_name(app: Sphinx, document: nodes.document) -> None:
    """Let anchors answer to all names of an object, in its module and in packages around it.

    The source pages call all objects of a module alike: by a package if one of them is
    documented as the package's, by the module otherwise.
    """
    for signature in document.findall(addnodes.desc_signature):
        module, name = signature.get("module"), signature.get("fullname")
        if not module or not name:
            continue
        value = getattr(sys.modules.get(module), name.partition(".")[0], None)
        home = getattr(value, "__module__", None)
        place = home if isinstance(home, str) and home.startswith("tpgmm_") else module
        places = ["tpgmm_datasets"] if place in HANDED_ON else []
        while place:
            places.append(place)
            place = place.rpartition(".")[0]
        for other in (f"{place}.{name}" for place in places):
            if other not in document.ids:
                signature["ids"].append(other)
                document.ids[other] = signature


def _module_of_value(app: Sphinx, module: str, name: str) -> str | None:
    """The module that documents a value: it is not defined where its class is."""
    value = sys.modules.get(module)
    for part in name.split("."):
        value = getattr(value, part, None)
    code = hasattr(value, "__qualname__") or type(value).__module__ in ("builtins", "functools")
    return None if code else module


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    if "sphinx.ext.viewcode" in app.extensions:  # not in make docs-fast
        app.connect("viewcode-follow-imported", _module_of_value)
    app.connect("config-inited", _types, priority=100)  # before numpydoc
    app.connect("doctree-read", _other_name)
    app.connect("missing-reference", _by_last_part)
    app.connect("missing-reference", _not_public, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

"""The shape of the code: imports go one way, optional packages load late, names are explained.

Everything but the docstrings is read from the source, without importing it.
"""

import ast
import graphlib
import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

#: What each package may import, from the lowest on: a robot's skill is learned below and run
#: above, and nothing below the command line imports it.
PACKAGES: dict[str, tuple[str, ...]] = {
    "tpgmm_torch": (),
    "tpgmm_control": ("tpgmm_torch",),
    "tpgmm_datasets": ("tpgmm_torch",),
    "tpgmm_vision": ("tpgmm_torch", "tpgmm_datasets"),
    "lerobot_policy_tpgmm": ("tpgmm_torch", "tpgmm_control", "tpgmm_datasets", "tpgmm_vision"),
    "lerobot_env_bimanual": ("tpgmm_torch", "tpgmm_control", "tpgmm_datasets", "tpgmm_vision"),
    "tpgmm_tools": ("tpgmm_torch", "tpgmm_control", "tpgmm_datasets", "tpgmm_vision"),
    "tpgmm_evaluation": (
        "tpgmm_torch", "tpgmm_control", "tpgmm_datasets", "tpgmm_tools", "lerobot_policy_tpgmm",
        "lerobot_env_bimanual",
    ),
}  # fmt: skip

# The rooms of each package, floor by floor: a folder is a room, and so is a file beside the
# folders. A room may import from those on the floors before its own, and from no other.
ROOMS: dict[str, tuple[tuple[str, ...], ...]] = {
    "tpgmm_torch": (
        ("exceptions", "late"),
        ("atomic", "constraints", "quaternions", "gaussians"),
        ("data",),
        ("robots", "alignment", "mixture"),
        ("operators",),
        ("checks", "metrics", "motion"),
        ("training",),
        ("regression",),
        ("events", "skills"),
        ("estimator",),
        ("persistence", "structure"),
        ("hub",),
    ),
    "tpgmm_control": (
        ("impedance", "motion", "sensing"),
        ("obstacles", "contact"),
        ("loop",),
        ("torque",),
    ),
    "tpgmm_datasets": (
        ("errors", "least_squares"),
        ("names",),
        ("units", "robots", "table_columns"),
        ("checks",),
        ("events", "lerobot", "motors", "situation_files", "tables"),
        ("conversion",),
        ("description", "reader", "writer"),
        ("episode_batches", "signals"),
        ("bottle", "text"),
    ),
    "tpgmm_vision": (
        ("poses",),
        ("camera", "targets", "sources"),
        ("cell", "printing"),
        ("detection", "watching"),
        ("episodes",),
        ("calibration",),
    ),
    "tpgmm_tools": (
        ("plotting",),
        ("viewing", "paper"),
        ("report", "arguments"),
        ("cli",),
        ("app",),
    ),
    "lerobot_policy_tpgmm": (
        ("settings", "tick_durations"),
        ("configuration_tpgmm",),
        ("processor_tpgmm", "observations"),
        ("eyes",),
        ("dataset_contract", "policy_files", "training"),
        ("modeling_tpgmm",),
        ("lerobot_format", "async_server"),
    ),
    "lerobot_env_bimanual": (
        ("control_rate", "disturbances", "rendering"),
        ("base", "robot_scene"),
        ("eyes", "start"),
        ("controlled",),
        ("aloha", "bottle"),
        ("metaworld", "suite"),
        ("so101",),
        ("record",),
    ),
    "tpgmm_evaluation": (
        ("benchmarks", "policies", "processes", "variants"),
        ("cells",),
        ("baselines", "rollouts", "settings"),
        ("trainings",),
        ("jobs",),
        ("report",),
        ("compare", "metaworld"),
        ("command", "faults", "regressions"),
    ),
}
#: A face hands names on; every other file counts.
MOST_FILES_IN_A_ROOM = 11
COMMANDS = re.compile(r"\.(cli|arguments|app\.command)\b")  # parameters are explained by --help

# Loaded inside the functions that need them, so that `import tpgmm_torch` needs none.
LATE = {
    "collada",
    "gradio",
    "huggingface_hub",
    "lerobot",
    "matplotlib",
    "mink",
    "mujoco",
    "pandas",
    "pyarrow",
    "tpgmm_datasets",
    "trimesh",
    "viser",
}


def sources(folder: Path) -> dict[str, ast.Module]:
    """Syntax trees of a package by dotted module name; a package goes by its own name."""
    trees = {}
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(folder.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        trees[name] = ast.parse(path.read_text(encoding="utf-8"), str(path))
    return trees


FOLDERS = {
    "tpgmm_torch": ROOT / "tpgmm_torch",
    "tpgmm_control": ROOT / "control" / "tpgmm_control",
    "tpgmm_datasets": ROOT / "datasets" / "tpgmm_datasets",
    "tpgmm_vision": ROOT / "vision" / "tpgmm_vision",
    "tpgmm_tools": ROOT / "tools" / "tpgmm_tools",
    "lerobot_policy_tpgmm": ROOT / "policies" / "lerobot_policy_tpgmm",
    "lerobot_env_bimanual": ROOT / "environments" / "lerobot_env_bimanual",
    "tpgmm_evaluation": ROOT / "evaluation" / "tpgmm_evaluation",
}
SOURCES = {package: sources(folder) for package, folder in FOLDERS.items()}
CORE = SOURCES["tpgmm_torch"]
LIBRARY = CORE | SOURCES["tpgmm_control"]
TOOLS = SOURCES["tpgmm_tools"]
EVERY = {name: tree for package in SOURCES.values() for name, tree in package.items()}


def imported(module: str, nodes: Iterator[ast.AST]) -> Iterator[str]:
    """Dotted names that the import statements among ``nodes`` mention, made absolute."""
    is_package = any(name.startswith(f"{module}.") for name in EVERY)
    package = module if is_package else module.rpartition(".")[0]
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            dots = "." * node.level
            base = importlib.util.resolve_name(f"{dots}{node.module or ''}", package)
            yield from (f"{base}.{alias.name}" for alias in node.names)


def run_at_import(tree: ast.AST) -> Iterator[ast.AST]:
    """The nodes that run when a module is imported: no function bodies, no type checking."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        yield node
        yield from run_at_import(node)


def internal_imports(module: str) -> set[str]:
    """The modules of its own package that a module imports, wherever in its code."""
    package, found = SOURCES[module.partition(".")[0]], set()
    for name in imported(module, ast.walk(EVERY[module])):
        while name and name not in package:
            name = name.rpartition(".")[0]
        found |= {name} - {"", module}
    return found


def room(module: str) -> str:
    """``operators`` for ``tpgmm_torch.operators.stack``; empty for the package itself."""
    return module.partition(".")[2].partition(".")[0]


def arrows(package: str) -> set[tuple[str, str]]:
    """Pairs of rooms of which the first imports from the second."""
    found = {
        (room(module), room(target))
        for module in SOURCES[package].keys() - {package}
        for target in internal_imports(module)
    }
    return {(one, other) for one, other in found if one != other}


@pytest.mark.parametrize("package", ROOMS)
def test_the_rooms_are_those_of_the_plan(package):
    planned = [name for floor in ROOMS[package] for name in floor]
    there = {room(module) for module in SOURCES[package]} - {""}
    assert sorted(planned) == sorted(there), "add the room to ROOMS, on the floor it needs"


@pytest.mark.parametrize("package", ROOMS)
def test_rooms_import_downwards_only(package):
    floors = {name: at for at, floor in enumerate(ROOMS[package]) for name in floor}
    wrong = [
        f"{one} imports from {other or 'the package itself'}, which is not below it"
        for one, other in sorted(arrows(package))
        if floors.get(other, len(floors)) >= floors.get(one, -1)
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("package", ROOMS)
def test_there_is_no_import_cycle(package):
    graph = {module: internal_imports(module) for module in SOURCES[package]}
    graphlib.TopologicalSorter(graph).prepare()


@pytest.mark.parametrize("package", ROOMS)
def test_rooms_are_small(package):
    counts: dict[Path, list[str]] = {}
    for path in FOLDERS[package].rglob("*.py"):
        if path.name != "__init__.py" and path.parent != FOLDERS[package]:
            counts.setdefault(path.parent, []).append(path.name)
    crowded = {
        str(at.name): len(n) for at, n in counts.items() if len(n) > MOST_FILES_IN_A_ROOM
    }
    assert counts and not crowded, f"too many files in one room: {crowded}"


def test_nothing_private_of_scikit_learn_is_used():
    # its private modules move and change without notice
    wrong = [
        f"{module} imports {name}"
        for module, tree in EVERY.items()
        for name in imported(module, ast.walk(tree))
        if name.startswith("sklearn.") and "._" in name
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("package", SOURCES)
def test_modules_list_the_names_that_the_reference_documents(package):
    sys.path.insert(0, str(ROOT / "docs" / "_ext"))
    try:
        documented = importlib.import_module("public_names").documented()
    finally:
        sys.path.pop(0)
    wrong = []
    for module in SOURCES[package]:
        loaded = importlib.import_module(module)
        if Path(str(loaded.__file__)).name != "__init__.py":  # a face hands names on
            wrong += [
                f"{module}.{name} is in __all__, and on no page of the API reference"
                for name in getattr(loaded, "__all__", ())
                if f"{module}.{name}" not in documented
            ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("package", SOURCES)
def test_packages_import_those_below_alone(package):
    wrong = [
        f"{module} imports {name}"
        for module, tree in SOURCES[package].items()
        for name in imported(module, ast.walk(tree))
        if name.partition(".")[0] in SOURCES.keys() - {package, *PACKAGES[package]}
    ]
    assert not wrong, "\n".join(wrong)


def names_used(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Modules and names of ``from module import name``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)


def test_no_private_name_is_used_across_packages():
    wrong = [
        f"{module} uses {source}.{name}"
        for module, tree in EVERY.items()
        for source, name in names_used(tree)
        if source.partition(".")[0] in SOURCES
        and source.partition(".")[0] != module.partition(".")[0]
        and (name.startswith("_") or "._" in source)
    ]
    assert not wrong, "\n".join(wrong)


def private_names(tree: ast.AST) -> Iterator[str]:
    """Those that a module defines: functions, classes, variables, fields, attributes."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name


def private_uses(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Objects other than ``self`` and the like, and an underscored attribute of theirs."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and re.match(r"_(?!_)", node.attr):
            target = ast.unparse(node.value)
            if target not in ("self", "cls", "super()"):
                yield target, node.attr


@pytest.mark.parametrize("package", [name for name in SOURCES if name != "tpgmm_torch"])
def test_no_private_attribute_of_another_package_is_used(package):
    trees = SOURCES[package]
    ours = {name for tree in trees.values() for name in private_names(tree)}
    ours |= {"_asdict", "_replace", "_exit"}  # public, of named tuples and ``os``
    wrong = [
        f"{module} uses {target}.{name}"
        for module, tree in trees.items()
        for target, name in private_uses(tree)
        if name not in ours
    ]
    assert not wrong, "\n".join(wrong)


def test_optional_packages_are_not_imported_at_module_level():
    wrong = [
        f"{module} imports {name} at module level; do it in the function that needs it"
        for module, tree in LIBRARY.items()
        for name in imported(module, run_at_import(tree))
        if name.partition(".")[0] in LATE
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "package",
    ["tpgmm_torch", "tpgmm_control", "tpgmm_datasets", "tpgmm_tools", "tpgmm_vision"],
)
def test_lerobot_is_imported_nowhere(package):
    wrong = [
        module
        for module, tree in SOURCES[package].items()
        for name in imported(module, ast.walk(tree))
        if name.partition(".")[0] == "lerobot"
    ]
    assert not wrong


def test_every_module_can_be_imported_where_no_optional_package_is_installed():
    # scikit-learn loads pandas itself where there is one, so looking afterwards would not do
    script = f"""
import importlib, sys
sys.modules.update(dict.fromkeys({LATE}))  # None: importing it raises ImportError
for module in {sorted(LIBRARY)}:
    importlib.import_module(module)
"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr


def undocumented(name: str, value: object) -> Iterator[str]:
    """What the docstring of a public function or class, or of its methods, leaves out."""
    own = value.__doc__ or ""
    if not own or own.startswith(f"{value.__name__}("):  # dataclass writes such a one
        yield f"{name} has no docstring"
        return
    bases = inspect.getmro(value)[1:] if inspect.isclass(value) else ()
    documentation = "\n".join([own, *(base.__doc__ or "" for base in bases)])
    try:
        parameters = inspect.signature(value).parameters.values()
    except ValueError:  # builtin exceptions have no signature
        parameters = ()
    for parameter in parameters:
        variadic = parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        if not variadic and not re.search(rf"\b{parameter.name}\b", documentation):
            yield f"{name} does not explain {parameter.name}"
    for member in vars(value) if inspect.isclass(value) else ():
        method = getattr(value, member)
        if not member.startswith("_") and callable(method) and not inspect.getdoc(method):
            yield f"{name}.{member} has no docstring"


@pytest.mark.parametrize(
    # the help of commands explains their options
    "module",
    [*LIBRARY, *(name for name in TOOLS if not COMMANDS.search(name)), "tpgmm_datasets"],
)
def test_names_without_an_underscore_are_explained(module):
    loaded = importlib.import_module(module)
    assert loaded.__doc__, f"{module} has no docstring"
    public = getattr(loaded, "__all__", ())  # those that the API reference documents
    assert len(set(public)) == len(public)
    assert [name for name in public if not hasattr(loaded, name)] == []
    wrong = []
    for name, value in vars(loaded).items():
        here = getattr(value, "__module__", None) == module and not name.startswith("_")
        if here and (inspect.isfunction(value) or inspect.isclass(value)):
            wrong += undocumented(f"{module}.{name}", value)
    assert not wrong, "\n".join(wrong)

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

ROOT = Path(__file__).parents[1]

# From left to right: a module may import what stands before it, and nothing else of the
# package. A sub-package (operators) is one module here.
LAYERS = (
    ("exceptions", "distributed", "prefetch", "rows", "spool", "instants", "storage"),
    ("quaternions", "gaussians"),
    ("frames", "demonstrations", "trajectories"),
    ("urdf", "trees", "forward_kinematics", "kinematics", "robots", "poses", "joint_space"),
    ("operators", "warping", "features", "retiming", "alignment", "local_data"),
    ("block_gaussians", "column_moments", "points", "row_points", "sufficient_statistics"),
    (
        "gate",
        "expectation",
        "degenerate",
        "expectation_maximization",
        "time_bins",
        "given_start",
        "initialization",
        "checkpoints",
        "learning",
        "mixture_density",
        "mixture",
    ),
    (
        "local_mixtures",
        "windows",
        "component_tables",
        "corrections",
        "task_update",
        "projections",
        "joint_limits",
        "regression",
        "compiled_update",
        "compiled",
        "rollout",
        "reproduction",
    ),
    ("persistence", "situations"),
    ("likelihood", "preparation", "demonstration_batches", "estimator"),
    ("metrics", "cross_validation", "plotting", "viewing"),
    ("cli",),
)
ORDER = [module for layer in LAYERS for module in layer]

# Loaded inside the functions that need them, so that `import tpgmm_torch` needs none.
LATE = {
    "dtaidistance",
    "lerobot",
    "matplotlib",
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


CORE = sources(ROOT / "tpgmm_torch")
DATA_SETS = sources(ROOT / "datasets" / "tpgmm_datasets")


def imported(module: str, nodes: Iterator[ast.AST]) -> Iterator[str]:
    """Dotted names that the import statements among ``nodes`` mention, made absolute."""
    is_package = any(name.startswith(f"{module}.") for name in CORE)
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
    """The modules of the core that a module of the core imports, wherever in its code."""
    found = set()
    for name in imported(module, ast.walk(CORE[module])):
        while name and name not in CORE:
            name = name.rpartition(".")[0]
        found |= {name} - {""}
    return found


def layer(module: str) -> str:
    """``operators`` for ``tpgmm_torch.operators.stack``; empty for the package itself."""
    return module.partition(".")[2].partition(".")[0]


def rank(module: str) -> int:
    """Place in the table from the left; to the right of all if it has none."""
    return ORDER.index(layer(module)) if layer(module) in ORDER else len(ORDER)


def test_every_module_stands_in_the_table():
    unknown = sorted({layer(module) for module in CORE} - {"", *ORDER})
    assert not unknown, f"not in the table of layers: {unknown}; add it to the table, ORDER"


def test_imports_point_from_right_to_left_only():
    wrong = []
    for module in CORE.keys() - {"tpgmm_torch"}:
        for target in internal_imports(module):
            if layer(target) == layer(module):
                continue
            if target == "tpgmm_torch":
                wrong.append(f"{module} imports from the package itself; name the module")
            elif rank(target) > rank(module):
                wrong.append(f"{module} imports {target}, which stands to its right")
    assert not wrong, "\n".join(sorted(wrong))


def test_there_is_no_import_cycle():
    graph = {module: internal_imports(module) for module in CORE}
    graphlib.TopologicalSorter(graph).prepare()


def test_optional_packages_are_not_imported_at_module_level():
    wrong = [
        f"{module} imports {name} at module level; do it in the function that needs it"
        for module, tree in CORE.items()
        for name in imported(module, run_at_import(tree))
        if name.partition(".")[0] in LATE
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("package", [CORE, DATA_SETS], ids=["tpgmm_torch", "tpgmm_datasets"])
def test_lerobot_is_imported_nowhere(package):
    wrong = [
        module
        for module, tree in package.items()
        for name in imported(module, ast.walk(tree))
        if name.partition(".")[0] == "lerobot"
    ]
    assert not wrong


def test_every_module_can_be_imported_where_no_optional_package_is_installed():
    # scikit-learn loads pandas itself where there is one, so looking afterwards would not do
    script = f"""
import importlib, sys
sys.modules.update(dict.fromkeys({LATE}))  # None: importing it raises ImportError
for module in {sorted(CORE)}:
    importlib.import_module(module)
"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr


def test_no_file_is_longer_than_400_lines():
    folders = ("tpgmm_torch", "datasets", "policies", "benchmarks", "tests", "examples", "docs")
    lengths = {
        str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines())
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
    }
    assert "tpgmm_torch/quaternions.py" in lengths
    assert {name: length for name, length in lengths.items() if length > 400} == {}


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


@pytest.mark.parametrize("module", [*CORE, "tpgmm_datasets"])
def test_public_names_exist_and_are_explained(module):
    loaded = importlib.import_module(module)
    assert loaded.__doc__, f"{module} has no docstring"
    assert len(set(loaded.__all__)) == len(loaded.__all__)
    wrong = []
    for name in loaded.__all__:
        value = getattr(loaded, name)
        if inspect.isfunction(value) or inspect.isclass(value):
            wrong += undocumented(f"{module}.{name}", value)
    assert not wrong, "\n".join(wrong)

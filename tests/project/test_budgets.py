"""Sizes of the packages, and of what is in them, stay within their budgets.

Lines of code are lines that are not blank, no comment and no docstring. Complexity is
cyclomatic, as radon counts it.
"""

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cache
from itertools import chain
from pathlib import Path

import pytest
from lerobot.configs import PreTrainedConfig
from radon.complexity import cc_visit

import tpgmm_control
import tpgmm_torch
from lerobot_policy_tpgmm import TPGMMConfig

ROOT = Path(__file__).parents[2]
FOLDERS = {
    "tpgmm_torch": "tpgmm_torch",
    "tpgmm_control": "control",
    "tpgmm_datasets": "datasets",
    "tpgmm_vision": "vision",
    "tpgmm_tools": "tools",
    "lerobot_policy_tpgmm": "policies",
    "lerobot_env_bimanual": "environments",
    "tpgmm_evaluation": "evaluation",
    "benchmarks": "benchmarks",
    "tests": "tests",
}
#: The layers that a robot runs, held closer than the rest.
LEARN, RUN = "tpgmm_torch", "tpgmm_control"
ELSEWHERE = tuple(name for name in FOLDERS if name not in (LEARN, RUN, "tests"))
MOST_COMPLEX, LONGEST = 10, 60
PARTICIPLE = re.compile(r"_?[a-z]+(ed|own)")
NO_VERB = re.compile(r"(What|Which|Where|Of|How|Whether)\b")

BUDGETS = {
    "lines of tpgmm_torch": 9500,
    "lines of tpgmm_control": 3800,
    "lines of tpgmm_datasets": 4300,
    "lines of tpgmm_vision": 2500,
    "lines of tpgmm_tools": 2900,
    "lines of lerobot_policy_tpgmm": 1700,
    "lines of lerobot_env_bimanual": 4400,
    "lines of tpgmm_evaluation": 3800,
    "lines of benchmarks": 1300,
    "lines of tests": 28000,
    "complex functions of learn": 0,
    "complex functions of run": 0,
    "complex functions elsewhere": 20,
    "longest function of learn": LONGEST,
    "longest function of run": LONGEST,
    "most parameters of learn and run": 12,
    "participles of learn": 0,
    "participles of run": 0,
    "participles elsewhere": 0,
    "first lines without a verb in learn": 0,
    "first lines without a verb in run": 0,
    "first lines without a verb elsewhere": 0,
    "named numeric constants of learn": 60,
    "named numeric constants of run": 20,
    "fields of a state of run": 12,
    "modules behind the estimator": 60,
    "names in tpgmm_torch.__all__": 25,
    "names in tpgmm_control.__all__": 10,
    "public names": 200,
    "fields of TPGMMConfig": 30,
    "lines of TaskParameterizedGMM": 250,
    "parameters of TaskParameterizedGMM": 16,
    "imports of the estimator's module from learn": 16,
}


@dataclass(frozen=True)
class Ceiling:
    """A value above its budget, and the version in which the budget must be met."""

    value: int
    until: str


#: Lower them with the code; an entry goes when its budget is reached.
CEILINGS: dict[str, Ceiling] = {
    "lines of tpgmm_torch": Ceiling(12261, "0.4.0"),
    "lines of tpgmm_control": Ceiling(4717, "0.4.0"),
    "lines of tpgmm_datasets": Ceiling(4547, "0.4.0"),
    "lines of tpgmm_vision": Ceiling(2555, "0.4.0"),
    "lines of tpgmm_tools": Ceiling(3377, "0.4.0"),
    "lines of lerobot_env_bimanual": Ceiling(5313, "0.4.0"),
    "lines of tpgmm_evaluation": Ceiling(4796, "0.4.0"),
    "lines of benchmarks": Ceiling(1556, "0.4.0"),
    "lines of tests": Ceiling(35032, "0.4.0"),
    # the loop will be rewritten for one robot
    "complex functions of run": Ceiling(6, "0.4.0"),
    "participles of run": Ceiling(34, "0.4.0"),
    "first lines without a verb in run": Ceiling(40, "0.4.0"),
    "named numeric constants of run": Ceiling(80, "0.4.0"),
    "most parameters of learn and run": Ceiling(15, "0.4.0"),  # Controller
    "named numeric constants of learn": Ceiling(89, "0.4.0"),
}


class Source:
    """A file, read once."""

    def __init__(self, path: Path):
        self.text = path.read_text(encoding="utf-8")
        self.tree = ast.parse(self.text)

    @property
    def lines(self) -> int:
        """Number of lines of code."""
        return len(self._code())

    def length(self, function: ast.FunctionDef) -> int:
        """Number of lines of code of a function."""
        return len(self._code() & {*range(function.lineno, function.end_lineno + 1)})

    @cache  # noqa: B019  # sources are as many as files
    def _code(self) -> set[int]:
        documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        docstrings: set[int] = set()
        for node in ast.walk(self.tree):
            if (
                isinstance(node, documented)
                and ast.get_docstring(node, clean=False) is not None
            ):
                docstrings |= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
        return {
            number
            for number, line in enumerate(self.text.splitlines(), 1)
            if line.strip() and not line.strip().startswith("#") and number not in docstrings
        }

    def functions(self) -> Iterator[ast.FunctionDef]:
        """Functions and methods, however deep."""
        return (node for node in ast.walk(self.tree) if isinstance(node, ast.FunctionDef))

    def parameters(self) -> Iterator[int]:
        """Numbers of parameters, but of estimators' constructors: those are settings."""
        settings = {
            part
            for node in ast.walk(self.tree)
            if isinstance(node, ast.ClassDef)
            and any(isinstance(p, ast.FunctionDef) and p.name == "fit" for p in node.body)
            for part in node.body
            if isinstance(part, ast.FunctionDef) and part.name == "__init__"
        }
        return (_parameters(each) for each in self.functions() if each not in settings)

    def complex_functions(self) -> Iterator[str]:
        """Names of functions above radon's complexity 10."""
        for block in cc_visit(self.text):  # methods stand beside their class
            if not hasattr(block, "methods") and block.complexity > MOST_COMPLEX:
                yield f"{block.name}: {block.complexity}"

    def constants(self) -> Iterator[str]:
        """Names in capitals that the module sets to a number."""
        for node in self.tree.body:
            if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
                continue
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                yield from _numbers(target, node.value)


def _numbers(target: ast.expr, value: ast.expr) -> Iterator[str]:
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        for name, part in zip(target.elts, value.elts, strict=True):
            yield from _numbers(name, part)
    elif isinstance(target, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z\d_]*", target.id):
        arithmetic = (ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop)
        if all(
            isinstance(node, arithmetic)
            or (isinstance(node, ast.Constant) and type(node.value) in (int, float))
            for node in ast.walk(value)
        ):
            yield target.id


def _parameters(function: ast.FunctionDef) -> int:
    given = function.args
    names = {each.arg for each in chain(given.posonlyargs, given.args, given.kwonlyargs)}
    return len(names - {"self", "cls"})


def _state_fields(source: Source) -> Iterator[int]:
    """Yield the number of fields of each dataclass."""
    for node in ast.walk(source.tree):
        if isinstance(node, ast.ClassDef) and "dataclass" in ast.unparse(
            ast.Tuple(node.decorator_list, ast.Load())
        ):
            yield sum(isinstance(part, ast.AnnAssign) for part in node.body)


SOURCES = {
    name: [Source(path) for path in sorted((ROOT / folder).rglob("*.py"))]
    for name, folder in FOLDERS.items()
}


def found(measure: str, packages: tuple[str, ...]) -> list[str]:
    """Functions of packages that break a rule."""
    every = [source for name in packages for source in SOURCES[name]]
    if measure == "complex functions":
        return [name for source in every for name in source.complex_functions()]
    functions = [function for source in every for function in source.functions()]
    if measure == "participles":
        return [each.name for each in functions if PARTICIPLE.fullmatch(each.name)]
    return [each.name for each in functions if NO_VERB.match(ast.get_docstring(each) or "")]


def _public_names() -> int:
    sys.path.insert(0, str(ROOT / "docs" / "_ext"))
    try:
        return len(importlib.import_module("public_names").public_names())
    finally:
        sys.path.pop(0)


def _modules_behind_the_estimator() -> int:
    script = (
        "import sys; from tpgmm_torch import TaskParameterizedGMM;"
        "ours = [m for name, m in sys.modules.items() if name.startswith('tpgmm_')];"
        "print(sum(not hasattr(m, '__path__') for m in ours))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True
    )
    return int(done.stdout)


def _estimator() -> Mapping[str, int]:
    source = Source(ROOT / "tpgmm_torch" / "estimator.py")
    [definition] = [
        node
        for node in source.tree.body
        if isinstance(node, ast.ClassDef) and node.name == "TaskParameterizedGMM"
    ]
    [made] = [
        node
        for node in definition.body
        if isinstance(node, ast.FunctionDef) and node.name == "__init__"
    ]
    imports = {
        node.module
        for node in ast.walk(source.tree)
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("tpgmm_torch.")
    }
    return {
        "lines of TaskParameterizedGMM": source.lines,  # the file is the class
        "parameters of TaskParameterizedGMM": _parameters(made),
        "imports of the estimator's module from learn": len(imports),
    }


@pytest.fixture(scope="module")
def measures() -> Mapping[str, int]:
    """What is measured, by the names of the budgets."""
    parts = {"learn": (LEARN,), "run": (RUN,), "elsewhere": ELSEWHERE}
    counted = {
        f"{measure} {'' if where == 'elsewhere' else preposition}{where}": len(
            found(measure, packages)
        )
        for measure, preposition in (
            ("complex functions", "of "),
            ("participles", "of "),
            ("first lines without a verb", "in "),
        )
        for where, packages in parts.items()
    }
    longest = {
        f"longest function of {where}": max(
            s.length(f) for s in SOURCES[name] for f in s.functions()
        )
        for where, name in (("learn", LEARN), ("run", RUN))
    }
    constants = {
        f"named numeric constants of {where}": sum(len([*s.constants()]) for s in SOURCES[name])
        for where, name in (("learn", LEARN), ("run", RUN))
    }
    ours = {field.name for field in fields(TPGMMConfig)} - {
        field.name for field in fields(PreTrainedConfig)
    }
    lines = {
        f"lines of {name}": sum(source.lines for source in sources)
        for name, sources in SOURCES.items()
    }
    return {
        **lines, **counted, **longest, **constants, **_estimator(),
        "most parameters of learn and run": max(
            n for name in (LEARN, RUN) for s in SOURCES[name] for n in s.parameters()
        ),
        "fields of a state of run": max(n for s in SOURCES[RUN] for n in _state_fields(s)),
        "modules behind the estimator": _modules_behind_the_estimator(),
        "names in tpgmm_torch.__all__": len(tpgmm_torch.__all__),
        "names in tpgmm_control.__all__": len(tpgmm_control.__all__),
        "public names": _public_names(),
        "fields of TPGMMConfig": len(ours),
    }  # fmt: skip


@pytest.mark.parametrize("name", BUDGETS)
def test_budgets_are_kept(name, measures):
    limit = CEILINGS[name].value if name in CEILINGS else BUDGETS[name]
    assert measures[name] <= limit, f"{name}: {measures[name]}, at most {limit}"


def test_everything_measured_has_its_budget(measures):
    assert measures.keys() == BUDGETS.keys()


def test_ceilings_go_when_their_budget_is_reached(measures):
    done = [name for name in CEILINGS if measures[name] <= BUDGETS[name]]
    assert done == [], "delete these from CEILINGS"


def test_a_ceiling_names_a_version_that_is_to_come():
    import importlib.metadata

    from packaging.version import Version

    now = Version(importlib.metadata.version("tpgmm-torch"))
    overdue = [name for name, ceiling in CEILINGS.items() if Version(ceiling.until) <= now]
    assert overdue == [], "their budgets must be met in this version"

"""`import tpgmm_torch` loads next to nothing, and yet every public name is there."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import tpgmm_torch


def fresh(script: str) -> str:
    """What a new interpreter prints."""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_the_package_loads_nothing_heavy():
    script = "import sys, tpgmm_torch; print({'torch', 'sklearn', 'numpy'} & set(sys.modules))"
    assert fresh(script) == "set()\n"


def test_each_name_comes_from_where_type_checkers_are_told():
    tree = ast.parse(Path(tpgmm_torch.__file__).read_text(encoding="utf-8"))
    [checked] = (one for one in tree.body if isinstance(one, ast.If))
    named = {
        alias.name: node.module
        for node in ast.walk(checked)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert sorted(named) == sorted(tpgmm_torch.__all__)
    for name, module in named.items():
        assert getattr(tpgmm_torch, name) is getattr(sys.modules[module], name)


def test_dir_names_what_is_not_loaded_yet():
    script = "import tpgmm_torch; print(*dir(tpgmm_torch))"
    assert {*tpgmm_torch.__all__, "__version__"} <= set(fresh(script).split())


def test_modules_are_attributes_without_being_imported():
    script = "import tpgmm_torch; print(tpgmm_torch.quaternions.__name__)"
    assert fresh(script) == "tpgmm_torch.quaternions\n"


@pytest.mark.parametrize("name", ["nothing", "_nothing", "__nothing__"])
def test_other_names_do_not_exist(name):
    with pytest.raises(AttributeError, match=f"'tpgmm_torch' has no attribute '{name}'"):
        getattr(tpgmm_torch, name)

"""The command ``tpgmm`` as a whole: version, help, and that both are quick."""

import re
import subprocess
import sys
from importlib.metadata import version

import pytest

from tests.support.command_line import output


def test_version_and_help_need_no_command():
    assert output("--version") == f"tpgmm-torch {version('tpgmm-torch')}\n"
    for arguments in ((), ("--help",)):
        text = output(*arguments)
        listed = re.findall(r"^│ (\w+)", text.partition("Commands")[2], re.MULTILINE)
        assert listed[:8] == [
            "demo", "fit", "correct", "reproduce", "plot", "view", "app", "dataset"
        ]  # fmt: skip
        assert "Run the paper's experiment" in text


@pytest.mark.parametrize(
    "command",
    ["demo", "fit", "correct", "reproduce", "plot", "view", "app"]
    + [f"dataset {name}" for name in ("info", "check", "plot", "generate", "convert")],
)
def test_the_help_of_every_command_has_an_example(command):
    assert f"Example: tpgmm {command}" in output(*command.split(), "--help")


def test_help_needs_none_of_the_heavy_packages():
    script = """
import sys
from tpgmm_tools.cli.application import app
app(["--help"], standalone_mode=False)
heavy = {"torch", "sklearn", "pandas", "pyarrow", "matplotlib", "lerobot"} & set(sys.modules)
sys.exit(f"{sorted(heavy)} are imported" if heavy else 0)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr

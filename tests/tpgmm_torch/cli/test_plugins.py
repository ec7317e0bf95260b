"""Commands that other distributions add to ``tpgmm``."""

from importlib.metadata import EntryPoint

import pytest
import typer

from tests.support.command_line import output, run
from tpgmm_torch.cli import commands, formats
from tpgmm_torch.exceptions import DataError, DependencyError


def greet(name: str = "you") -> None:
    """Greet."""
    typer.echo(f"hello {name}")


greeting = typer.Typer()
greeting.command()(greet)
nonsense = 1


@pytest.fixture
def plugins(monkeypatch):
    entries = {"greet": "greet", "welcome": "greeting", "odd": "nonsense", "gone": "absent"}
    found = [
        EntryPoint(name, f"{__name__}:{value}", commands.ENTRY_POINTS)
        for name, value in entries.items()
    ]
    found.append(EntryPoint("fit", f"{__name__}:greet", commands.ENTRY_POINTS))
    monkeypatch.setattr(commands, "entry_points", lambda group: found)


def test_plugins_add_commands(plugins):
    for name in ("greet", "welcome"):
        assert output(name, "--name", "me") == "hello me\n"
    assert "Learn a skill" in output("fit", "--help")


def test_help_names_the_commands_of_plugins_without_importing_any(plugins):
    result = run("--help")
    assert result.exit_code == 0
    assert result.stderr == ""
    unwrapped = " ".join(result.stdout.replace("│", " ").split())
    for name in ("greet", "welcome", "odd", "gone"):
        assert f"tpgmm {name} --help" in unwrapped
    assert "Greet." in output("greet", "--help")


@pytest.mark.parametrize(("name", "reason"), [("gone", "AttributeError"), ("odd", "it is 1")])
def test_a_broken_plugin_is_one_line_and_spares_the_others(plugins, name, reason):
    result = run(name)
    assert result.exit_code == 2
    [line] = result.stderr.splitlines()
    assert line.startswith(f"tpgmm: the command {name!r} of a plugin cannot be loaded")
    assert reason in line
    assert output("greet") == "hello you\n"


def sketch(model, path, signals):
    """A format of a plugin."""


def test_plugins_add_formats(monkeypatch):
    found = [
        EntryPoint("sketch", f"{__name__}:sketch", formats.ENTRY_POINTS),
        EntryPoint("gone", f"{__name__}_gone:sketch", formats.ENTRY_POINTS),
    ]
    monkeypatch.setattr(formats, "entry_points", lambda group: found)
    assert formats.writer("tpgmm") is None
    assert formats.writer("sketch").__doc__ == sketch.__doc__
    with pytest.raises(DependencyError, match=r"the plugin of format 'gone'.*cannot be loaded"):
        formats.writer("gone")
    with pytest.raises(DataError, match=r"there are \['gone', 'sketch', 'tpgmm'\]"):
        formats.writer("onnx")

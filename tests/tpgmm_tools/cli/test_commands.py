"""How ``tpgmm`` refuses, and commands that other distributions add to it."""

import warnings
from importlib.metadata import EntryPoint, PathDistribution

import pytest
import typer

from tests.support.command_line import output, refusal, run
from tpgmm_tools.cli import plugins
from tpgmm_torch.exceptions import (
    ConvergenceWarning,
    DataError,
    ModelFileError,
)

BAD_INPUT = {
    "no such command": (("fot",), "No such command 'fot'"),
    "no data set": (("fit", "--out", "x"), "Missing argument"),
    "no folder": (("fit", "nowhere", "--out", "x"), "there is no folder nowhere"),
    "no components": (("fit", "x", "--out", "y", "--n-components", "0"), "--n-components"),
    "no such choice": (("fit", "x", "--out", "y", "--fusion", "sum"), "--fusion"),
    "no operator": (("fit", "x", "--out", "y", "--operator", "hand"), "is not a term"),
    "link without robot": (("fit", "x", "--out", "y", "--link", "l_hand"), "need --robot"),
    "no such link": (
        ("fit", "x", "--out", "y", "--robot", "upper_body", "--link", "hand"),
        "'hand'",
    ),
    "no such URDF": (("fit", "x", "--out", "y", "--robot", "no.urdf"), "no.urdf"),
    "no model": (("reproduce", "x", "--dataset", "y", "--out", "z.csv"), "x is not a saved"),
    "no situations": (("reproduce", "x", "--out", "z.csv"), "give either --situations"),
    "no such format": (("reproduce", "x", "--dataset", "y", "--out", "z.txt"), "z.txt"),
    "no data set to check": (("dataset", "check", "nowhere"), "there is no folder"),
}


@pytest.mark.parametrize(("arguments", "message"), BAD_INPUT.values(), ids=BAD_INPUT)
def test_bad_input_ends_in_one_line_and_exit_code_2(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(*arguments)
    assert list(tmp_path.iterdir()) == []


def test_debug_lets_the_error_through():
    result = run("--debug", "reproduce", "x", "--dataset", "y", "--out", "z.csv")
    assert isinstance(result.exception, ModelFileError)


def test_what_is_no_error_of_the_user_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr("tpgmm_datasets.description.describe_lerobot", lambda path: 1 / 0)
    assert isinstance(run("dataset", "check", "x").exception, ZeroDivisionError)


def test_a_missing_package_is_named_with_the_extra_that_has_it(monkeypatch):
    def missing(path):
        raise ModuleNotFoundError("No module named 'pyarrow'", name="pyarrow")

    monkeypatch.setattr("tpgmm_datasets.description.describe_lerobot", missing)
    line = refusal("dataset", "check", "x")
    assert line == "tpgmm: this command needs pyarrow: pip install 'tpgmm-torch[cli]'"


def test_warnings_are_one_line_each(monkeypatch):
    def warn(path):
        warnings.warn("it did not\nconverge", ConvergenceWarning, stacklevel=1)
        raise DataError("the rest")

    monkeypatch.setattr("tpgmm_datasets.description.describe_lerobot", warn)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        result = run("dataset", "check", "x")
    lines = ["tpgmm: warning: it did not converge", "tpgmm: the rest"]
    assert result.stderr.splitlines() == lines


def greet(name: str = "you") -> None:
    """Greet."""
    typer.echo(f"hello {name}")


greeting = typer.Typer()
greeting.command()(greet)
nonsense = 1


@pytest.fixture
def greeters(monkeypatch):
    entries = {"greet": "greet", "welcome": "greeting", "odd": "nonsense", "gone": "absent"}
    found = [
        EntryPoint(name, f"{__name__}:{value}", plugins.COMMANDS)
        for name, value in entries.items()
    ]
    found.append(EntryPoint("fit", f"{__name__}:greet", plugins.COMMANDS))
    monkeypatch.setattr(plugins, "entry_points", lambda group: found)


def test_plugins_add_commands(greeters):
    for name in ("greet", "welcome"):
        assert output(name, "--name", "me") == "hello me\n"
    assert "Learn a skill" in output("fit", "--help")


def test_help_names_the_commands_of_plugins_without_importing_any(greeters):
    result = run("--help")
    assert result.exit_code == 0
    assert result.stderr == ""
    unwrapped = " ".join(result.stdout.replace("│", " ").split())
    for name in ("greet", "welcome", "odd", "gone"):
        assert f"tpgmm {name} --help" in unwrapped
    assert "Greet." in output("greet", "--help")


@pytest.mark.parametrize(("name", "reason"), [("gone", "AttributeError"), ("odd", "it is 1")])
def test_a_broken_plugin_is_one_line_and_spares_the_others(greeters, name, reason):
    result = run(name)
    assert result.exit_code == 2
    [line] = result.stderr.splitlines()
    assert line.startswith(f"tpgmm: the command {name!r} of a plugin cannot be loaded")
    assert reason in line
    assert output("greet") == "hello you\n"


def test_help_shows_what_commands_of_this_distribution_are_for(monkeypatch, tmp_path):
    about = tmp_path / "tpgmm_torch-0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Name: tpgmm-torch\n")
    lines = [f"{name} = {__name__}:{value}" for name, value in (("g", "greeting"), ("a", "no"))]
    (about / "entry_points.txt").write_text("\n".join([f"[{plugins.COMMANDS}]", *lines]))
    entries = PathDistribution(about).entry_points
    monkeypatch.setattr(plugins, "entry_points", lambda group: entries)
    text = output("--help")
    assert "Greet." in text
    assert "tpgmm a --help" in text  # it is broken, and spares the others

"""The command ``tpgmm``: help, errors in one line, commands of other distributions."""

import re
import subprocess
import sys
import warnings
from importlib.metadata import EntryPoint, version

import pytest
import typer

from tests.support.command_line import output, refusal, run
from tpgmm_tools.arguments import plugins
from tpgmm_tools.cli.application import app
from tpgmm_torch.exceptions import DataError, DependencyError, ModelFileError

COMMANDS = [
    "demo", "fit", "sequence", "reproduce", "report", "plot", "view", "app", "dataset",
    "camera", "calibrate",
]  # fmt: skip
DESCRIBE = "tpgmm_datasets.description.describe_lerobot"


def test_version_and_help_need_no_command():
    assert output("--version") == f"tpgmm-torch {version('tpgmm-torch')}\n"
    for arguments in ((), ("--help",)):
        text = output(*arguments)
        listed = re.findall(r"^│ (\w+)", text.partition("Commands")[2], re.MULTILINE)
        assert listed[: len(COMMANDS)] == COMMANDS
        assert "Run the paper's experiment" in text and "Learn a skill from" in text


def leaves(command, path=()):
    """Find the names that lead to each command that does something."""
    context = typer.Context(command)
    for name in getattr(command, "list_commands", lambda _: ())(context):
        _, inner, _ = command.resolve_command(context, [name])
        yield from leaves(inner, (*path, name))
    if not hasattr(command, "list_commands"):
        yield path


EVERY = [path for path in leaves(typer.main.get_command(app)) if path[0] in COMMANDS]


@pytest.mark.parametrize("command", EVERY, ids=" ".join)
def test_the_help_of_every_command_has_an_example(command):
    every, text = (output(*command, option) for option in ("--help-all", "--help"))
    for lines in (text.splitlines(), every.splitlines()):
        assert max(map(len, lines)) <= 80
    assert len(text.splitlines()) <= 40 <= 40 + every.count("--") - text.count("--")
    assert f"Example: tpgmm {' '.join(command)}" in text and "…" not in text


def test_the_help_of_every_command_needs_none_of_the_heavy_packages():
    script = f"""
import sys
from tpgmm_tools.cli.application import app
for command in {[(), *EVERY]}:
    app([*command, "--help"], standalone_mode=False)
print(*sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    heavy = {
        "av", "cv2", "gradio", "lerobot", "matplotlib", "mujoco", "numpy", "pandas", "pyarrow",
        "scipy", "sklearn", "torch", "trimesh", "viser",
    }  # fmt: skip
    assert heavy & {*done.stdout.splitlines()[-1].split()} == set()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("fot", "No such command 'fot'"),
        ("fit --out x", "Missing argument"),
        ("fit nowhere --out x", "there is no folder nowhere"),
        (
            "fit x --out y --n-components 0",
            "--n-components must be an int in the range [1, inf)",
        ),
        ("fit x --out y --n-components some", "not 'some'"),
        ("fit x --out y --fusion sum", "--fusion"),
        ("fit x --out y --covariance-type round", "--covariance-type must be one of"),
        ("fit x --out y --operator hand", "is not a term"),
        ("fit x --out y --link l_hand", "need --robot"),
        ("fit x --out y --robot upper_body --link hand", "'hand'"),
        ("fit x --out y --robot no.urdf", "no.urdf"),
        ("fit x --out y --poses left --robot upper_body", "--poses are instead of --robot"),
        ("fit x --out y --format onnx", "format 'onnx' is not known here"),
        ("reproduce x --dataset y --out z.csv", "x is not a saved"),
        ("reproduce x --out z.csv", "give either --situations"),
        ("reproduce x --dataset y --out z.txt", "z.txt"),
        ("dataset check nowhere", "there is no folder"),
    ],
)
def test_bad_input_ends_in_one_line_and_exit_code_2(command, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(*command.split())
    assert list(tmp_path.iterdir()) == []


def test_debug_and_what_no_user_can_mend_keep_the_traceback(monkeypatch):
    result = run("--debug", "reproduce", "x", "--dataset", "y", "--out", "z.csv")
    assert isinstance(result.exception, ModelFileError)
    monkeypatch.setattr(DESCRIBE, lambda path: 1 / 0)
    assert isinstance(run("dataset", "check", "x").exception, ZeroDivisionError)


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gradio", None)
    said = "this command needs gradio: pip install 'tpgmm-torch[app]'"
    assert refusal("app") == f"tpgmm: {said}"


def test_warnings_and_missing_packages_are_one_line_each(monkeypatch):
    def warn(path):
        warnings.warn("it did not\nconverge", UserWarning, stacklevel=1)
        raise ModuleNotFoundError("No module named 'pyarrow'", name="pyarrow")

    monkeypatch.setattr(DESCRIBE, warn)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        lines = run("dataset", "check", "x").stderr.splitlines()
    assert lines == [
        "tpgmm: warning: it did not converge",
        "tpgmm: this command needs pyarrow: pip install 'tpgmm-torch[cli]'",
    ]


def greet(name: str = "you") -> None:
    """Greet."""
    typer.echo(f"hello {name}")


greeting = typer.Typer()
greeting.command()(greet)


@pytest.fixture
def greeters(monkeypatch):
    entries = {"greet": "greeting", "gone": "absent", "fit": "greeting"}
    found = [EntryPoint(name, f"{__name__}:{value}", "") for name, value in entries.items()]
    monkeypatch.setattr(plugins, "entry_points", lambda group: found)


def test_plugins_add_commands_and_replace_none(greeters):
    assert output("greet", "--name", "me") == "hello me\n"
    assert "Greet." in output("greet", "--help")
    assert "Learn a skill" in output("fit", "--help")


def test_a_broken_plugin_is_one_line_and_spares_the_others(greeters):
    text = " ".join(output("--help").replace("│", " ").split())
    assert all(f"tpgmm {name} --help" in text for name in ("greet", "gone"))
    line = refusal("gone")
    assert "'gone'" in line and "cannot be loaded: AttributeError" in line


def test_plugins_add_formats_of_models(greeters):
    assert plugins.model_format("tpgmm") is None
    assert plugins.model_format("greet") is greeting
    with pytest.raises(DependencyError, match=r"'gone'.*cannot be loaded"):
        plugins.model_format("gone")
    with pytest.raises(DataError, match="format 'onnx' is not known here"):
        plugins.model_format("onnx")

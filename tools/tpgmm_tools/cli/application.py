"""The command ``tpgmm``: a group whose errors are one line, and to which plugins add."""

from __future__ import annotations

import re
import sys
import warnings
from importlib import import_module
from importlib.metadata import EntryPoint, version
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from tpgmm_tools.arguments import plugins

#: Commands of this package in the order of ``--help``; those of plugins follow.
ORDER = (
    "demo", "fit", "sequence", "reproduce", "report", "plot", "view", "app", "dataset",
    "camera", "calibrate",
)  # fmt: skip
#: Those of them that hold commands of their own.
GROUPS = ("dataset", "camera", "calibrate")
#: Those above this room, imported when they run; and lines in ``--help`` of such commands.
LATE = {"app": EntryPoint("app", "tpgmm_tools.app.command:app", plugins.COMMANDS)}
HELP = {
    "app": "Learn and look in the browser: a data set in, a moving picture out.",
    "compare": "Compare policies on simulated tasks.",
}
#: How scikit-learn names a parameter; on the command line it is an option.
PARAMETER = re.compile(r"the '(\w+)' parameter of TaskParameterizedGMM")
#: Extras by the packages that come with them.
OPTIONAL = {
    "av": "vision", "gradio": "app", "matplotlib": "cli", "pandas": "cli", "pyarrow": "cli",
}  # fmt: skip


class Commands(TyperGroup):
    """Typer's group with one-line errors (exit code 2) and commands from plugins.

    Attributes
    ----------
    debug : bool
        Let errors through, for their traceback.
    """

    debug = False

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run with arguments and exit; as in click, ``standalone_mode=False`` returns."""
        standalone = extra.pop("standalone_mode", True)
        extra["standalone_mode"] = False
        if not standalone:
            return super().main(*args, **extra)
        original = warnings.showwarning
        warnings.showwarning = lambda message, *_, **__: _say(f"warning: {message}")
        try:
            code = super().main(*args, **extra)
        except Exception as error:
            message = None if self.debug else explain(error)
            if message is None:
                raise
            _say(message)
            code = 2
        finally:
            warnings.showwarning = original
        sys.exit(code if isinstance(code, int) else 0)

    def list_commands(self, ctx: Any) -> list[str]:
        """List the commands of this package and those of plugins."""
        names = {*super().list_commands(ctx), *_find_late()}
        return sorted(names, key=lambda n: (ORDER.index(n) if n in ORDER else len(ORDER), n))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command; of one that is not imported yet, only the name and one line."""
        command, late = super().get_command(ctx, cmd_name), _find_late()
        if command is None and cmd_name in late:
            origin = late[cmd_name].module.partition(".")[0]
            text = f"A command of {origin}: tpgmm {cmd_name} --help"
            command = TyperCommand(cmd_name, help=HELP.get(cmd_name, text))
        return command

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that is about to run, imported."""
        if args[0] not in self.commands and args[0] in (late := _find_late()):
            command = typer.main.get_command(plugins.load(late[args[0]]))
            command.name = args[0]
            self.add_command(command)
        return super().resolve_command(ctx, args)


def _find_late() -> dict[str, EntryPoint]:
    return plugins.find_plugins(plugins.COMMANDS) | LATE


def explain(error: Exception) -> str | None:
    """Return the message of an ``error`` that a user can mend; None for any other."""
    # some releases of typer bring their own copy of click's classes
    if hasattr(error, "format_message"):
        context = getattr(error, "ctx", None)
        hint = f" (see {context.command_path} --help)" if context else ""
        return f"{error.format_message()}{hint}"
    if isinstance(error, typer.Abort):
        return "aborted"
    if isinstance(error, ModuleNotFoundError) and error.name in OPTIONAL:
        extra = OPTIONAL[error.name]
        return f"this command needs {error.name}: pip install 'tpgmm-torch[{extra}]'"
    from tpgmm_torch.exceptions import PlausibilityWarning, TPGMMError

    expected = isinstance(error, TPGMMError | OSError | PlausibilityWarning)
    return PARAMETER.sub(_write_option, str(error)) if expected else None


def _write_option(match: re.Match[str]) -> str:
    return f"--{match[1].replace('_', '-')}"


def _say(message: str) -> None:
    typer.echo(f"tpgmm: {' '.join(message.split())}", err=True)


app = typer.Typer(
    name="tpgmm",
    cls=Commands,
    add_completion=False,
    context_settings={"help_option_names": ["--help", "--help-all"]},
    invoke_without_command=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    epilog="Start with: tpgmm demo --out out/demo",
)
for name in ORDER:
    if name not in LATE:
        members = import_module(f"tpgmm_tools.cli.{name}").app
        if name in GROUPS:
            app.add_typer(members, name=name)
        else:
            app.registered_commands += members.registered_commands


@app.callback()
def tpgmm(
    context: typer.Context,
    show_version: Annotated[
        bool, typer.Option("--version", help="Print the version and stop.", is_eager=True)
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error.")
    ] = False,
) -> None:
    """Robot skills from ten demonstrations: task-parameterised Gaussian mixtures.

    Learn from a LeRobot data set and a URDF, reproduce in new situations.
    """
    if isinstance(context.command, Commands):
        context.command.debug = debug
    if show_version:
        typer.echo(f"tpgmm-torch {version('tpgmm-torch')}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())

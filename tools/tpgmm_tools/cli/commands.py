"""A group of commands whose errors are one line, and to which plugins add."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import EntryPoint
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from tpgmm_tools.cli.plugins import COMMANDS, registered

__all__ = ["explain"]

#: What ``--help`` lists first, in this order; other plugins' commands follow.
ORDER = ("demo", "fit", "correct", "reproduce", "plot", "view", "app", "dataset")
#: Plugins of this distribution are quick to import: ``--help`` shows what theirs are for.
DISTRIBUTION = "tpgmm-torch"
#: Packages that come with the extra ``cli``.
OPTIONAL = ("matplotlib", "pandas", "pyarrow")


class Commands(TyperGroup):
    """Typer's group with one-line errors (exit code 2) and commands from plugins.

    Attributes
    ----------
    debug : bool
        Let errors through, for their traceback.
    """

    debug = False

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        """Run with arguments and exit; as in click, ``standalone_mode=False`` returns."""
        given = (args, prog_name, complete_var, False, windows_expand_args)
        run = partial(super().main, *given, **extra)
        if not standalone_mode:
            return run()
        with _warnings_in_one_line():
            try:
                code = run()
            except Exception as error:
                message = None if self.debug else explain(error)
                if message is None:
                    raise
                _say(message)
                code = 2
        sys.exit(code if isinstance(code, int) else 0)

    def list_commands(self, ctx: Any) -> list[str]:
        """The commands of this package and those of plugins."""
        names = {*super().list_commands(ctx), *registered(COMMANDS)}
        return sorted(names, key=lambda n: (ORDER.index(n) if n in ORDER else len(ORDER), n))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command by name; of a plugin's, which may take long to import, only the name."""
        command = super().get_command(ctx, cmd_name)
        if command is not None or (plugin := registered(COMMANDS).get(cmd_name)) is None:
            return command
        origin = plugin.dist.name if plugin.dist else plugin.module
        if origin == DISTRIBUTION:
            with suppress(Exception):  # --help lists the others all the same
                return _loaded(plugin)
        return TyperCommand(cmd_name, help=f"A command of {origin}: tpgmm {cmd_name} --help")

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that is about to run; now a plugin is imported."""
        plugin = registered(COMMANDS).get(args[0])
        if plugin is not None and args[0] not in self.commands:
            self.add_command(_loaded(plugin))
        return super().resolve_command(ctx, args)


def explain(error: Exception) -> str | None:
    """The message of an ``error`` that a user can mend; None for any other."""
    # typer brought its own copy of click's classes with it in some releases, not in others
    if hasattr(error, "format_message"):
        context = getattr(error, "ctx", None)
        hint = f" (see {context.command_path} --help)" if context else ""
        return f"{error.format_message()}{hint}"
    if isinstance(error, typer.Abort):
        return "aborted"
    if isinstance(error, ModuleNotFoundError) and error.name in OPTIONAL:
        return f"this command needs {error.name}: pip install 'tpgmm-torch[cli]'"
    from tpgmm_torch.exceptions import TPGMMError

    expected = isinstance(error, TPGMMError | OSError)
    return str(error) if expected else None


def _say(message: str) -> None:
    typer.echo(f"tpgmm: {' '.join(message.split())}", err=True)


@contextmanager
def _warnings_in_one_line() -> Iterator[None]:
    def show(message: Warning | str, *_where: Any, **_more: Any) -> None:
        _say(f"warning: {message}")

    original, warnings.showwarning = warnings.showwarning, show
    try:
        yield
    finally:
        warnings.showwarning = original


def _loaded(plugin: EntryPoint) -> Any:
    try:
        app = plugin.load()
        if not isinstance(app, typer.Typer):
            if not callable(app):
                raise TypeError(f"it is {app!r}, not a typer app or a function")
            function, app = app, typer.Typer(add_completion=False)
            app.command(plugin.name)(function)
        command = typer.main.get_command(app)
    except Exception as error:  # whatever is wrong with it
        from tpgmm_torch.exceptions import DependencyError

        raise DependencyError(
            f"the command {plugin.name!r} of a plugin cannot be loaded: "
            f"{type(error).__name__}: {error}"
        ) from error
    command.name = plugin.name
    return command

"""The command ``tpgmm``: what its commands have in common, and what plugins add."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated

import typer

from tpgmm_tools.cli import correct, fit, plot, reproduce, view
from tpgmm_tools.cli.commands import Commands

__all__ = ["app"]

app = typer.Typer(
    name="tpgmm",
    cls=Commands,
    add_completion=False,
    invoke_without_command=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    epilog="Start with: tpgmm demo --out out/demo",
)
for module in (fit, correct, reproduce, plot, view):
    app.registered_commands += module.app.registered_commands


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

    Learn from a LeRobot data set and a URDF, reproduce in situations never seen.
    """
    if isinstance(context.command, Commands):
        context.command.debug = debug
    if show_version:
        typer.echo(f"tpgmm-torch {version('tpgmm-torch')}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())

"""Help of a command on one screen of 80 columns; ``--help-all`` has all options."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from inspect import Parameter
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

#: Options that most people need: a command's ``--help`` lists those of them that it has.
BASIC = (
    "out", "robot", "link", "frame", "units", "episodes", "operator", "n_components",
    "alignment", "format_", "dataset", "situations", "situation", "object_", "live", "joint",
    "cell", "rate", "n_situations", "n_demonstrations", "random_state", "name", "board",
    "tag", "cube", "size", "hand", "check", "env", "policies", "demonstrations", "seeds",
    "budget", "conditions",
)  # fmt: skip
#: Width of the column of options, and the context's entry that asks for all of them.
COLUMN, EVERY = 24, "tpgmm_tools.every"


class Command(TyperCommand):
    """A command with two forms of help: what most people need, and everything, in groups."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the short help, or all of it after ``--help-all``."""
        every = EVERY in ctx.meta
        known = [one for one in self.params if one.name != HELP_ALL.name]
        panels = _panels(known if every else filter(_is_basic, known), ctx, every)
        needed = [_record(one, ctx)[0] for one in known if one.required]
        formatter.write_usage(ctx.command_path, " ".join([*needed, "[OPTIONS]"]))
        for paragraph in _paragraphs(self.help, every):
            formatter.write_paragraph()
            formatter.write_text(paragraph)
        for panel, rows in panels.items():
            with formatter.section(panel):
                formatter.write_dl(rows, col_max=COLUMN)
        formatter.write_paragraph()
        if rest := len(known) - sum(map(len, panels.values())):
            formatter.write(f"{rest} more options: {ctx.command_path} --help-all\n")
        for paragraph in _paragraphs(f"Example: {self.epilog}", every):
            formatter.write(_wrap_example(paragraph, formatter.width))


def _is_basic(one: Any) -> bool:
    return one.required or one.name in BASIC


def _panels(params: Iterable[Any], ctx: Any, every: bool) -> dict[str, list[tuple[str, str]]]:
    """Group parameters as they are listed: in panels with all of their texts, or in one."""
    panels: dict[str, list[tuple[str, str]]] = {}
    for one in params:
        syntax, text = _record(one, ctx)
        panel = (one.rich_help_panel if every else None) or "Options"
        panels.setdefault(panel, []).append((syntax, text if every else _shorten(text)))
    return panels


def _record(one: Any, ctx: Any) -> tuple[str, str]:
    """Return how a parameter is typed, and its text; of an argument without its type."""
    syntax, text = one.get_help_record(ctx)
    text = text.replace("\\[", "[")  # as typer 0.19 writes them, for rich
    return one.metavar if one.param_type_name == "argument" else syntax, text


def _paragraphs(text: str | None, every: bool) -> list[str]:
    return (text or "").strip().split("\n\n")[: None if every else 1]


def _shorten(text: str) -> str:
    """Cut a text to its first sentence; typer's remarks in brackets stay behind it."""
    said, bracket, remarks = text.partition("  [")
    first = re.split(r"(?<=[.;:])\s", said)[0].rstrip(".;:")
    return f"{first}.{bracket}{remarks}"


def _wrap_example(text: str, width: int) -> str:
    """Wrap an example; a shell goes on behind a backslash."""
    lines = textwrap.wrap(text, width - 4, break_on_hyphens=False)
    return (" \\\n  " if text.startswith("Example") else "\n").join(lines) + "\n"


def _show_all(context: typer.Context, value: bool) -> None:
    if value and not context.resilient_parsing:
        context.meta[EVERY] = True
        typer.echo(context.get_help())
        raise typer.Exit


#: The option that every command has.
HELP_ALL = Parameter(
    "help_all",
    Parameter.KEYWORD_ONLY,
    default=False,
    annotation=Annotated[
        bool, typer.Option("--help-all", hidden=True, is_eager=True, callback=_show_all)
    ],
)

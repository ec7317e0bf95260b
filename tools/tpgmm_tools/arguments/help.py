"""Help of a command on one screen of 80 columns; ``--help-all`` has all options."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from inspect import Parameter
from typing import Annotated, Any, Literal, get_args, get_origin

import typer
from typer.core import TyperCommand
from typer.models import ArgumentInfo

WIDTH, COLUMN = 80, 26


@dataclass(frozen=True)
class Help:
    """Texts about a command.

    Parameters
    ----------
    text : str
        Its description, paragraphs apart.
    example : str
        Of its use, perhaps with more paragraphs.
    parameters : sequence of inspect.Parameter
        With typer's annotations.
    basic : collection of str
        Parameters that the short help lists, beside those that are required.
    """

    text: str
    example: str
    parameters: Sequence[Parameter]
    basic: Collection[str]

    def lines(self, path: str, every: bool) -> Iterator[str]:
        """Write the lines of the help.

        Parameters
        ----------
        path : str
            How the command is called: ``"tpgmm fit"``.
        every : bool
            Whether to list all parameters, in groups, with all that is known of them.
        """
        needed = [_write_syntax(one) for one in self.parameters if _is_required(one)]
        yield from textwrap.wrap(f"Usage: {path} {' '.join(needed)} [OPTIONS]", WIDTH)
        paragraphs = self.text.strip().split("\n\n")
        for paragraph in paragraphs if every else paragraphs[:1]:
            yield ""
            yield from textwrap.wrap(paragraph, WIDTH)
        yield from self._parameter_lines(every)
        if not every:
            rest = sum(not self._is_basic(one) for one in self.parameters)
            yield from [f"{rest} more options: {path} --help-all"] if rest else []
        yield from self._example_lines(every)

    def _is_basic(self, one: Parameter) -> bool:
        return _is_required(one) or one.name in self.basic

    def _parameter_lines(self, every: bool) -> Iterator[str]:
        """Write what is listed, in panels if it is all."""
        panels: dict[str, list[Parameter]] = {}
        for one in self.parameters:
            if every or self._is_basic(one):
                panel = _info(one).rich_help_panel if every else None
                panels.setdefault(panel or "", []).append(one)
        for panel, members in panels.items():
            yield ""
            yield from [f"{panel}:"] if panel else []
            for one in members:
                yield from _entry(_write_syntax(one), _explain(one, every))
        yield ""

    def _example_lines(self, every: bool) -> Iterator[str]:
        """Write the examples; a shell goes on behind a backslash."""
        paragraphs = f"Example: {self.example}".split("\n\n")
        for paragraph in paragraphs if every else paragraphs[:1]:
            lines = textwrap.wrap(paragraph, WIDTH - 2, break_on_hyphens=False)
            is_command = paragraph.startswith("Example")
            yield from " \\\n  ".join(lines).split("\n") if is_command else lines


class Command(TyperCommand):
    """A command that shows :class:`Help`.

    Attributes
    ----------
    about : Help
    """

    about: Help

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the short help."""
        formatter.write("\n".join(self.about.lines(ctx.command_path, every=False)) + "\n")


def _show_all(context: typer.Context, value: bool) -> None:
    if value and not context.resilient_parsing and isinstance(context.command, Command):
        typer.echo("\n".join(context.command.about.lines(context.command_path, every=True)))
        raise typer.Exit


#: The option that every command has.
HELP_ALL = Parameter(
    "help_all",
    Parameter.KEYWORD_ONLY,
    default=False,
    annotation=Annotated[
        bool,
        typer.Option("--help-all", help="Show all options.", is_eager=True, callback=_show_all),
    ],
)


def _info(one: Parameter) -> Any:
    """Return the settings of typer about a parameter."""
    return get_args(one.annotation)[1]


def _is_required(one: Parameter) -> bool:
    return one.default is Parameter.empty


def _write_syntax(one: Parameter) -> str:
    """Write how a parameter is typed."""
    info = _info(one)
    if isinstance(info, ArgumentInfo):
        return info.metavar or one.name.upper()
    names = info.param_decls or (info.default,)  # typer keeps the only name as a default
    metavar = info.metavar or _write_value(get_args(one.annotation)[0])
    return f"{', '.join(names).replace('/', ', ')} {metavar}".strip()


def _write_value(kind: Any) -> str:
    """Write what stands for a value of a type; nothing for a flag."""
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    kinds = {bool: "", int: "INTEGER", float: "NUMBER"}
    return next((kinds[k] for k in (kind, *get_args(kind)) if k in kinds), "TEXT")


def _explain(one: Parameter, every: bool) -> str:
    """Explain a parameter: all of its help, or one sentence."""
    text = (_info(one).help or "").replace("\\[", "[")
    if not every:
        text = re.split(r"(?<=[.;:])\s", text)[0].rstrip(".;:") + "."
    if _is_required(one):
        return f"{text} [required]"
    if isinstance(one.default, bool) or one.default in (None, ""):
        return text
    return f"{text} [default: {one.default}]"


def _entry(syntax: str, text: str) -> Iterator[str]:
    """Write the lines of one parameter: its syntax, never cut, and what it is for beside it."""
    lines = textwrap.wrap(text, WIDTH - COLUMN, break_long_words=False) or [""]
    first = f"  {syntax}"
    if len(first) < COLUMN:
        yield first.ljust(COLUMN) + lines[0]
        lines = lines[1:]
    else:
        yield first
    yield from (" " * COLUMN + line for line in lines)

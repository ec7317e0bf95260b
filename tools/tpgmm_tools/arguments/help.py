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

__all__ = ["HELP_ALL", "Command", "Help"]

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
        """The lines of the help.

        Parameters
        ----------
        path : str
            How the command is called: ``"tpgmm fit"``.
        every : bool
            Whether to list all parameters, in groups, with all that is known of them.
        """
        needed = [_syntax(one) for one in self.parameters if _is_required(one)]
        yield from textwrap.wrap(f"Usage: {path} {' '.join(needed)} [OPTIONS]", WIDTH)
        paragraphs = self.text.strip().split("\n\n")
        for paragraph in paragraphs if every else paragraphs[:1]:
            yield ""
            yield from textwrap.wrap(paragraph, WIDTH)
        panels: dict[str, list[Parameter]] = {}
        for one in self.parameters:
            if every or _is_required(one) or one.name in self.basic:
                panel = _info(one).rich_help_panel if every else None
                panels.setdefault(panel or "", []).append(one)
        for panel, members in panels.items():
            yield ""
            yield from [f"{panel}:"] if panel else []
            for one in members:
                yield from _entry(_syntax(one), _explained(one, every))
        yield ""
        if rest := len(self.parameters) - sum(map(len, panels.values())):
            yield f"{rest} more options: {path} --help-all"
        paragraphs = f"Example: {self.example}".split("\n\n")
        for paragraph in paragraphs if every else paragraphs[:1]:
            command = paragraph.startswith("Example")  # a shell goes on behind a backslash
            lines = textwrap.wrap(paragraph, WIDTH - 2, break_on_hyphens=False)
            yield from " \\\n  ".join(lines).split("\n") if command else lines


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
    """Settings of typer about a parameter."""
    return get_args(one.annotation)[1]


def _is_required(one: Parameter) -> bool:
    return one.default is Parameter.empty


def _syntax(one: Parameter) -> str:
    """How a parameter is typed."""
    kind, info = get_args(one.annotation)[0], _info(one)
    kinds = {*get_args(kind)} if get_origin(kind) is not Literal else {kind}
    metavar = info.metavar or ""
    if get_origin(kind) is Literal:
        metavar = metavar or "|".join(get_args(kind))
    elif not metavar and bool not in {kind, *kinds}:
        numbers = {int: "INTEGER", float: "NUMBER"}
        metavar = next((numbers[k] for k in (kind, *kinds) if k in numbers), "TEXT")
    if isinstance(info, ArgumentInfo):
        return metavar if info.metavar else one.name.upper()
    names = info.param_decls or (info.default,)  # typer keeps the only name as a default
    return f"{', '.join(names).replace('/', ', ')} {metavar}".strip()


def _explained(one: Parameter, every: bool) -> str:
    """Help of a parameter: all of it, or one sentence."""
    text = (_info(one).help or "").replace("\\[", "[")
    if not every:
        text = re.split(r"(?<=[.;:])\s", text)[0].rstrip(".;:") + "."
    if _is_required(one):
        return f"{text} [required]"
    if isinstance(one.default, bool) or one.default in (None, ""):
        return text
    return f"{text} [default: {one.default}]"


def _entry(syntax: str, text: str) -> Iterator[str]:
    """Lines of one parameter: its syntax, never cut, and what it is for beside it."""
    lines = textwrap.wrap(text, WIDTH - COLUMN, break_long_words=False) or [""]
    first = f"  {syntax}"
    if len(first) < COLUMN:
        yield first.ljust(COLUMN) + lines[0]
        lines = lines[1:]
    else:
        yield first
    yield from (" " * COLUMN + line for line in lines)

"""Running the command ``tpgmm`` inside a test."""

from typer.testing import CliRunner

from tpgmm_tools.cli.application import app

#: The robot of the generated skill, and its hands.
UPPER_BODY = ("--robot", "upper_body", "--link", "l_hand", "--link", "r_hand")


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def output(*arguments):
    result = run(*arguments)
    assert result.exit_code == 0, result.output or repr(result.exception)
    return result.stdout


def refusal(*arguments):
    """The one line on stderr."""
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    [line] = result.stderr.strip().splitlines()  # after progress some versions of rich skip one
    assert line.startswith("tpgmm: ")
    return line

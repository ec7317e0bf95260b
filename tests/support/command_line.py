"""Running the command ``tpgmm`` inside a test."""

import os
import re
import signal
import subprocess
import sys
from contextlib import contextmanager

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


@contextmanager
def serve(*arguments, **environment):
    """The address of a page that a command serves, in a process of its own, until Ctrl-C."""
    command = [sys.executable, "-c", "from tpgmm_tools.cli import main; main()"]
    with subprocess.Popen(
        [*command, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | environment,
        # what a shell starts in the background would else ignore Ctrl-C
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        try:
            line = process.stdout.readline()
            yield re.fullmatch(r"open (http://127\.0\.0\.1:\d+/?) in a browser.*\n", line)[1]
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
            assert process.stdout.read() == ""
        finally:
            process.kill()

"""Measurements in a process of their own, for memory and for the time of imports."""

import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

__all__ = ["ask", "peak_memory", "reset_peak"]

ROOT = Path(__file__).parents[1]


def ask(module: str, *arguments: object, launcher: tuple[str, ...] = ()) -> Any:
    """Let a new process call ``answer`` of a module of this folder; return what that returns.

    Parameters
    ----------
    module : str
        Its name, without the package.
    *arguments
        Of the function, as JSON holds them.
    launcher : sequence of str
        What stands between the interpreter and the module.

    Raises
    ------
    RuntimeError
        If it fails; with what it printed.
    """
    command = [sys.executable, *launcher, "-m", "benchmarks.child", module]
    done = subprocess.run(
        [*command, json.dumps(arguments)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def reset_peak() -> None:
    """Let the peak of this process's memory begin at what it holds now (Linux).

    Raises
    ------
    OSError
        Where the system does not let it.
    """
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory() -> float:
    """Read the most memory that this process held since :func:`reset_peak` [bytes] (Linux)."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    [line] = [line for line in status.splitlines() if line.startswith("VmHWM:")]
    return 1024.0 * int(line.split()[1])


if __name__ == "__main__":
    found = import_module(f"benchmarks.{sys.argv[1]}").answer(*json.loads(sys.argv[2]))
    if found is not None:
        print(json.dumps(found), flush=True)

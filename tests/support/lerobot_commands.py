"""Running LeRobot's commands, as a user does: in a process of their own."""

import atexit
import json
import os
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

PLUGINS = Path(__file__).parent / "plugins"
#: Imports LeRobot, which takes ten seconds, once; each command is a fork of it.
SERVER = """
import importlib, json, os, signal, sys
for name in ("eval", "rollout", "train"):
    importlib.import_module(f"lerobot.scripts.lerobot_{name}")
for line in sys.stdin:
    asked = json.loads(line)
    child = os.fork()
    if child:
        signal.signal(signal.SIGALRM, lambda *_: os.kill(child, signal.SIGKILL))
        signal.alarm(300)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
        signal.alarm(0)
        continue
    for number, file in enumerate((os.devnull, asked["out"], asked["err"])):
        os.dup2(os.open(file, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
    sys.argv, sys.path[:0] = asked["words"], asked["path"]
    os.environ.update(asked["environment"])
    os.chdir(asked["folder"])
    command = importlib.import_module(f"lerobot.scripts.lerobot_{asked['command']}")
    sys.exit(command.main())
"""


def lerobot(
    command: str, *arguments: object, home: Path, drawing: str = "disabled"
) -> subprocess.CompletedProcess[str]:
    """Run ``lerobot-<command>``, offline; the robot of the tests is installed for it.

    Pictures are blank, unless MuJoCo's way of ``drawing`` is named.
    """
    metadata = home / "lerobot_robot_bimanual-0.dist-info" / "METADATA"
    metadata.parent.mkdir(parents=True, exist_ok=True)
    metadata.write_text("Metadata-Version: 2.1\nName: lerobot_robot_bimanual\nVersion: 0\n")
    words = [f"lerobot-{command}", *map(str, arguments)]
    out, err = (home / f"{command}.{name}" for name in ("out", "err"))
    asked = {
        "command": command, "words": words, "path": [str(PLUGINS), str(home)],
        "environment": {"MUJOCO_GL": drawing}, "folder": str(Path.cwd()), "out": str(out),
        "err": str(err),
    }  # fmt: skip
    server = started()
    assert server.stdin and server.stdout
    server.stdin.write(json.dumps(asked) + "\n")
    server.stdin.flush()
    code = int(server.stdout.readline())
    return subprocess.CompletedProcess(words, code, out.read_text(), err.read_text())


@cache
def started() -> "subprocess.Popen[str]":
    """The process that forks."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    environment = {
        **os.environ,
        "HF_HOME": folder.name,
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
        "CUDA_VISIBLE_DEVICES": "",
        "SLURM_JOB_ID": "1",  # no progress bars
    }
    server = subprocess.Popen(
        [sys.executable, "-P", "-c", SERVER],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdin
    atexit.register(server.wait)
    atexit.register(server.stdin.close)  # which ends it, before its folder goes
    return server

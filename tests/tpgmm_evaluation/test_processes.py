"""Jobs in processes: some fail, some die, and the others go on."""

import os
import runpy
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tpgmm_evaluation import processes
from tpgmm_evaluation.processes import run_jobs


@pytest.mark.slow
def test_jobs_that_fail_or_die_spare_the_others(tmp_path):
    done = "import pathlib; pathlib.Path(__file__).with_suffix('.done').touch()"
    killed = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    texts = ("raise ValueError('no such luck')", killed, done, "import sys; sys.exit(3)", done)
    scripts = [tmp_path / f"{number}.py" for number in range(len(texts))]
    for script, text in zip(scripts, texts, strict=True):
        script.write_text(text)
    logs = [script.with_suffix(".txt") for script in scripts]
    # a function that the other processes can import, unlike those of a test
    problems = dict(run_jobs(runpy.run_path, [(str(script),) for script in scripts], 2, logs))
    died = "its process ended with code -9"
    wanted = ("ValueError: no such luck", died, None, "SystemExit: 3", None)
    assert problems == dict(enumerate(wanted))
    assert "Traceback" in logs[0].read_text()
    assert {path.name for path in tmp_path.glob("*.done")} == {"2.done", "4.done"}


def test_jobs_end_with_a_run_that_is_killed(tmp_path):
    job, pid = tmp_path / "job.py", tmp_path / "pid"
    job.write_text(
        "import os, pathlib, time\n"
        f"partial = pathlib.Path({str(pid)!r} + '.partial')\n"
        "partial.write_text(str(os.getpid()))\n"
        f"partial.rename({str(pid)!r})\n"
        "time.sleep(100)\n"
    )
    # as a module of its own, and without what jobs need: it starts quickly
    text = (
        "import pathlib, runpy, processes\n"
        "processes.PRELOADED = 'json'\n"
        f"jobs, logs = [({str(job)!r},)], [pathlib.Path({str(tmp_path / 'log')!r})]\n"
        "list(processes.run_jobs(runpy.run_path, jobs, 1, logs))\n"
    )
    folder = str(Path(processes.__file__).parent)
    environment = os.environ | {"PYTHONPATH": folder}
    run = subprocess.Popen([sys.executable, "-c", text], env=environment)
    assert comes_true(pid.exists)
    run.kill()
    run.wait()
    assert comes_true(lambda: not is_running(int(pid.read_text())))


def comes_true(condition):
    for _ in range(600):
        if condition():
            return True
        time.sleep(0.1)
    return False


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True

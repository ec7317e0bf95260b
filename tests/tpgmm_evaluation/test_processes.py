"""Jobs in processes: some fail, some die, and the others go on."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tpgmm_evaluation import processes
from tpgmm_evaluation.processes import run_jobs


@pytest.mark.slow
def test_jobs_that_fail_or_die_spare_the_others(tmp_path):
    done = [tmp_path / name for name in ("2.done", "4.done")]
    texts = (
        "raise ValueError('no such luck')",
        "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
        f"import pathlib; pathlib.Path({str(done[0])!r}).touch()",
        "import sys; sys.exit(3)",
        f"import pathlib; pathlib.Path({str(done[1])!r}).touch()",
    )
    # a function that the other processes can import, unlike those of a test
    ended = run_jobs(exec, [(text,) for text in texts], 2)
    problems = {number: problem for number, _, problem in ended}
    assert "Traceback" in problems[0]
    assert {number: text.strip().splitlines()[-1:] for number, text in problems.items()} == {
        0: ["ValueError: no such luck"],
        1: ["its process ended with code -9"],
        2: [],
        3: ["SystemExit: 3"],
        4: [],
    }
    assert all(path.exists() for path in done)
    assert list(run_jobs(max, [(1, 2)], 1)) == [(0, 2, "")]


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
        "import runpy, processes\n"
        "processes.PRELOADED = 'json'\n"
        f"list(processes.run_jobs(runpy.run_path, [({str(job)!r},)], 1))\n"
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

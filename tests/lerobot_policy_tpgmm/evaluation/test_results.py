"""What is kept of a comparison: intervals, files of cells, settings, jobs in processes."""

import os
import runpy
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from lerobot_policy_tpgmm.evaluation import processes
from lerobot_policy_tpgmm.evaluation.cells import Cell, Results
from lerobot_policy_tpgmm.evaluation.processes import run_jobs
from lerobot_policy_tpgmm.evaluation.report.intervals import wilson
from lerobot_policy_tpgmm.evaluation.settings import Settings
from tpgmm_torch.exceptions import DataError, UnknownNameError

CELL = Cell("bottle_shaking", "act", 10, 0)


@pytest.mark.parametrize(
    ("successes", "trials", "confidence", "expected"),
    [
        # Newcombe, Statistics in Medicine 17 (1998), table I, method 3
        (81, 263, 0.95, (0.2553, 0.3662)),
        (15, 148, 0.95, (0.0624, 0.1605)),
        (0, 20, 0.95, (0.0, 0.1611)),
        (1, 29, 0.95, (0.0061, 0.1718)),
        # from the other side
        (20, 20, 0.95, (0.8389, 1.0)),
        # z^2 = 2.7055: z^2 / (10 + z^2)
        (0, 10, 0.9, (0.0, 0.2129)),
    ],
)
def test_wilson_gives_published_values(successes, trials, confidence, expected):
    assert wilson(successes, trials, confidence) == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 2), (-1, 2)])
def test_wilson_refuses_what_is_no_proportion(successes, trials):
    with pytest.raises(DataError, match="no proportion"):
        wilson(successes, trials)


def test_a_cell_is_found_again_and_others_are_not(tmp_path):
    results = Results(tmp_path)
    assert results.read(CELL) is None
    results.write(CELL, {"episodes": [{"seed": 1, "success": True, "grasp_mm": float("inf")}]})
    assert results.read(CELL)["episodes"][0]["grasp_mm"] == float("inf")
    assert results.read(replace(CELL, condition="pushes")) is None
    assert [path.name for path in tmp_path.iterdir()] == [f"{CELL.key}.json"]


def test_damage_is_detected(tmp_path):
    results = Results(tmp_path)
    results.write(CELL, {"episodes": [{"seed": 1, "success": False}]})
    path = results.path(CELL)
    whole = path.read_text()
    for damaged, message in (
        (whole[: len(whole) // 2], "not the result"),
        ("[]", "not the result"),
        (whole.replace("false", "true"), "was changed"),
    ):
        path.write_text(damaged)
        with pytest.raises(DataError, match=message):
            results.read(CELL)
        said = []
        assert results.read_all(said.append) == []
        assert message in said[0]
    other = replace(CELL, seed=1)
    results.path(other).write_text(whole)
    with pytest.raises(DataError, match="another cell"):
        results.read(other)


def test_results_come_in_natural_order(tmp_path):
    results = Results(tmp_path)
    for count in (10, 5, 25):
        results.write(replace(CELL, demonstrations=count), {})
    assert [result["cell"]["demonstrations"] for result in results.read_all(print)] == [
        5,
        10,
        25,
    ]


def test_a_folder_keeps_its_settings(tmp_path):
    path = tmp_path / "settings.json"
    settings = Settings(episodes=7)
    settings.keep(path)
    settings.keep(path)
    with pytest.raises(DataError, match="episodes was 7, now 8"):
        Settings(episodes=8).keep(path)
    path.write_text("{")
    with pytest.raises(DataError, match="not JSON"):
        settings.keep(path)


def test_conditions_become_options_of_the_environment():
    settings = Settings(options={"mode": "kinematic"})
    assert settings.disturbed("nominal") == {"mode": "kinematic"}
    both = settings.disturbed("pushes+noise")
    assert both == {"mode": "kinematic", "pushes": True, "noise": 1.0}
    with pytest.raises(UnknownNameError, match="'rain' is not in the conditions"):
        settings.disturbed("rain")
    with pytest.raises(UnknownNameError, match="environment 'moon'"):
        Settings("moon").benchmark()


def test_jobs_that_fail_or_die_spare_the_others(tmp_path):
    texts = (
        "raise ValueError('no such luck')",
        "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
        "import pathlib; pathlib.Path(__file__).with_suffix('.done').touch()",
        "import sys; sys.exit(3)",
        "import pathlib; pathlib.Path(__file__).with_suffix('.done').touch()",
    )
    scripts = [tmp_path / f"{number}.py" for number in range(len(texts))]
    for script, text in zip(scripts, texts, strict=True):
        script.write_text(text)
    logs = [script.with_suffix(".txt") for script in scripts]
    # a function that the other processes can import, unlike those of a test
    problems = dict(run_jobs(runpy.run_path, [(str(script),) for script in scripts], 2, logs))
    assert problems == {
        0: "ValueError: no such luck",
        1: "its process ended with code -9",
        2: None,
        3: "SystemExit: 3",
        4: None,
    }
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

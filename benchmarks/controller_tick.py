"""One tick of a controller beside the model's own step, and the exported estimate in C++.

python -m benchmarks --only controller
"""

import re
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch

from benchmarks.rows import Asked, Row
from benchmarks.settings import Settings
from benchmarks.skill import fit_model, skill
from tpgmm_control import Controller
from tpgmm_torch import Situation, TaskParameterizedGMM
from tpgmm_torch.skills.compiled import export_estimate

__all__ = ["measure"]

EXAMPLE = Path(__file__).parents[1] / "examples" / "deployment_cpp"
WORK = "batch 1, 17 joints, two hands, K = 10, P = 2, float64"
PLAIN = "model.step"
#: What a tick is made with, and what it may take beside the model's own step, or at most [ms].
CONTROLLERS: Mapping[str, tuple[Mapping[str, Any], Asked | None]] = {
    "controller, even clock, trust=None": (
        {"clock": "even", "trust": None, "smoothing": None},
        Asked("times", 1.25),
    ),
    "controller as it is, measured joints": ({}, None),
}

Step = Callable[[float], Any]


def begin_plain(model: TaskParameterizedGMM, situation: Situation) -> Step:
    """Begin a skill with the model's own step, on its clock."""
    joints, grid = situation.joints, iter(model.time_.tolist())

    def step(dt: float) -> None:
        nonlocal joints
        joints = model.step(next(grid), joints, situation.frames).joints

    return step


def begin_controller(
    model: TaskParameterizedGMM, situation: Situation, dt: float, options: Mapping[str, Any]
) -> Step:
    """Begin a skill with a controller; without options it reads what it sent."""
    made = Controller(model.skill, situation.joints, situation.frames, **options)
    made.step(dt)
    given = {} if options else {"joints": situation.joints}

    def step(dt: float) -> None:
        command = made.step(dt, **given)
        if given:
            given["joints"] = command.reference

    return step


def measure(settings: Settings) -> Iterator[Row]:
    """Measure ticks of the skill from start to end, in turns."""
    model, ticks = fit_model(settings), settings.size(5_000, 30)
    [situation] = skill(settings).situations(1, settings.seed + 1000)
    dt, length = float(model.time_.diff().median()), len(model.time_)

    ways: dict[str, Callable[[], Step]] = {PLAIN: partial(begin_plain, model, situation)}
    asked: dict[str, Asked | None] = {PLAIN: None}
    for name, (options, most) in CONTROLLERS.items():
        ways[name] = partial(begin_controller, model, situation, dt, options)
        asked[name] = most if settings.full else None
    if settings.full:  # at tiny sizes, minutes of compiling show nothing
        path = settings.out / "estimate.pt2"
        export_estimate(model.skill, path)
        yield from _in_cpp(path, situation, dt, ticks, settings)
        path.unlink()
    taken = _latencies(ways, dt, ticks, length - 1)
    base = float(np.median(taken[PLAIN]))
    for name, each in taken.items():
        middle, worst = np.percentile(each, [50, 99]).tolist()
        beside = ("", None) if name == PLAIN else (PLAIN, base)
        work, limit = f"tick, {WORK}, {name}", settings.target("most", 1.0)
        yield Row(f"{work}: median", "ms", middle, *beside, asked[name], rounds=ticks)
        yield Row(f"{work}: 99th percentile", "ms", worst, asked=limit, rounds=ticks)


def _latencies(
    ways: Mapping[str, Callable[[], Step]], dt: float, ticks: int, length: int
) -> dict[str, np.ndarray]:
    """Take milliseconds of each tick; every way takes one before any takes the next."""
    taken = {name: np.empty(ticks) for name in ways}
    steps = {name: begin() for name, begin in ways.items()}
    with torch.inference_mode():
        for tick in range(-min(200, ticks), ticks):  # the first ones warm up
            if tick % length == 0:
                steps = {name: begin() for name, begin in ways.items()}
            for name, step in steps.items():
                began = perf_counter()
                step(dt)
                taken[name][tick] = 1e3 * (perf_counter() - began)
    return taken


def _in_cpp(
    package: Path, situation: Situation, dt: float, ticks: int, settings: Settings
) -> Iterator[Row]:
    """Measure the example in C++, where it can be built."""
    folder = settings.out / "deployment_cpp"
    if not (shutil.which("cmake") and shutil.which("g++")):
        return
    root = f"-DTORCH_ROOT={Path(torch.__file__).parent}"
    for command in (["-S", EXAMPLE, "-B", folder, root], ["--build", folder]):
        subprocess.run(["cmake", *command], check=True, capture_output=True)
    poses = [
        number
        for frame in situation.frames.values()
        for number in (*frame.position.tolist(), *frame.orientation.tolist())
    ]
    done = subprocess.run(
        [folder / "estimate_loop", package, str(dt), str(ticks)],
        input=" ".join(map(str, [*situation.joints.tolist(), *poses])),
        capture_output=True,
        text=True,
        check=True,
    )
    found = re.search(
        r"an estimate takes ([\d.]+) ms, 99 % of them less than ([\d.]+)", done.stderr
    )
    assert found is not None, done.stderr
    work, (middle, worst) = f"tick, {WORK}, exported estimate, C++", map(float, found.groups())
    yield Row(f"{work}: median", "ms", middle, asked=settings.target("most", 0.1), rounds=ticks)
    limit = settings.target("most", 1.0)
    yield Row(f"{work}: 99th percentile", "ms", worst, asked=limit, rounds=ticks)

"""A controller written as a compiled package."""

from __future__ import annotations

import json
import warnings
from dataclasses import fields
from pathlib import Path

import torch

from tpgmm_torch.atomic import replacing
from tpgmm_torch.control.clocks import Clock, EvenClock, WaitingClock
from tpgmm_torch.control.compiled_tick import CompiledRegression, check_compiler
from tpgmm_torch.control.exported import FORMAT, here
from tpgmm_torch.control.exported_tick import ExportedTick
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.regression import Regression

__all__ = ["export"]


def export(
    regression: Regression,
    path: str | Path,
    *,
    begin: float,
    end: float,
    blend: float,
    bounds: MotionBounds,
    clock: Clock,
) -> None:
    """Write what ``load_exported`` reads; atomically.

    Parameters
    ----------
    regression : Regression
    path : str or Path
    begin, end, blend : float
        As for the controller [s].
    bounds : MotionBounds
    clock : Clock

    Raises
    ------
    DependencyError
        If there is no C++ compiler.
    DataError
        If the model or the clock is of another kind than a graph serves.
    """
    check_compiler("inductor", "export")
    if type(clock) is not EvenClock and type(clock) is not WaitingClock:
        raise DataError(
            f"export() serves EvenClock and WaitingClock, got {clock!r}: run other clocks with "
            "controller()"
        )
    settings = {field.name: getattr(regression, field.name) for field in fields(Regression)}
    regression = CompiledRegression(**settings)
    names = regression.served_frames
    tick = ExportedTick(regression, names, begin, end, blend, bounds, clock)
    count = regression.kinematics.n_joints
    double = torch.float64
    inputs = (
        torch.zeros(tick.size, dtype=double),
        torch.tensor(0.001, dtype=double),
        torch.zeros(count, dtype=double),
        torch.zeros(len(names), 7, dtype=double),
    )
    contents = {
        **here(),
        "format": FORMAT,
        "state_size": tick.size,
        "joints": regression.kinematics.joint_names,
        "frames": names,
        "begin": begin,
        "end": end,
        "clock": repr(clock),
        "bounds": {
            field.name: getattr(bounds, field.name).tolist() for field in fields(MotionBounds)
        },
    }
    # numbers by themselves, for who reads no JSON
    sizes = {"state_size": tick.size, "n_joints": count, "n_frames": len(names)}
    told = {"tpgmm": json.dumps(contents), **{key: str(size) for key, size in sizes.items()}}
    with (
        torch.inference_mode(False),
        torch.no_grad(),
        warnings.catch_warnings(),
        replacing(path) as file,
    ):
        warnings.simplefilter("ignore")  # of what torch asks of itself
        program = torch.export.export(tick, inputs)
        package = file.with_name("tick.pt2")  # the name that it must have
        torch._inductor.aoti_compile_and_package(
            program,
            package_path=str(package),
            inductor_configs={"aot_inductor.metadata": told},
        )
        package.rename(file)

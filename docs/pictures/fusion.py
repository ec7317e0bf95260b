"""Picture of the page "Mathematics": the two forms of the product over epsilon."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from tpgmm_control import rollout
from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_tools.plotting import ORANGE
from tpgmm_torch import Frame, Situation, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.metrics import largest_acceleration
from tpgmm_torch.regression.fusion_forms import CovarianceFusion

__all__ = ["draw"]

EPSILONS = np.logspace(-8, 0, 9)
N_SITUATIONS = 10


def draw(out: Path) -> None:
    """Write ``epsilon.svg``: error at the grasp and largest acceleration of both forms."""
    skill = BottleShaking(rate=25)
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(
        skill.demonstrations(10)
    )
    instant = float(np.mean([one.events["grasp"] for one in aligned]))
    contact = int(torch.searchsorted(aligned[0].time, instant))
    # nothing after the grasp is looked at
    time = aligned[0].time[: contact + 1]
    situations = [
        Situation(one.joints, one.frames, time) for one in skill.situations(N_SITUATIONS, 1000)
    ]
    bottles = Frame.stack([situation.frames["bottle"] for situation in situations])
    model = TaskParameterizedGMM(30, bottle_operators(), skill.robot).fit(aligned)

    def measure(form: Any) -> tuple[float, float]:
        motions = rollout(form, situations, bounds="robot", blend=1.0)
        last = torch.stack([motion.joints[-1] for motion in motions])
        apart, _ = skill.grasp_error(last, bottles)
        fastest = [largest_acceleration(motion) for motion in motions]
        return 1e3 * float(apart.median()), float(np.median(fastest))

    information = measure(model.skill)
    printed_forms = (
        replace(model.skill, fusion=CovarianceFusion(float(epsilon))) for epsilon in EPSILONS
    )
    covariance = [measure(form) for form in printed_forms]

    drawing = Figure(figsize=(8.4, 3.2), layout="constrained")
    panels = drawing.subplots(1, 2)
    titles = ("grasp error, median [mm]", "largest acceleration, median [rad/s²]")
    for axes, title, right, printed in zip(
        panels, titles, information, zip(*covariance, strict=True), strict=True
    ):
        axes.axhline(right, color="black", label="information form")
        axes.plot(EPSILONS, printed, "o-", color=ORANGE, label="covariance form")
        axes.set(xscale="log", yscale="log", title=title, xlabel=r"$\epsilon$ [rad²]")
        axes.grid(which="major", color="0.9")
    panels[0].legend()
    drawing.savefig(out / "epsilon.svg")

"""Pictures of the page "Reproducing the paper": figures 3 to 6 as ``tpgmm demo`` draws them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_tools.paper.figures import draw_figures
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping

__all__ = ["draw"]


def draw(out: Path) -> None:
    """Write ``figure_3.png`` to ``figure_6.png``; 25 steps per second are enough."""
    skill = BottleShaking(rate=25)
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(
        skill.demonstrations(10)
    )
    [situation] = skill.situations(1, 1000)
    events = {
        name: float(np.mean([one.events[name] for one in aligned]))
        for name in ("grasp", "shake", "rest")
    }
    spans = {"reach": (0.0, events["grasp"]), "shake": (events["shake"], events["rest"])}
    models = [
        TaskParameterizedGMM(30, bottle_operators(orientation), skill.robot).fit(aligned)
        for orientation in (True, False)
    ]
    motions = [model.predict([situation])[0] for model in models]
    draw_figures(out, models[0], aligned, *motions, situation, spans, ("png",))

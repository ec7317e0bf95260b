"""The paper's experiment as what is to be reproduced: two hands, 17 joints, K = 10, P = 2."""

from collections.abc import Callable
from functools import cache
from typing import Any

from benchmarks.settings import Settings
from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.skills.compiled import compile_skill

__all__ = [
    "COMPONENTS",
    "align_demonstrations",
    "compile_estimate",
    "fit_model",
    "model",
    "skill",
]

COMPONENTS = 10


@cache
def skill(settings: Settings) -> BottleShaking:
    """Make the generator, at 100 Hz in full size."""
    return BottleShaking(rate=settings.size(100, 10))


@cache
def align_demonstrations(settings: Settings) -> list[Demonstration]:
    """Align its demonstrations in time."""
    demonstrations = skill(settings).demonstrations(settings.size(10, 3), settings.seed)
    return DynamicTimeWarping(features=["directions"]).fit_transform(demonstrations)


def model(
    settings: Settings, n_components: int = COMPONENTS, **options: object
) -> TaskParameterizedGMM:
    """Make the model that learns it."""
    operators, robot = bottle_operators(), skill(settings).robot
    return TaskParameterizedGMM(n_components, operators, robot, **options)


@cache
def fit_model(
    settings: Settings, n_components: int = COMPONENTS, dtype: str = "float64"
) -> TaskParameterizedGMM:
    """Fit the model, which is not to be changed."""
    return model(settings, n_components, dtype=dtype).fit(align_demonstrations(settings))


def compile_estimate(
    settings: Settings, fitted: TaskParameterizedGMM, n_robots: int = 1
) -> Callable[..., Any]:
    """Compile the step of a model; at tiny sizes, what is asked is only whether it runs."""
    backend = "inductor" if settings.full else "aot_eager"
    return compile_skill(fitted.skill, n_robots, backend).estimate

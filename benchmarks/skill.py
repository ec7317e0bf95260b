"""The paper's experiment as what is to be reproduced: two hands, 17 joints, K = 10, P = 2."""

from functools import cache

from benchmarks.settings import Settings
from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping

__all__ = ["COMPONENTS", "aligned", "learned", "model", "skill"]

COMPONENTS = 10


@cache
def skill(settings: Settings) -> BottleShaking:
    """The generator, at 100 Hz in full size."""
    return BottleShaking(rate=settings.size(100, 10))


@cache
def aligned(settings: Settings) -> list[Demonstration]:
    """Its demonstrations, on one time grid."""
    demonstrations = skill(settings).demonstrations(settings.size(10, 3), settings.seed)
    return DynamicTimeWarping(features=["directions"]).fit_transform(demonstrations)


def model(
    settings: Settings, n_components: int = COMPONENTS, **options: object
) -> TaskParameterizedGMM:
    """What learns it."""
    operators, robot = bottle_operators(), skill(settings).robot
    return TaskParameterizedGMM(n_components, operators, robot, **options)


@cache
def learned(
    settings: Settings, n_components: int = COMPONENTS, dtype: str = "float64"
) -> TaskParameterizedGMM:
    """The model; not to be changed."""
    return model(settings, n_components, dtype=dtype).fit(aligned(settings))

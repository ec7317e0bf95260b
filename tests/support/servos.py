"""Robots that run a skill on a clock: what a controller does, and nothing else."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from tpgmm_torch import Frame
from tpgmm_torch.control.clocks import Clock, Progress
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.skills.skill import Observation

#: What happens to robots at a time since the start, in place of what their servos do.
Disturbance = Callable[[float, Tensor], Tensor]


@dataclass
class Run:
    """Robots with servos of first order that follow a skill.

    ``times``, ``references``, ``measured`` and ``relocalized`` hold what was at every tick.
    """

    regression: Regression
    clock: Clock
    begin: float
    end: float
    joints: Tensor
    frames: dict[str, Frame] = field(default_factory=dict)
    dt: float = 0.04
    lag: float = 0.07
    noise: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        self.random = torch.Generator().manual_seed(self.seed)
        self.progress: Progress = self.clock.start(
            self.regression, self.joints, self.frames, self.begin, self.end
        )
        self.passed = 0.0
        self.estimate = self._tick(self.joints)
        self.times: list[Tensor] = [self.progress.time]
        self.references, self.measured = [self.reference], [self.joints]
        self.relocalized: list[Tensor] = []

    @property
    def reference(self) -> Tensor:
        return self.estimate.joints

    def _tick(self, last: Tensor) -> object:
        return self.regression.estimate(self.progress.time, last, self.frames)

    def tick(self, disturbance: Disturbance | None = None, seen: bool = True) -> None:
        """The servos run, the clock looks, the next reference is found."""
        left = torch.exp(torch.tensor(-self.dt / self.lag, dtype=torch.float64))
        self.joints = self.reference + left * (self.joints - self.reference)
        self.passed += self.dt
        if disturbance is not None:
            self.joints = disturbance(self.passed, self.joints)
        noise = torch.randn(self.joints.shape, generator=self.random, dtype=torch.float64)
        measured = self.joints + self.noise * noise
        observation = Observation(
            measured if seen else None, self.reference, None, self.frames, self.estimate
        )
        self.progress = self.progress.advance(self.dt, observation)
        self.estimate = self._tick(self.reference)
        self.times.append(self.progress.time)
        self.references.append(self.reference)
        self.measured.append(self.joints)
        self.relocalized.append(self.progress.relocalized)

    def run(
        self, seconds: float, disturbance: Disturbance | None = None, seen: bool = True
    ) -> None:
        for _ in range(round(seconds / self.dt)):
            self.tick(disturbance, seen)

    def finish(self, most: float = 60.0) -> float:
        """Until the end, at most for some seconds; how long it took since the start."""
        while not bool(self.progress.finished.all()) and self.passed < most:
            self.tick()
        return self.passed


def held(at: Tensor) -> Disturbance:
    """Somebody holds the robots."""
    return lambda passed, joints: at


def between(begin: Tensor, end: Tensor, at: Tensor | None = None) -> Disturbance:
    """From some times of their own on, robots are held: where they are, or elsewhere."""
    places: list[Tensor] = [] if at is None else [at]

    def disturbance(passed: float, joints: Tensor) -> Tensor:
        if not places:
            places.append(torch.full_like(joints, torch.nan))
        inside = ((passed > begin) & (passed < end))[..., None]
        places[0] = torch.where(inside & places[0].isnan(), joints, places[0])
        return torch.where(inside, places[0], joints)

    return disturbance

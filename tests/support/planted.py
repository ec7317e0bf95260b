"""Tasks of which it is known what matters: a tracked hand that minds one or two of 8 frames."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import Demonstration, Frame, quaternions
from tpgmm_torch.robots import Poses

HAND = Poses(["hand"])
NAMES = tuple("abcdefgh")
DURATION, STEPS = 15.0, 101
#: Noise of a sensor: frames stand somewhere else [m, rad], the hand's path trembles.
FRAME_NOISE, PATH_NOISE = (0.002, 0.026), (0.001, 0.004)


def turn(rng: np.random.Generator, most: float) -> Tensor:
    axis = rng.normal(size=3)
    return quaternions.exp(torch.from_numpy(axis / np.linalg.norm(axis) * rng.uniform(0, most)))


@dataclass(frozen=True)
class PlantedTask:
    """From home to a pose in each frame that matters, to rest there, and home again."""

    seed: int
    n_relevant: int

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        relevant = tuple(NAMES[i] for i in sorted(rng.choice(8, self.n_relevant, False)))
        goals = [Frame(rng.uniform(-0.1, 0.1, 3), turn(rng, 1.0)) for _ in relevant]
        home = Frame([0.0, 0.0, 0.5], turn(rng, 0.3))
        for name, value in (("relevant", relevant), ("goals", goals), ("home", home)):
            object.__setattr__(self, name, value)

    def demonstrations(
        self, n: int = 5, seed: int = 0, noise: bool = True
    ) -> list[Demonstration]:
        """All frames stand and are turned at random, and are seen a little wrong."""
        rng = np.random.default_rng((self.seed, seed))
        return [self._demonstration(rng, noise) for _ in range(n)]

    def _demonstration(self, rng: np.random.Generator, noise: bool) -> Demonstration:
        frames = {name: Frame(rng.uniform(-0.3, 0.3, 3), turn(rng, 0.8)) for name in NAMES}
        start = Frame(
            self.home.position + 0.03 * torch.from_numpy(rng.normal(size=3)),
            quaternions.product(turn(rng, 0.2), self.home.orientation),
        )
        stops = [
            frames[name].compose(goal)
            for name, goal in zip(self.relevant, self.goals, strict=True)
        ]
        path = Frame.stack(list(self._path([start, *stops, self.home])))
        if noise:
            far, turned = FRAME_NOISE
            frames = {
                name: Frame(
                    frame.position + far * torch.from_numpy(rng.normal(size=3)),
                    quaternions.product(turn(rng, turned), frame.orientation),
                )
                for name, frame in frames.items()
            }
            far, turned = PATH_NOISE
            shake = torch.from_numpy(rng.normal(size=(STEPS, 7)))
            path = Frame(
                path.position + far * shake[:, :3],
                quaternions.normalize(path.orientation + turned * shake[:, 3:]),
            )
        joints = Poses.joints({"hand": path})
        time = torch.linspace(0, DURATION, STEPS, dtype=torch.float64)
        return Demonstration(time, joints, frames, HAND.joint_names)

    def _path(self, stops: list[Frame]) -> Iterator[Frame]:
        """Minimum jerk from one to the next, the last tenth of each leg at rest."""
        legs = len(stops) - 1
        for phase in np.linspace(0, legs, STEPS):
            leg = min(int(phase), legs - 1)
            s = min((phase - leg) / 0.8, 1.0)
            s = s**3 * (10 - 15 * s + 6 * s * s)
            begin, end = stops[leg], stops[leg + 1]
            towards = quaternions.match_hemisphere(end.orientation, begin.orientation)
            yield Frame(
                begin.position + s * (end.position - begin.position),
                quaternions.slerp(begin.orientation, towards, torch.tensor(s)),
            )


def told(task: PlantedTask) -> set[str]:
    """Texts of the operators that matter."""
    kinds = ("position", "orientation")
    return {f"{kind}:hand@{frame}" for frame in task.relevant for kind in kinds}

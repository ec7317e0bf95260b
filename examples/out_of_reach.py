"""How a robot fares with bottles that were never shown, many of them out of reach.

Bottles stand up to half a metre outside the box in which they were demonstrated, each as far
from its nearest point as a draw says. The robots of a batch

1. run the whole skill by the clock. Counted are reversals, ticks at which a joint's velocity
   changes its sign with more than 1 rad/s before and after, and ticks beyond the bounds of
   speed and acceleration;
2. run it up to the grasp, where time stands for some seconds more, so that they come to rest as
   near to the bottle as they get. Their distance is sqrt(2 F), F the mean cost of the fused
   Gaussians, in units of what demonstrations allow; it is compared with the best of many
   starts, drawn between the limits of the joints, from each of which it is minimised.

    python examples/out_of_reach.py --bottles 200

Of the bottles that can be reached the distance says nothing: shares are of the others, whose
nearest posture is more than 100 standard deviations away.
"""

import argparse
import warnings

import numpy as np
import torch
from torch import Tensor

from tpgmm_control import Clock, Controller
from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_torch import Frame, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.regression.posture import PostureCost, descend

#: When the hands are at the bottle, shortly before it is moved [s].
GRASP = 4.4
DT = 0.01
#: A velocity that counts as a reversal's [rad/s].
FAST = 1.0
#: Distances below are those of bottles in reach.
REACHED = 100.0


def outside(n: int, seed: int, most: float) -> Frame:
    """Bottles up to so far outside the box of those demonstrated [m], turned as they were."""
    rng, skill = np.random.default_rng(seed), BottleShaking()
    inside = skill.bottle_poses(n, rng)
    lowest, highest = torch.tensor([skill.lowest, skill.highest], dtype=torch.float64)
    far = inside.position + torch.from_numpy(rng.standard_normal((n, 3)))
    nearest = torch.clamp(far, lowest, highest)
    away = torch.nn.functional.normalize(far - nearest, dim=-1)
    distance = torch.from_numpy(rng.uniform(0, most, (n, 1)))
    return Frame(nearest + distance * away, inside.orientation)


def learned(n_demonstrations: int = 10, n_components: int = 30) -> TaskParameterizedGMM:
    """The skill from generated demonstrations."""
    demonstrations = BottleShaking().demonstrations(n_demonstrations, seed=0)
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(demonstrations)
    model = TaskParameterizedGMM(n_components, bottle_operators(), BottleShaking().robot)
    return model.fit(aligned)


def played(model: TaskParameterizedGMM, bottles: Frame, ticks: int, stop: bool) -> Tensor:
    """References of all robots at each tick, (ticks, n, 17).

    Time may stop at the grasp: it is not passed before the joints arrive, and they stay.
    """
    starts = BottleShaking().neutral_posture().expand(len(bottles.position), -1)
    clock = Clock("even", arrivals=(GRASP,) if stop else ())
    controller = Controller(model.skill, starts, {"bottle": bottles}, clock=clock)
    joints = starts if stop else None
    with torch.inference_mode():
        return torch.stack([controller.step(DT, joints).reference for _ in range(ticks)])


def calm(model: TaskParameterizedGMM, references: Tensor) -> dict[str, float]:
    """Reversals, and the largest speed and acceleration as shares of their bounds."""
    bounds = model.skill.motion_bounds
    assert bounds is not None
    speed = references.diff(dim=0) / DT
    acceleration = speed.diff(dim=0) / DT
    slower = torch.minimum(speed[1:].abs(), speed[:-1].abs())
    reversals = (speed[1:] * speed[:-1] < 0) & (slower > FAST)
    return {
        "reversals": int(reversals.sum()),
        "robots with one": int(reversals.any(0).any(-1).sum()),
        "speed": float((speed.abs() / bounds.velocity).max()),
        "acceleration": float((acceleration.abs() / bounds.acceleration).max()),
    }


def distances(
    model: TaskParameterizedGMM, bottles: Frame, joints: Tensor, starts: int, steps: int
) -> tuple[Tensor, Tensor]:
    """Where robots are (n,), and the least from many starts (n,)."""
    regression, robot = model.skill, BottleShaking().robot
    time, frames = torch.tensor(GRASP, dtype=torch.float64), {"bottle": bottles}
    activation = regression.estimate(time, joints, frames).activation
    search, state = regression.posture_search(), regression.kinematics.state
    weights = activation.expand(len(joints), -1)
    cost = PostureCost(search, weights, time, joints, frames, state)
    generator = torch.Generator().manual_seed(1)
    share = torch.rand(starts, *joints.shape, generator=generator, dtype=torch.float64)
    many = (robot.lower + (robot.upper - robot.lower) * share).expand(2, -1, -1, -1)
    damping = torch.zeros(many.shape[1:-1], dtype=torch.float64)
    for _ in range(steps):
        many, damping, height = descend(cost, many, damping, robot.lower, robot.upper)
    # from where they are, too: nobody is nearer than the nearest
    here = cost(joints[None, None])[0][0, 0]
    least = torch.minimum(height.amin(0), here)
    return (2 * here).sqrt(), (2 * least).sqrt()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--bottles", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--most", type=float, default=0.5, help="metres outside the box")
    parser.add_argument("--rest", type=float, default=4.0, help="seconds at the grasp")
    parser.add_argument("--starts", type=int, default=60, help="of the minimisation")
    parser.add_argument("--steps", type=int, default=50, help="of each")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of bottles that nobody has shown
    model = learned()
    bottles = outside(options.bottles, options.seed, options.most)
    whole = played(model, bottles, len(model.time_) + round(0.5 / DT), False)
    print("whole skill:", calm(model, whole), flush=True)
    stops = played(model, bottles, round((GRASP + options.rest) / DT), True)
    print("up to the grasp:", calm(model, stops), flush=True)
    moving = float((stops[-1] - stops[-2]).abs().max() / DT)
    here, least = distances(model, bottles, stops[-1], options.starts, options.steps)
    far = least > REACHED
    excess = (here / least - 1)[far]
    print(
        f"at the end they move by at most {moving:.3f} rad/s; of {int(far.sum())} bottles out "
        f"of reach {int((excess <= 0.05).sum())} are approached to within 5 % of the nearest "
        f"distance, {int((excess <= 0.12).sum())} to within 12 %; median excess "
        f"{100 * float(excess.median()):.2f} %, largest {100 * float(excess.max()):.0f} %"
    )

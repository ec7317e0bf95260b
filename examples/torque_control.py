"""Torque motors: how hard a robot hits what it does not expect, stiff and by the model.

The bottle is shaken with torque motors under gravity (the environment ``bottle_torque``), once
with the stiffness of position control, and once with the one that the model gives: firm where
demonstrations agree, soft where they do not. Both get the same references. Then an upright
post stands in the way of a hand, and nothing announces it to the robot.

    python examples/torque_control.py --seeds 50 --post 1

It needs the plugin with its extra ``environments``. Printed is how many of the episodes without
the post succeed, and the largest contact force of each of those with it: median and range.
"""

import argparse

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_env_bimanual.bottle.conditions import skill
from lerobot_env_bimanual.bottle.torque import BottleTorqueEnv
from tpgmm_control.impedance.stiffness import Impedance
from tpgmm_datasets.bottle.skill import bottle_operators
from tpgmm_torch import Frame, Situation, TaskParameterizedGMM, Trajectory
from tpgmm_torch.alignment import DynamicTimeWarping

FPS = 50
#: Gains of position control [N m/rad, N m s/rad].
STIFF = np.repeat((1000.0, 30.0), 17)


def learned(n_demonstrations: int = 10, n_components: int = 30) -> TaskParameterizedGMM:
    """The skill from generated demonstrations."""
    demonstrations = skill().demonstrations(n_demonstrations, seed=0)
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(demonstrations)
    # the covariance as it was demonstrated: with what few demonstrations leave open added to
    # it, arms are so soft after the grasp that they sag under the bottle
    model = TaskParameterizedGMM(
        n_components, bottle_operators(), skill().robot, covariance_shrinkage=0
    )
    return model.fit(aligned)


def gains(trajectory: Trajectory) -> NDArray[np.float64]:
    """Stiffness and damping of the joints by the model, (T, 34)."""
    rule = Impedance(skill().robot).joints
    stiffness = rule.matrix(trajectory.covariance).diagonal(dim1=-2, dim2=-1)
    return torch.cat((stiffness, rule.diagonal_damping(stiffness)), -1).numpy()


def episode(
    env: BottleTorqueEnv, model: TaskParameterizedGMM, soft: bool, seed: int
) -> dict[str, float]:
    """What the environment says at the end of an episode."""
    observation, _ = env.reset(seed=seed)
    pose = observation["environment_state"]
    situation = Situation(observation["agent_pos"], {"bottle": Frame(pose[:3], pose[3:])})
    [trajectory] = model.predict([situation], candidates=False)
    references = trajectory.joints.numpy()
    impedance = gains(trajectory) if soft else np.tile(STIFF, (len(references), 1))
    actions = np.concatenate((references, impedance), axis=1)
    for step in range(env.episode_length):
        now = np.searchsorted(trajectory.time.numpy(), (step + 1) / env.fps)
        *_, info = env.step(actions[min(now, len(actions) - 1)])
    return info


def compare(seeds: int, post: float) -> dict[str, tuple[int, NDArray[np.float64]]]:
    """Successes without the post, and peak forces with it, of each controller."""
    model, results = learned(), {}
    free, blocked = (BottleTorqueEnv(fps=FPS, obstacle=seconds) for seconds in (0.0, post))
    for name, soft in (("stiff", False), ("by the model", True)):
        nominal = [episode(free, model, soft, seed) for seed in range(seeds)]
        hit = [episode(blocked, model, soft, seed) for seed in range(seeds)]
        successes = sum(bool(info["is_success"]) for info in nominal)
        results[name] = successes, np.array([info["peak_contact_N"] for info in hit])
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=10, help="episodes of each kind")
    parser.add_argument("--post", type=float, default=1.0, help="seconds until it gives way")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for name, (successes, peaks) in compare(options.seeds, options.post).items():
        print(
            f"{name:>12}: {successes} of {options.seeds} succeed; peak contact force "
            f"{np.median(peaks):.0f} N ({peaks.min():.0f} to {peaks.max():.0f})"
        )

"""The experts of the suite in their environments."""

import sys

import numpy as np
import torch

from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.names import ROBOTS

#: Robots that can be tried: by the version, not by what is installed, as gym-aloha cannot be
#: installed on Python 3.13; on Python 3.12 a missing package fails.
TRIED = [name for name in ROBOTS if name != "viperx" or sys.version_info < (3, 13)]


def start_of(motion):
    """The options with which an episode begins as a demonstration does."""
    poses = {
        name: torch.cat((frame.position, frame.orientation)).numpy()
        for name, frame in motion.frames.items()
    }
    return {**poses, "joints": motion.joints[0].numpy()}


def replay(env: SuiteEnv, motion, references=None, seed=0, seconds=None, **start):
    """Send a demonstration's joints as references, and hold the last; the last ``info``.

    Parameters
    ----------
    motion : Demonstration
        At the environment's rate.
    references : ndarray of shape (T, n_joints), optional
        To send others.
    seconds : float, optional
        To stop before the end of the episode.
    **start
        Poses of objects that are not those of the demonstration.
    """
    references = motion.joints.numpy() if references is None else references
    env.reset(seed=seed, options={**start_of(motion), **start})
    ticks = env.episode_length if seconds is None else round(seconds * env.fps)
    for k in range(1, ticks + 1):
        *_, info = env.step(references[min(k, len(references) - 1)])
    return info


def tick(motion, event):
    """The time step at which a phase ends."""
    return int(np.searchsorted(motion.time.numpy(), motion.events[event]))


def missed(task, figures):
    """The criteria of a task that are not met."""
    return {key for key, f in task.figures.items() if not f.low <= figures[key] <= f.high}

"""Made-up episodes of Meta-World's hand."""

import numpy as np

from lerobot_env_bimanual.metaworld.demonstrations import Recorded


def reaching(seed, n_steps=60):
    """An episode that goes straight to the goal and closes the hand half way."""
    generator = np.random.default_rng(seed)
    start = np.array([0.0, 0.6, 0.2])
    goal = generator.uniform((-0.1, 0.8, 0.1), (0.1, 0.9, 0.3))
    share = np.linspace(0, 1, n_steps)[:, None]
    path = start + (3 * share**2 - 2 * share**3) * (goal - start)
    grip = (share < 0.5).astype(float)
    poses = np.zeros((3, 7))
    poses[:, 3], poses[0, :3], poses[2, :3] = 1, generator.uniform(0.3, 0.5, 3), goal
    observed = np.hstack((path, grip, np.tile(poses.ravel(), (n_steps, 1))))
    actions = np.hstack((np.gradient(path, axis=0) / 0.01, 1 - 2 * grip))
    return Recorded(seed, observed, np.hstack((path, grip)), actions, True)

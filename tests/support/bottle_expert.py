"""Someone who can do the bottle's tasks in whatever condition: the generator, looking."""

import numpy as np

#: Joints that are further from where they should be than this were not brought there by us.
ELSEWHERE = 0.12


def nominal(env):
    """References (T, 17) of the nominal path for the bottle where it stands."""
    path = env._nominal()
    time = np.arange(0, float(path.time[-1]) + 1e-9, 1 / env.fps)
    return np.stack(
        [np.interp(time, path.time.numpy(), column) for column in path.joints.numpy().T], axis=1
    )


def perform(env, seed, looking=True):
    """An episode's last ``info``: with the even clock, or going on from where the robot is."""
    observation, info = env.reset(seed=seed)
    path, bottle, last = nominal(env), env._start.poses["bottle"], env._start.poses["bottle"]
    at, then, over = 0.0, 0.0, False
    while not over:
        now, joints = observation["timestamp"][0], observation["agent_pos"]
        passed, then = (now - then) * env.fps, now
        gaps = np.abs(path - joints).max(axis=1)
        if not looking:
            at += 1
        elif gaps[round(at)] < ELSEWHERE / 2:
            at += passed
        elif gaps[round(at)] > ELSEWHERE and gaps.min() < ELSEWHERE:
            at = float(gaps.argmin())
        standing, rests = env._standing(), np.allclose(env._standing(), last, atol=1e-4)
        last = standing
        if looking and rests and np.linalg.norm(standing - bottle) > 0.01:
            bottle, path = standing, nominal(env)
        at = min(at, len(path) - 1.0)
        action = path[min(round(at) + 1, len(path) - 1)]
        if looking:  # at a bearable speed where it has some way to go
            action = joints + np.clip(action - joints, -3 / env.fps, 3 / env.fps)
        observation, _, _, over, info = env.step(action - env._sag)  # knows how joints sag
    return info

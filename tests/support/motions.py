"""Generated motions of which the true phase is known."""

from types import SimpleNamespace

import numpy as np
import torch

from tpgmm_torch import quaternions
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.robots.tracked_poses import Poses

NOMINAL = 13.0


EVENTS = {"grasped": 3.0, "shake": 8.0, "rest": 12.0}


def ease(s, start, end):
    u = np.clip((s - start) / (end - start), 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def motion(s, start, goal):
    """Reach until 3, hold until 5, bring until 8, shake two joints at 1 Hz until 12."""
    joints = start + np.outer(ease(s, 0, 3), goal) - np.outer(ease(s, 5, 8), 0.6 * goal)
    envelope = ease(s, 8, 8.6) * (1 - ease(s, 11.4, 12))
    joints[:, 2:4] += (0.25 * envelope * np.sin(2 * np.pi * (s - 8)))[:, None]
    return joints


def random_clock(rng, duration, rate=100.0, strength=0.15):
    """Time and the nominal phase s(t) reached: smooth, increasing, both ends fixed."""
    time = np.arange(round(duration * rate) + 1) / rate
    u = time / time[-1]
    speed = np.ones_like(u)
    for k in (1, 2, 3):
        speed += strength * rng.uniform(-1, 1) * np.cos(np.pi * k * u + rng.uniform(0, 6))
    phase = np.concatenate(([0], np.cumsum((speed[1:] + speed[:-1]) / 2)))
    return time, NOMINAL * phase / phase[-1]


def generate(n=10, seed=0, rate=100.0):
    """Demonstrations and the true phase at each of their time steps."""
    rng = np.random.default_rng(seed)
    goal = np.array([0.8, -0.5, 0.6, 0.7, 1.0])
    demonstrations, phases = [], []
    for scale in rng.permutation(np.linspace(0.85, 1.15, n)):
        time, phase = random_clock(rng, NOMINAL * scale, rate)
        own = goal + rng.uniform(-0.1, 0.1, 5)
        joints = motion(phase, rng.uniform(-0.05, 0.05, 5), own)
        events = {name: np.interp(s, phase, time) for name, s in EVENTS.items()}
        frames = {"bottle": Frame(rng.uniform(-0.2, 0.2, 3))}
        demonstrations.append(Demonstration(time, joints, frames, tuple("abcde"), events))
        phases.append(phase)
    return demonstrations, phases


class Arm:
    """What the alignment needs of a robot, and nothing else: two links of a planar arm."""

    links = ("elbow", "hand")

    def state(self, joints):
        turn = joints[:, 0] + joints[:, 2]
        elbow = torch.stack((joints[:, 0].cos(), joints[:, 0].sin(), 0 * turn), 1)
        hand = elbow + torch.stack((turn.cos(), turn.sin(), joints[:, 4]), 1)
        return SimpleNamespace(position=lambda link: {"elbow": elbow, "hand": hand}[link])


def turning(time, phase):
    """One rotating frame and one hand pose, both a function of the phase in [0, 1]."""
    angle = torch.from_numpy(2.5 * phase)
    turn = quaternions.exp(angle[:, None] * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64))
    place = np.stack((np.sin(3 * phase), phase, phase**2), 1)
    poses = torch.cat((torch.from_numpy(place), turn), 1)
    return Demonstration(
        time, poses, {"moving": Frame(place, turn)}, Poses(["hand"]).joint_names
    )


DEMONSTRATIONS, PHASES = generate()

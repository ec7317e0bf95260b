"""Demonstrations by keyboard in the simulated robot, written as a LeRobot data set.

    python examples/teleoperate.py out/mine --episodes 10
    tpgmm fit out/mine --robot upper_body --link l_hand --link r_hand --out out/skill

A window shows the robot. While a key is down, both hands move, or turn about the middle between
them:

====== ============================== ====== ==============================
keys   the hands go                   keys   the hands go
====== ============================== ====== ==============================
w, s   ahead, back                    e, q   together, apart
a, d   to the left, to the right      i, k   turn down, up
r, f   up, down                       j, l   turn to the left, to the right
====== ============================== ====== ==============================

It is for reaching, grasping and lifting: both hands close when both palms are at the bottle.
Grasps are coarser than what the environment counts as a success, and no key shakes.

Enter ends an episode and keeps it, backspace throws it away, escape ends the program. It needs
the plugin with its extra ``environments``, a screen for the window, and EGL or OSMesa to draw.
"""

import argparse
from collections.abc import Callable, Iterator, Set
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_policy_tpgmm.environments.bottle.shaking import BottleShakingEnv
from lerobot_policy_tpgmm.evaluation.benchmarks import BottleBenchmark
from tpgmm_datasets import save_lerobot
from tpgmm_torch import Demonstration, Frame, Robot

FPS = 25
#: Of the hands while a key is down [m/s], [rad/s].
SPEED, TURNING = 0.12, 0.6
#: Of the inverse kinematics: weight of standing still, and of the posture at the start [1/s].
DAMPING, POSTURE = 0.02, 0.5
#: What a key adds to the left hand's velocity, linear above angular; "mirrored" keys have the
#: opposite linear part for the right hand.
KEYS = {
    "w": (SPEED, 0, 0, 0, 0, 0),
    "s": (-SPEED, 0, 0, 0, 0, 0),
    "a": (0, SPEED, 0, 0, 0, 0),
    "d": (0, -SPEED, 0, 0, 0, 0),
    "r": (0, 0, SPEED, 0, 0, 0),
    "f": (0, 0, -SPEED, 0, 0, 0),
    "e": (0, -SPEED, 0, 0, 0, 0),
    "q": (0, SPEED, 0, 0, 0, 0),
    "i": (0, 0, 0, 0, TURNING, 0),
    "k": (0, 0, 0, 0, -TURNING, 0),
    "j": (0, 0, 0, 0, 0, TURNING),
    "l": (0, 0, 0, 0, 0, -TURNING),
}
MIRRORED = {"e", "q"}
HANDS = ("l_hand", "r_hand")


def hand_velocities(keys: Set[str]) -> NDArray[np.float64]:
    """What the keys that are down ask of both hands, (2, 6); other keys do nothing."""
    asked = np.zeros((2, 6))
    for key in keys & KEYS.keys():
        left = np.array(KEYS[key], dtype=float)
        asked += left, (-left if key in MIRRORED else left)
    return asked


class Teleoperation:
    """Leads the joints so that the hands move as asked, and the arms stay as they began.

    Parameters
    ----------
    robot : Robot
        With the links ``HANDS``.
    joints : array of shape (n_joints,)
        Where it stands [rad].
    period : float
        Of a step [s].
    """

    def __init__(
        self, robot: Robot, joints: NDArray[np.float64], period: float = 1 / FPS
    ) -> None:
        self._robot, self._period, self._rest = robot, period, joints.copy()
        self.reference = joints.copy()

    def step(self, keys: Set[str]) -> NDArray[np.float64]:
        """The next reference: damped least squares, within the limits of the joints."""
        state = self._robot.state(torch.from_numpy(self.reference))
        rows = [state.linear_jacobian(hand) for hand in HANDS]
        turns = [state.angular_jacobian(hand) for hand in HANDS]
        stacked = [part for pair in zip(rows, turns, strict=True) for part in pair]
        jacobian = torch.cat(stacked).numpy()
        n = len(self.reference)
        gain = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + DAMPING**2 * np.eye(12))
        asked = hand_velocities(keys)
        places = np.stack([state.position(hand).numpy() for hand in HANDS])
        asked[:, :3] += np.cross(asked[:, 3:], places - places.mean(axis=0))
        velocity = gain @ asked.ravel()
        if keys & KEYS.keys():  # back to the posture, as far as the hands do not notice
            velocity += POSTURE * (np.eye(n) - gain @ jacobian) @ (self._rest - self.reference)
        fastest = self._robot.velocity.numpy()
        velocity = np.clip(velocity, -fastest, fastest)
        lower, upper = self._robot.lower.numpy(), self._robot.upper.numpy()
        self.reference = np.clip(self.reference + velocity * self._period, lower, upper)
        return self.reference


def episode(
    env: BottleShakingEnv,
    keys_down: Callable[[], Set[str] | None],
    seed: int,
    shown: Callable[[BottleShakingEnv], object] = lambda env: None,
) -> Demonstration:
    """What a person does with the keys, until ``keys_down`` gives None or time is up.

    The demonstration has the measured joints, and the pose of the bottle at the start.
    """
    observation, _ = env.reset(seed=seed)
    pose = observation["environment_state"]
    robot = BottleBenchmark(rate=env.fps).robot
    hands = Teleoperation(robot, observation["agent_pos"], 1 / env.fps)
    measured, over = [observation["agent_pos"]], False
    while not over and (keys := keys_down()) is not None:
        observation, _, ended, cut, _ = env.step(hands.step(keys))
        measured.append(observation["agent_pos"])
        shown(env)
        over = ended or cut
    return Demonstration(
        np.arange(len(measured)) / env.fps,
        np.array(measured),
        {"bottle": Frame(pose[:3], pose[3:])},
        joint_names=env.joint_names,
    )


class Window:
    """Shows the robot, and knows which keys are down."""

    def __init__(self) -> None:
        from matplotlib import pyplot

        self._plot, self.down, self.last = pyplot, set[str](), ""
        for name in ("keymap.save", "keymap.quit", "keymap.fullscreen", "keymap.home"):
            pyplot.rcParams[name] = []  # they are ours
        self._figure, axes = pyplot.subplots()
        axes.set_axis_off()
        self._picture = axes.imshow(np.zeros((240, 320, 3), np.uint8))
        self._figure.canvas.mpl_connect("key_press_event", self._pressed)
        self._figure.canvas.mpl_connect("key_release_event", self._released)

    def _pressed(self, event: Any) -> None:
        self.last = event.key
        self.down.add(event.key)

    def _released(self, event: Any) -> None:
        self.down.discard(event.key)

    def keys(self) -> Set[str] | None:
        """Those that are down; None once the episode is ended."""
        return None if self.last in ("enter", "backspace", "escape") else set(self.down)

    def show(self, env: BottleShakingEnv) -> None:
        """Draw, and wait a moment."""
        self._picture.set_data(env.render())
        self._plot.pause(0.5 / FPS)


def record(n_episodes: int, seed: int) -> Iterator[Demonstration]:
    """Episodes that were kept, with the bottle elsewhere in each."""
    env, window = BottleShakingEnv(fps=FPS, render_mode="rgb_array"), Window()
    kept = 0
    while kept < n_episodes and window.last != "escape":
        window.last = ""
        one = episode(env, window.keys, seed, window.show)
        if window.last in ("", "enter"):
            yield one
            kept += 1
        seed += 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="of the data set; must not exist")
    parser.add_argument("--episodes", type=int, default=10, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="of the first bottle")
    options = parser.parse_args()
    torch.set_num_threads(1)
    shown = list(record(options.episodes, options.seed))
    if shown:
        save_lerobot(
            shown, options.folder, fps=FPS, task="teleoperated", robot_type="upper_body"
        )
        print(f"{len(shown)} episodes in {options.folder}")

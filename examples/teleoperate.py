"""Demonstrations by keyboard or gamepad in the simulated robot, written as a LeRobot data set.

    python examples/teleoperate.py out/mine --episodes 10 --gamepad
    tpgmm fit out/mine --robot upper_body --link l_hand --link r_hand --out out/skill

A window shows the robot. While a key is down, or a stick is held, both hands move, or turn
about the middle between them: as fast as sticks and triggers are pushed.

====== ============================== ================================
keys   gamepad                        the hands go
====== ============================== ================================
w, s   left stick up, down            ahead, back
a, d   left stick left, right         to the left, to the right
r, f   right trigger, left trigger    up, down
e, q   right bumper, left bumper      together, apart
i, k   right stick down, up           turn down, up
j, l   right stick left, right        turn to the left, to the right
====== ============================== ================================

It is for reaching, grasping and lifting: both hands close when both palms are at the bottle.
Grasps are coarser than what the environment counts as a success, and no key shakes.

Enter (A) ends an episode and keeps it, backspace (B) throws it away, escape (start) ends the
program. The names are those of an Xbox controller; on others the same places count. Keys work
beside a gamepad, too.

It needs the plugin with its extra ``environments``, for a gamepad ``teleoperation``, a screen
for the window, and EGL or OSMesa to draw.
"""

import argparse
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_env_bimanual.bottle.shaking import BottleShakingEnv
from tpgmm_datasets import save_lerobot
from tpgmm_evaluation.benchmarks import BottleBenchmark
from tpgmm_torch import Demonstration, Frame, Robot
from tpgmm_torch.exceptions import DependencyError

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
#: Axes of a gamepad, by SDL's numbers, with the keys that their two directions stand for.
#: Right and down are positive, and triggers have one direction.
STICKS = {0: ("d", "a"), 1: ("s", "w"), 2: ("l", "j"), 3: ("i", "k")}
AXES = STICKS | {4: ("f", "f"), 5: ("r", "r")}
#: Buttons, likewise: the bumpers; and A, B and start, which end an episode.
BUTTONS = {9: "q", 10: "e"}
ENDS = {0: "enter", 1: "backspace", 6: "escape"}
#: Share of a stick's way in which it is taken to be let go.
DEAD_ZONE = 0.15
HANDS = ("l_hand", "r_hand")


def hand_velocities(pressed: Mapping[str, float]) -> NDArray[np.float64]:
    """What keys ask of both hands, (2, 6), each as far as it is pressed, from 0 to 1.

    Other keys do nothing.
    """
    asked = np.zeros((2, 6))
    for key in pressed.keys() & KEYS.keys():
        left = pressed[key] * np.array(KEYS[key], dtype=float)
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

    def step(self, pressed: Mapping[str, float]) -> NDArray[np.float64]:
        """The next reference: damped least squares, within the limits of the joints."""
        state = self._robot.state(torch.from_numpy(self.reference))
        rows = [state.linear_jacobian(hand) for hand in HANDS]
        turns = [state.angular_jacobian(hand) for hand in HANDS]
        stacked = [part for pair in zip(rows, turns, strict=True) for part in pair]
        jacobian = torch.cat(stacked).numpy()
        n = len(self.reference)
        gain = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + DAMPING**2 * np.eye(12))
        asked = hand_velocities(pressed)
        moving = asked.any()
        places = np.stack([state.position(hand).numpy() for hand in HANDS])
        asked[:, :3] += np.cross(asked[:, 3:], places - places.mean(axis=0))
        velocity = gain @ asked.ravel()
        if moving:  # back to the posture, as far as the hands do not notice
            velocity += POSTURE * (np.eye(n) - gain @ jacobian) @ (self._rest - self.reference)
        fastest = self._robot.velocity.numpy()
        velocity = np.clip(velocity, -fastest, fastest)
        lower, upper = self._robot.lower.numpy(), self._robot.upper.numpy()
        self.reference = np.clip(self.reference + velocity * self._period, lower, upper)
        return self.reference


def episode(
    env: BottleShakingEnv,
    pressed: Callable[[], Mapping[str, float] | None],
    seed: int,
    shown: Callable[[BottleShakingEnv], object] = lambda env: None,
) -> Demonstration:
    """What a person does with keys or a gamepad, until ``pressed`` gives None or time is up.

    The demonstration has the measured joints, and the pose of the bottle at the start.
    """
    observation, _ = env.reset(seed=seed)
    pose = observation["environment_state"]
    robot = BottleBenchmark(rate=env.fps).robot
    hands = Teleoperation(robot, observation["agent_pos"], 1 / env.fps)
    measured, over = [observation["agent_pos"]], False
    while not over and (keys := pressed()) is not None:
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


class Gamepad:
    """A gamepad, in the layout of an Xbox controller whatever its make: SDL knows the wires.

    Raises
    ------
    DependencyError
        If pygame is not installed.
    SystemExit
        If there is no gamepad, or only devices whose layout SDL does not know.
    """

    def __init__(self) -> None:
        # the window is matplotlib's: SDL has none, and is to listen all the same
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ["SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS"] = "1"
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            with warnings.catch_warnings():  # of pkg_resources, which pygame imports
                warnings.simplefilter("ignore")
                import pygame
                from pygame._sdl2 import controller
        except ImportError:
            raise DependencyError(
                "a gamepad needs pygame: pip install 'lerobot_env_bimanual[teleoperation]'"
            ) from None
        pygame.display.init()
        controller.init()
        self._pygame = pygame
        devices = range(controller.get_count())
        known = [device for device in devices if controller.is_controller(device)]
        if not known:
            found = f"{len(devices)} whose layout SDL does not know" if devices else "none"
            raise SystemExit(
                f"error: no gamepad: {found} connected; connect one, or leave out --gamepad"
            )
        self._pad = controller.Controller(known[0])

    def ended(self) -> str:
        """The last of the keys in :data:`ENDS` that a button stood for since the last call."""
        events, last = self._pygame.event, ""
        for event in events.get(self._pygame.CONTROLLERBUTTONDOWN):
            last = ENDS.get(event.button, last)
        events.clear(pump=False)  # of others, which nobody fetches
        return last

    def pressed(self) -> dict[str, float]:
        """Keys that sticks, triggers and bumpers stand for, each with how far it is pressed."""
        self._pygame.event.pump()
        asked = dict[str, float]()
        for axis, directions in AXES.items():
            value = self._pad.get_axis(axis) / 32767
            far = (abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE)
            if far > 0:
                asked[directions[value < 0]] = min(far, 1.0)
        return asked | {
            key: 1.0 for button, key in BUTTONS.items() if self._pad.get_button(button)
        }


class Window:
    """Shows the robot, and knows what is pressed.

    Parameters
    ----------
    gamepad : Gamepad, optional
        To listen to, beside the keys.
    """

    def __init__(self, gamepad: Gamepad | None = None) -> None:
        from matplotlib import pyplot

        self._plot, self._down, self.last = pyplot, set[str](), ""
        self._gamepad = gamepad
        for name in ("keymap.save", "keymap.quit", "keymap.fullscreen", "keymap.home"):
            pyplot.rcParams[name] = []  # they are ours
        self._figure, axes = pyplot.subplots()
        axes.set_axis_off()
        self._picture = axes.imshow(np.zeros((240, 320, 3), np.uint8))
        self._figure.canvas.mpl_connect("key_press_event", self._pressed)
        self._figure.canvas.mpl_connect("key_release_event", self._released)

    def _pressed(self, event: Any) -> None:
        self.last = event.key
        self._down.add(event.key)

    def _released(self, event: Any) -> None:
        self._down.discard(event.key)

    def pressed(self) -> Mapping[str, float] | None:
        """What is pressed, each how far, from 0 to 1; None once the episode is ended."""
        asked = dict.fromkeys(self._down, 1.0)
        if self._gamepad:
            self.last = self._gamepad.ended() or self.last
            asked = self._gamepad.pressed() | asked
        return None if self.last in ENDS.values() else asked

    def show(self, env: BottleShakingEnv) -> None:
        """Draw, and wait a moment."""
        self._picture.set_data(env.render())
        self._plot.pause(0.5 / FPS)


def record(window: Window, n_episodes: int, seed: int) -> Iterator[Demonstration]:
    """Episodes that were kept, with the bottle elsewhere in each."""
    env = BottleShakingEnv(fps=FPS, render_mode="rgb_array")
    kept = 0
    while kept < n_episodes and window.last != "escape":
        window.last = ""
        one = episode(env, window.pressed, seed, window.show)
        if window.last not in ("backspace", "escape"):
            yield one
            kept += 1
        seed += 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="of the data set; must not exist")
    parser.add_argument("--episodes", type=int, default=10, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="of the first bottle")
    parser.add_argument("--gamepad", action="store_true", help="listen to a gamepad, too")
    options = parser.parse_args()
    torch.set_num_threads(1)
    window = Window(Gamepad() if options.gamepad else None)
    shown = list(record(window, options.episodes, options.seed))
    if shown:
        save_lerobot(
            shown, options.folder, fps=FPS, task="teleoperated", robot_type="upper_body"
        )
        print(f"{len(shown)} episodes in {options.folder}")

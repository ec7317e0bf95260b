"""Teleoperation, with keys that a script presses and a gamepad that SDL pretends."""

import ctypes
import runpy
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_env_bimanual.bottle.shaking import BottleShakingEnv
from tests.support.command_line import UPPER_BODY, output
from tests.support.worlds import upper_body
from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_torch import Canonical, RelativePosition, Situation, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.exceptions import DependencyError

EXAMPLE = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "teleoperate.py"))
START = np.array(BottleShakingEnv(fps=25).reset(seed=0)[0]["agent_pos"])


def hands(joints) -> np.ndarray:
    """Positions of both hands, (2, 3)."""
    state = upper_body().state(torch.as_tensor(joints))
    return np.stack([state.position(hand).numpy() for hand in EXAMPLE["HANDS"]])


@pytest.mark.parametrize(("key", "left", "right"), [
    ("w", (1, 0, 0), (1, 0, 0)),
    ("d", (0, -1, 0), (0, -1, 0)),
    ("r", (0, 0, 1), (0, 0, 1)),
    ("e", (0, -1, 0), (0, 1, 0)),
    ("q", (0, 1, 0), (0, -1, 0)),
])  # fmt: skip
def test_a_key_moves_the_hands_where_it_says(key, left, right):
    leading = EXAMPLE["Teleoperation"](upper_body(), START, 0.02)
    for _ in range(10):
        joints = leading.step({key: 1.0})
    moved = (hands(joints) - hands(START)) / 0.2
    np.testing.assert_allclose(moved, EXAMPLE["SPEED"] * np.array([left, right]), atol=0.02)


def test_without_keys_and_with_others_it_stands():
    leading = EXAMPLE["Teleoperation"](upper_body(), START)
    np.testing.assert_array_equal(leading.step({}), START)
    np.testing.assert_allclose(leading.step({"x": 1.0, "shift": 1.0}), START, atol=1e-12)


def test_half_of_the_way_is_half_as_fast():
    asked = EXAMPLE["hand_velocities"]
    np.testing.assert_allclose(asked({"w": 0.5, "e": 0.5}), asked({"w": 1.0, "e": 1.0}) / 2)


def test_references_keep_limits_whatever_is_pressed():
    robot = upper_body()
    leading = EXAMPLE["Teleoperation"](robot, START, 0.2)
    last = START
    for _ in range(60):
        joints = leading.step(dict.fromkeys("wrqi", 1.0))
        assert (joints >= robot.lower.numpy()).all() and (joints <= robot.upper.numpy()).all()
        assert (np.abs(joints - last) <= robot.velocity.numpy() * 0.2 + 1e-9).all()
        last = joints


def test_episodes_become_a_data_set_that_is_learned(tmp_path):
    env = BottleShakingEnv(fps=25)
    script = [{"w": 1.0}] * 20 + [{"w": 1.0, "r": 1.0}] * 15 + [{"e": 1.0}] * 10 + [None]
    shown = [EXAMPLE["episode"](env, iter(script).__next__, seed) for seed in range(4)]
    assert {len(one) for one in shown} == {46}
    starts = torch.stack([one.frames["bottle"].position for one in shown])
    assert bool((starts.std(0) > 1e-3).all())
    save_lerobot(shown, tmp_path / "set", fps=25, task="reach", robot_type="upper_body")
    read = load_lerobot(tmp_path / "set", robot=upper_body())
    aligned = DynamicTimeWarping(robot=upper_body()).fit_transform(read)
    operators = [RelativePosition("l_hand", "bottle"), Canonical()]
    model = TaskParameterizedGMM(6, operators, upper_body()).fit(aligned)
    [trajectory] = model.predict([Situation(shown[0].joints[0], shown[0].frames)])
    np.testing.assert_allclose(
        hands(trajectory.joints[-1]), hands(shown[0].joints[-1]), atol=0.05
    )


class VirtualGamepad:
    """An Xbox controller that only SDL knows, by SDL's own interface for it."""

    def __init__(self) -> None:
        with warnings.catch_warnings():  # of pkg_resources, which pygame imports
            warnings.simplefilter("ignore")
            import pygame
            from pygame._sdl2 import controller
        # what pygame has loaded already, so it is told the same
        [library] = Path(pygame.__file__).parents[1].glob("pygame.libs/libSDL2-2*")
        self._sdl = ctypes.CDLL(str(library))
        self._sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
        pygame.display.init()
        controller.init()
        self._number = self._sdl.SDL_JoystickAttachVirtual(1, 6, 15, 0)
        self._joystick = ctypes.c_void_p(self._sdl.SDL_JoystickOpen(self._number))
        for trigger in (4, 5):
            self.push(trigger, -1.0)
        pygame.event.pump()

    def push(self, axis: int, value: float) -> None:
        """A stick from -1 to 1, or a trigger from -1, where it is let go, to 1."""
        raw = ctypes.c_int16(round(32767 * value))
        assert self._sdl.SDL_JoystickSetVirtualAxis(self._joystick, axis, raw) == 0

    def press(self, button: int, down: bool = True) -> None:
        """A button, or let it go."""
        raw = ctypes.c_uint8(down)
        assert self._sdl.SDL_JoystickSetVirtualButton(self._joystick, button, raw) == 0

    def unplug(self) -> None:
        self._sdl.SDL_JoystickDetachVirtual(self._number)


@pytest.fixture
def virtual(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
    gamepad = VirtualGamepad()
    yield gamepad
    gamepad.unplug()


@pytest.mark.parametrize(("axis", "value", "key", "far"), [
    (0, 1.0, "d", 1.0),
    (0, -1.0, "a", 1.0),
    (1, -1.0, "w", 1.0),
    (1, 0.575, "s", 0.5),  # half of what is outside the dead zone
    (2, -1.0, "j", 1.0),
    (3, 1.0, "i", 1.0),
    (4, 1.0, "f", 1.0),
    (5, 1.0, "r", 1.0),
])  # fmt: skip
def test_a_stick_stands_for_a_key_as_far_as_it_is_pushed(virtual, axis, value, key, far):
    pad = EXAMPLE["Gamepad"]()
    assert pad.pressed() == {}
    virtual.push(axis, value)
    assert pad.pressed() == pytest.approx({key: far}, abs=1e-3)
    virtual.push(axis, 0.1 if axis < 4 else -0.9)
    assert pad.pressed() == {}


def test_bumpers_close_and_open_the_hands_and_an_unplugged_gamepad_stands_still(virtual):
    pad = EXAMPLE["Gamepad"]()
    virtual.press(10)
    assert pad.pressed() == {"e": 1.0}
    virtual.press(10, down=False)
    virtual.press(9)
    assert pad.pressed() == {"q": 1.0}
    virtual.push(1, -1.0)
    virtual.unplug()
    assert pad.pressed() == {}


@pytest.mark.parametrize(("button", "key"), [(0, "enter"), (1, "backspace"), (6, "escape")])
def test_a_button_ends_an_episode_once(virtual, button, key):
    pad = EXAMPLE["Gamepad"]()
    assert pad.ended() == ""
    virtual.press(button)
    assert pad.ended() == key
    assert pad.ended() == ""  # it is still down: that is no second end
    virtual.press(button, down=False)
    assert pad.ended() == ""


def test_without_a_gamepad_it_says_so(virtual):
    virtual.unplug()
    with pytest.raises(SystemExit, match="no gamepad: none connected"):
        EXAMPLE["Gamepad"]()


def test_without_pygame_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(DependencyError, match="teleoperation"):
        EXAMPLE["Gamepad"]()


def test_a_gamepad_records_episodes_that_the_command_line_learns(virtual, tmp_path):
    script = [(1, -1.0, None)] * 15 + [(5, 0.5, None)] * 10 + [(1, -0.2, 10)] * 5

    class Scripted(EXAMPLE["Window"]):
        """After each tick the gamepad is as the script says; it keeps all but the second."""

        ticks, episodes = 0, 0

        def show(self, env):
            if self.ticks == len(script):
                virtual.press(1 if self.episodes == 1 else 0)
                self.ticks, self.episodes = 0, self.episodes + 1
                return
            for button in (0, 1, 10):
                virtual.press(button, down=False)
            axis, value, button = script[self.ticks]
            virtual.push(axis, value)
            if button is not None:
                virtual.press(button)
            self.ticks += 1

    window = Scripted(EXAMPLE["Gamepad"]())
    shown = list(EXAMPLE["record"](window, 3, 0))
    assert window.episodes == 4
    assert {len(one) for one in shown} == {len(script) + 2}
    for one in shown:
        gone = hands(one.joints[-1]) - hands(one.joints[0])
        assert (gone[:, 0] > 0.03).all() and (gone[:, 2] > 0.01).all()
    save_lerobot(shown, tmp_path / "set", fps=25, task="reach", robot_type="upper_body")
    few = ("--n-components", 3, "--alignment", "linear", "--plausibility", "ignore")
    output("fit", tmp_path / "set", *UPPER_BODY, *few, "--out", tmp_path / "skill")
    assert (tmp_path / "skill").is_dir()

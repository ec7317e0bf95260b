r"""
A grasp that is tried again
===========================

Pick, place, home: three skills, each learned from five demonstrations of its own, become one
:class:`~tpgmm_torch.Sequence`. It goes on to the next skill when the end of the one before is
*seen* to be what the next one needs, and tries again, from where the cup is then, if it is not.
"""

# sphinx_gallery_thumbnail_number = 1
from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
import torch

from tpgmm_control import Controller
from tpgmm_tools.plotting import STYLE
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    Hold,
    RelativePosition,
    Sequence,
    TaskParameterizedGMM,
)
from tpgmm_torch.robots import Poses

# %%
# Three skills
# ------------
# A tracked hand, without a robot. Each skill begins at time 0 of its own demonstrations: those
# of ``place`` begin with the cup in the hand, 10 cm up.

HAND = Poses(["hand"], orientation=False)
FPS, UP, START = 25, np.array([0, 0, 0.1]), np.array([0, 0, 0.3])
generator = np.random.default_rng(0)


def way(*stops):
    """A minimum-jerk path through (time, place)."""
    time = np.arange(0, 2.01, 1 / FPS)
    path = np.repeat([stops[0][1]], len(time), axis=0)
    for (begin, one), (end, other) in pairwise(stops):
        s = np.clip((time - begin) / (end - begin), 0, 1)[:, None]
        path = path + s**3 * (10 - 15 * s + 6 * s**2) * (other - one)
    return time, path


def demonstrate(name):
    cup, tray = generator.uniform((0.3, 0.1, 0), (0.4, 0.2, 0)), np.array([0.35, -0.15, 0])
    near, holds = generator.normal(0, 0.01, 3), []
    if name == "pick":
        time, path = way((0, START + near), (1.0, cup), (1.5, cup), (1.9, cup + UP))
        holds, held, free = [Hold("cup", "hand", begin=1.3)], time >= 1.3, cup
    elif name == "place":
        time, path = way((0, cup + UP), (1.0, tray), (1.4, tray), (1.9, tray + UP + near))
        holds, held, free = [Hold("cup", "hand", end=1.3)], time < 1.3, tray
    else:
        time, path = way((0, tray + UP + near), (1.7, START))
        held, free = time < 0, tray
    frames = {"cup": Frame(np.where(held[:, None], path, free)), "tray": Frame(tray)}
    return Demonstration(time, path, frames, HAND.joint_names, holds=holds)


matters = {
    "pick": [RelativePosition("hand", "cup")],
    "place": [RelativePosition("hand", "tray"), RelativePosition("cup", "tray", held=True)],
    "home": [],
}
skills = {}
for name, operators in matters.items():
    model = TaskParameterizedGMM(8, [*operators, Canonical()], HAND)
    skills[name] = model.fit([demonstrate(name) for _ in range(5)]).skill

# %%
# One skill of the three
# ----------------------
# ``held`` asks whether the cup is where the hand carries it.

text = "pick until held retry 2, place until free, home until arrived"
skill = Sequence.parse(text, skills)
for gate in skill.gates:
    print(f"{gate.time:.1f} s  {gate.name} until {gate.until}, {gate.retries} retries")

# %%
# Two grasps that fail
# --------------------
# The first two times that the hand closes, it pushes the cup 4 cm aside.

cup, tray, hand = np.array([0.33, 0.13, 0.0]), np.array([0.35, -0.15, 0.0]), START
frames = {"cup": Frame(cup), "tray": Frame(tray)}
controller = Controller(skill, torch.from_numpy(hand), frames, smoothing=None)
fails, holds, closed, log, said = 2, False, False, [], ""
while not controller.finished:
    frames = {"cup": Frame(cup), "tray": Frame(tray)}
    command = controller.step(1 / FPS, torch.from_numpy(hand), frames)
    before, hand = hand, command.reference.numpy()
    cup = cup + holds * (hand - before)
    rests = np.linalg.norm(hand - before) < 5e-4 and np.linalg.norm(hand - cup) < 5e-3
    if rests and not closed and hand[1] > 0:
        closed, holds = True, fails == 0
        cup, fails = cup + (fails > 0) * np.array([0.04, 0, 0]), max(fails - 1, 0)
    closed = closed and hand[2] < 0.05
    holds = holds and not (hand[1] < 0 and rests)
    log.append((hand, cup, float(command.time), str(command.status)))
    if command.status != said:
        said = command.status
        print(f"{len(log) / FPS:5.1f} s  {said} {command.reason()}")

# %%
# The height of hand and cup, and how far the skill is. Grey: it waits. Twice it goes back to
# the beginning of ``pick``.

plt.style.use(STYLE)
hands, cups, progress, status = (np.array(each) for each in zip(*log, strict=True))
seconds = np.arange(len(log)) / FPS
figure, (above, below) = plt.subplots(2, figsize=(7, 4.5), sharex=True, layout="constrained")
above.plot(seconds, 100 * hands[:, 2], label="hand")
above.plot(seconds, 100 * cups[:, 2], label="cup")
above.set(ylabel="height [cm]")
below.plot(seconds, progress)
for gate in skill.gates:
    below.axhline(gate.time, color="0.6", linestyle=":")
    below.annotate(f"{gate.name} until {gate.until[0]}", (0, gate.time), va="bottom")
below.set(xlabel="time [s]", ylabel="progress [s]", ylim=(0, 1.12 * skill.end))
for axis in (above, below):
    low, high = axis.get_ylim()
    axis.fill_between(seconds, low, high, status == "waiting", color="0.85", linewidth=0)
    axis.set_ylim(low, high)
above.legend(loc="upper left", bbox_to_anchor=(1, 1))
plt.show()

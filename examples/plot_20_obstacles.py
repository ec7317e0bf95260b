r"""
Around an obstacle
==================

A skill knows nothing of what stands in its way. A controller that is given a scene keeps its
references clear of it, as long as it must, and goes back to the skill.
"""

# sphinx_gallery_thumbnail_number = 1
import warnings

import matplotlib.pyplot as plt
import numpy as np
import torch

from tpgmm_control import Controller
from tpgmm_control.obstacles import Scene, Shape, find_contacts
from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_tools.plotting import BLUE, STYLE, VERMILION
from tpgmm_torch import TaskParameterizedGMM

warnings.simplefilter("ignore")
torch.set_num_threads(1)
dt, duration = 0.04, 4.6

# %%
# A skill for two hands
# ---------------------
# Both hands of an upper body reach for a bottle.

generator = BottleShaking(rate=10)
demonstrations = generator.demonstrations(5)
model = TaskParameterizedGMM(15, bottle_operators(), generator.robot).fit(demonstrations)
[situation] = generator.situations(1, seed=3)


def run(scene=None):
    """References of a controller, and where hands are."""
    controller = Controller(
        model.skill, situation.joints, situation.frames, trust=None, obstacles=scene
    )
    commands = [controller.step(dt) for _ in range(round(duration / dt))]
    joints = torch.stack([command.reference for command in commands])
    return joints, generator.robot.state(joints).position("l_hand"), commands


free, path, _ = run()

# %%
# A ball where the left hand passes
# ---------------------------------
# The solids of the robot are those of its URDF, which has visual geometry alone. What comes
# near in the demonstrations is allowed, by name.

ball = Shape.sphere("ball", 0.03, path[round(1.9 / dt)])
scene = Scene(generator.robot, [ball], visuals=True).allowing(demonstrations)
print("allowed:", dict(scene.allowed))
time = dt * np.arange(len(free))
print("the skill alone:", *find_contacts(scene, time, free), sep="\n  ")

around, clear, commands = run(scene)
print("with obstacles:", find_contacts(scene, time, around))
print("at 2 s:", commands[round(2.0 / dt)].reason())

# %%
# Distances
# ---------


def distance(joints):
    """Of the ball from what of the robot is nearest [mm]."""
    found = scene.distances(joints, within=0.1)
    return 1e3 * np.min([d for pair, d in found.items() if "ball" in pair], axis=0)


distances = {name: distance(joints) for name, joints in (("alone", free), ("around", around))}
plt.style.use(STYLE)
figure, (side, over) = plt.subplots(1, 2, figsize=(8, 3.4))
for name, way, color in (("alone", path, VERMILION), ("around", clear, BLUE)):
    side.plot(way[:, 1], way[:, 2], color=color)
    over.plot(time, distances[name], color=color, label=f"left hand, {name}")
centre = ball.pose.position
side.add_patch(plt.Circle((centre[1], centre[2]), 0.03, color="0.7"))
side.set(xlabel="y [m]", ylabel="z [m]", aspect="equal")
over.axhline(0, color="0.3", linewidth=0.8)
over.axhline(10, color="0.6", linestyle="--", linewidth=0.8)
over.set(xlabel="time [s]", ylabel="robot to ball [mm]")
over.legend()
figure.tight_layout()

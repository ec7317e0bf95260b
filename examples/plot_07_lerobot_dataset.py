r"""
A LeRobot data set of real recordings
=====================================

From a folder in LeRobot's format to a reproduction, and an honest number for it. Real
recordings are large, so none comes with the package: give this script the path of yours,

.. code-block:: bash

    python plot_07_lerobot_dataset.py path/to/dataset

Without a path it generates a small set, writes it to disk, and reads that. Nothing is known
here about the robot, so the skill is learned in joint space; with a URDF and the poses of
objects the operators of the other examples apply.
"""

# sphinx_gallery_thumbnail_number = 1
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from tpgmm_datasets import describe_lerobot, load_lerobot, save_lerobot
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_tools.plotting import STYLE, VERMILION
from tpgmm_torch import Situation, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.metrics import joint_rmse

torch.set_num_threads(1)  # the matrices are small

# %%
# What is in it
# -------------
# :func:`~tpgmm_datasets.describe_lerobot` reads the description without the data: version,
# rate, features, and problems if there are any.

temporary = tempfile.TemporaryDirectory()
if len(sys.argv) > 1 and "__file__" in globals():  # a notebook's arguments are its kernel's
    folder = Path(sys.argv[1])
else:
    folder = Path(temporary.name) / "bottle"
    skill = BottleShaking(rate=20)
    save_lerobot(skill.demonstrations(5), folder, fps=20, task="shake the bottle")
description = describe_lerobot(folder)
print(f"format {description.version}, problems: {list(description.problems) or 'none'}")

# %%
# Read at most ten episodes, at no more than ten steps per second
# ----------------------------------------------------------------
# Units matter as soon as there is a robot; without one the numbers may stay as they are stored.

demonstrations = load_lerobot(folder, episodes=slice(0, 10), rate=10, units="raw")
durations = [demonstration.duration for demonstration in demonstrations]
names = demonstrations[0].joint_names
temporary.cleanup()
print(
    f"{len(demonstrations)} episodes of {min(durations):.1f} to {max(durations):.1f} s, "
    f"{len(names)} joints"
)

# %%
# Leave one episode out
# ---------------------
# The others are aligned in time and learned from. The episode left out gives its start posture
# and is aligned too, after the prediction, to be compared with.

held_out, *others = demonstrations
clock = DynamicTimeWarping()
aligned = clock.fit_transform(others)
model = TaskParameterizedGMM(20, random_state=0).fit(aligned)
[trajectory] = model.predict([Situation(held_out.joints[0])], candidates=False)
[truth] = clock.transform([held_out])

error = joint_rmse(trajectory, truth)
spread = torch.stack([demonstration.joints for demonstration in aligned]).std(dim=0)
typical = float(spread.square().mean().sqrt())
print(
    f"error of the episode left out: {error:.3f}; "
    f"the other episodes differ from their mean by {typical:.3f}"
)

# %%
# The five joints that move most: recordings (grey), the episode left out (black), and what the
# model makes of its start posture (red). The error is of the size by which the episodes
# differ among themselves: from the joints alone nobody can know where the bottle stands. What
# helps is to tell the model: see the example of competing constraints.

moved = held_out.joints.amax(dim=0) - held_out.joints.amin(dim=0)
most = moved.argsort(descending=True)[:5].tolist()
plt.style.use(STYLE)
figure, panels = plt.subplots(len(most), 1, figsize=(8, 8), sharex=True, layout="constrained")
for axes, joint in zip(panels, most, strict=True):
    for demonstration in aligned:
        axes.plot(demonstration.time, demonstration.joints[:, joint], color="0.75")
    axes.plot(truth.time, truth.joints[:, joint], "k", label="left out")
    axes.plot(trajectory.time, trajectory.joints[:, joint], color=VERMILION, label="model")
    axes.set_ylabel(f"{names[joint]} [rad]", fontsize="small")
panels[0].legend(fontsize="small", loc="upper right")
panels[-1].set_xlabel("time [s]")
plt.show()

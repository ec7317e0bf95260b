r"""
Correcting a skill
==================

A fitted skill is changed in two ways: by a *via-point*, a posture that it shall pass through at
one time, and by a *correction*, a segment that somebody showed and from which it is learned
again, with the demonstrations.
"""

# sphinx_gallery_thumbnail_number = 1
import warnings
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from sklearn.base import clone

from tpgmm_control import rollout
from tpgmm_tools.plotting import BLUE, STYLE, VERMILION
from tpgmm_torch import Demonstration, Situation, TaskParameterizedGMM, ViaPoints
from tpgmm_torch.exceptions import PlausibilityWarning
from tpgmm_torch.skills.via_point import ViaPoint

# %%
# A skill of one joint
# --------------------

time = np.linspace(0, 4, 200)
generator = np.random.default_rng(0)


def demonstrate():
    """A wave, whose height and offset differ."""
    height, offset = generator.normal(1, 0.05), generator.normal(0, 0.05)
    return Demonstration(time, (height * np.sin(1.5 * time) + offset)[:, None])


demonstrations = [demonstrate() for _ in range(6)]
model = TaskParameterizedGMM(n_components=12).fit(demonstrations)
situation = Situation(joints=[0.0], time=time)
[before] = model.predict([situation])

# %%
# A via-point
# -----------
# At second 2 the joint shall be at 0.5. A second before and after that, the skill is as it was.

skill = ViaPoints(model.skill, [ViaPoint(2.0, "canonical", [0.5])])
[through] = rollout(skill, [situation])

# %%
# A correction
# ------------
# Somebody leads the joint lower from second 2.5 to 3.5, on a clock of his own, twice. Where in
# the skill that belongs is found, and the model is learned again, without the two oldest
# demonstrations. It begins where the reproduction is like its beginning, and ends where that
# is like its end; of places that explain both, those count at which it is about as fast.


def in_skill_time(reproduction, shown, max_slope=4.0):
    """Bring a demonstration of the whole skill, or of a part of it, into the skill's time."""
    instants, path = reproduction.time.numpy(), reproduction.joints.numpy()
    begin, end = (((path - q) ** 2).mean(1) / 0.1**2 for q in shown.joints[[0, -1]].numpy())
    lasts = instants[None, :] - instants[:, None]
    # 0.1 rad off cost as much as twice or half the pace
    octaves = np.log2(np.maximum(lasts, 1e-9) / shown.duration)
    cost = begin[:, None] + end[None, :] + octaves**2
    cost[abs(octaves) > np.log2(max_slope)] = np.inf
    first, last = np.unravel_index(cost.argmin(), cost.shape)
    scale = lasts[first, last] / shown.duration
    return replace(shown, time=instants[first] + scale * (shown.time - shown.time[0]))


part = np.linspace(2.5, 3.5, 80)
lower = np.sin(1.5 * part) - 0.4 * np.sin(np.pi * (part - 2.5)) ** 2
shown = Demonstration(1.2 * (part - 2.5), lower[:, None])
again = Demonstration(0.9 * (part - 2.5), lower[:, None] + 0.02)
placed = [in_skill_time(before, one) for one in (shown, again)]
warnings.simplefilter("ignore", PlausibilityWarning)  # segments are shorter than the others
corrected = clone(model).fit([*demonstrations[2:], *placed])
[after] = corrected.predict([situation])
print([f"{float(p.time[0]):.2f} to {float(p.time[-1]):.2f} s" for p in placed])

# %%
# The picture
# -----------
# Bands are one standard deviation: at the via-point nothing is left of it.

plt.style.use(STYLE)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True, layout="constrained")
for axis, bent, title in zip(axes, (through, after), ("via-point", "correction"), strict=True):
    for one, colour, label in ((before, "0.5", "before"), (bent, BLUE, title)):
        mean, std = one.joints[:, 0], one.covariance[:, 0, 0].sqrt()
        axis.plot(time, mean, color=colour, label=label)
        axis.fill_between(time, mean - std, mean + std, color=colour, alpha=0.2)
    axis.set(title=title, xlabel="time [s]")
axes[0].plot(2.0, 0.5, "o", color=VERMILION)
for one in placed:
    axes[1].plot(one.time, one.joints[:, 0], "--", color=VERMILION, linewidth=1)
axes[0].set_ylabel("joint [rad]")
axes[1].legend()
plt.show()

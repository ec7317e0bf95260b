r"""
Parts of a skill
================

Go to the cup, carry it to the tray, and stir there: nobody says where one part ends and the
next begins, and every demonstration takes its own time.
:class:`~tpgmm_torch.structure.segmentation.Segmentation` finds the parts, and
:func:`~tpgmm_torch.structure.fit_parts.fit_parts` learns each with what matters in it.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np

from tpgmm_control import rollout
from tpgmm_tools.plotting import STYLE, plot_parts
from tpgmm_torch import Demonstration, Frame, SelectOperators, Situation, TaskParameterizedGMM
from tpgmm_torch.alignment import EventAlignment
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.robots import Poses
from tpgmm_torch.structure.fit_parts import fit_parts
from tpgmm_torch.structure.segmentation import Segmentation

# %%
# Demonstrations
# --------------
# The hand rests at the cup and at the tray for as long as it likes. While it stirs it turns
# back again and again, which is no stop.

hand = Poses(["hand"], orientation=False)
generator = np.random.default_rng(0)
PLACES = np.array([[0.4, 0.4, 0.0], [0.4, -0.4, 0.0], [0.2, 0.0, 0.3]])


def done(time, begin, end):
    """Minimum jerk from one second to another."""
    s = np.clip((time - begin) / (end - begin), 0, 1)[:, None]
    return s**3 * (10 - 15 * s + 6 * s**2)


def demonstrate():
    lengths = np.array([2, 1, 3, 1, 4]) * generator.uniform(0.8, 1.2, 5)
    reached, leaves, comes, stirs, end = lengths.cumsum()
    time = np.arange(0, end, 0.05)
    cup, tray, lamp = PLACES + generator.uniform(-0.2, 0.2, (3, 3))
    path = done(time, 0, reached) * cup + done(time, leaves, comes) * (tray - cup)
    u = np.clip((time - stirs) / (end - stirs), 0, 1)
    ramp = np.minimum(1, 8 * u) * np.minimum(1, 8 * (1 - u))
    path[:, 1] += 0.05 * ramp * np.sin(6 * np.pi * u)
    path += 0.001 * generator.normal(size=path.shape)
    frames = {"cup": Frame(cup), "tray": Frame(tray), "lamp": Frame(lamp)}
    return Demonstration(time, path, frames), [(reached + leaves) / 2, (comes + stirs) / 2]


shown = [demonstrate() for _ in range(6)]
demonstrations, true = [one for one, _ in shown], np.array([ends for _, ends in shown])

# %%
# Where the parts are
# -------------------
# What demonstrations agree on counts.

segmentation = Segmentation(hand).fit(demonstrations)
print(segmentation.report())
off = np.abs(segmentation.boundaries_ - true).max()
print(f"off by {off:.2f} s at most")

plt.style.use(STYLE)
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
plot_parts(axes, segmentation, demonstrations)
plt.show()

# %%
# One skill of all parts
# ----------------------
# Demonstrations are brought into step at the boundaries. Then each part is learned from its own
# stretch of time, with what matters in it; together they are a
# :class:`~tpgmm_torch.Sequence`, a skill that is run and saved like any other.

named = segmentation.transform(demonstrations)
aligned = EventAlignment(["part *"], robot=hand).fit_transform(named)
cuts = Segmentation(hand).fit(aligned).times()
model = TaskParameterizedGMM(24, robot=hand)
skill = fit_parts(model, aligned, cuts, SelectOperators(robot=hand))
for part in skill.skills:
    texts = ", ".join(map(format_operator, part.operators))
    print(f"{part.begin:5.2f} s  {len(part.log_weights):2d} components  {texts}")

# %%
# A new situation
# ---------------
# The hand's distance to the cup and to the tray. Dotted: where parts begin.

new, _ = demonstrate()
[trajectory] = rollout(skill, [Situation(new.joints[0], new.frames)])
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
time, path, least = trajectory.time.numpy(), trajectory.joints.numpy(), {}
for name in skill.frame_names:
    distance = 1000 * np.linalg.norm(path - new.frames[name].position.numpy(), axis=1)
    least[name] = distance.min()
    axes.plot(time, distance, label=f"{name}: {least[name]:.1f} mm")
for part in skill.skills[1:]:
    axes.axvline(part.begin, color="0.6", linestyle=":")
axes.set(xlabel="time [s]", ylabel="distance [mm]")
axes.legend()
plt.show()

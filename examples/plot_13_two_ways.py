r"""
Two ways around an obstacle
===========================

Some demonstrations pass an obstacle on one side, some on the other. The mean of both goes
through the middle: what a single model learns of them is what nobody ever did.
:class:`~tpgmm_torch.structure.select_ways.SelectWays` finds that there are two ways, learns a
model of each, and goes the way that suits the situation.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np

from tpgmm_control import rollout
from tpgmm_tools.plotting import BLUE, ORANGE, SKY, STYLE, VERMILION
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativePosition,
    Situation,
    TaskParameterizedGMM,
)
from tpgmm_torch.robots import Poses
from tpgmm_torch.structure.select_ways import SelectWays

# %%
# Demonstrations
# --------------
# A tracked hand goes from home to a goal, past an obstacle, by about 10 cm. Obstacle and goal
# stand somewhere else each time. Nobody says who went which way.

hand = Poses(["hand"], orientation=False)
time = np.linspace(0, 3, 60)
generator = np.random.default_rng(0)


def objects():
    """Where the obstacle and the goal stand."""
    obstacle = Frame([generator.uniform(0.2, 0.3), generator.uniform(-0.04, 0.04), 0.0])
    goal = Frame([generator.uniform(0.5, 0.6), generator.uniform(-0.1, 0.1), 0.0])
    return {"obstacle": obstacle, "goal": goal}


def demonstrate(side):
    """A path with three control points: home, beside the obstacle, the goal."""
    frames, s = objects(), time / time[-1]
    s = (s**3 * (10 - 15 * s + 6 * s**2))[:, None]
    home = 0.01 * generator.normal(size=3) * (1, 1, 0)
    goal, obstacle = (frames[name].position.numpy() for name in ("goal", "obstacle"))
    beside = obstacle + np.array([0, side * (0.1 + 0.01 * generator.normal()), 0])
    bend = 2 * beside - (home + goal) / 2  # through which the curve passes half-way
    path = (1 - s) ** 2 * home + 2 * s * (1 - s) * bend + s**2 * goal
    return Demonstration(time, path, frames)


demonstrations = [demonstrate(side) for side in (1, -1, 1, 1, -1, -1, 1, -1, -1, 1)]

# %%
# How many ways
# -------------
# The report says how many there are, who goes which, and where that is plainest.

operators = [
    RelativePosition("hand", "obstacle"),
    RelativePosition("hand", "goal"),
    Canonical(),
]
single = TaskParameterizedGMM(8, operators, hand)
ways = SelectWays(single).fit(demonstrations)
print(ways.report())

# %%
# Which way
# ---------
# In new situations both are possible here, and the choice follows from how often each was
# shown, and where. The single model learns from all demonstrations, too.

single.fit(demonstrations)
situations = [Situation([0.0, 0.0, 0.0], objects()) for _ in range(20)]
print(ways.skill_.choose(situations[0].joints, situations[0].frames)[0])


def clearance(trajectory, situation):
    """The least distance from the obstacle's middle [cm]."""
    obstacle = situation.frames["obstacle"].position
    return 100 * float((trajectory.joints - obstacle).norm(dim=-1).min())


passed = {}
for name, one in (("single model", single.skill), ("two ways", ways.skill_)):
    trajectories = rollout(one, situations)
    passed[name] = found = list(map(clearance, trajectories, situations))
    print(f"{name:<12} passes by {np.median(found):.1f} cm, at least {min(found):.1f} cm")

# %%
# On the left the demonstrations as they are divided, seen from the obstacle. On the right a new
# situation: the single model goes through, each way goes around it.

plt.style.use(STYLE)
figure, (shown, new) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
colors = (BLUE, SKY)  # of the two ways
for demonstration, label in zip(demonstrations, ways.labels_, strict=True):
    path = demonstration.joints - demonstration.frames["obstacle"].position
    shown.plot(*path[:, :2].T, color=colors[label], alpha=0.7)
[situation] = situations[:1]
obstacle, goal = (situation.frames[name].position for name in ("obstacle", "goal"))
for way, color in zip(ways.models_, colors, strict=True):
    [trajectory] = way.predict(situation)
    new.plot(*trajectory.joints[:, :2].T, color=color, label="one way")
[trajectory] = single.predict(situation)
new.plot(*trajectory.joints[:, :2].T, color=VERMILION, linestyle="--", label="single model")
new.plot(*goal[:2], "*", color=ORANGE, markersize=12)
for axes, middle in ((shown, (0, 0)), (new, obstacle[:2])):
    axes.add_patch(plt.Circle(middle, 0.06, color="0.6"))
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
shown.set_title("demonstrations, seen from the obstacle")
new.set_title("a new situation")
new.margins(y=0.35)
new.legend(loc="upper left", fontsize="small")
plt.show()

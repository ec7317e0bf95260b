r"""
Which goes first
================

An arm leans its elbow on a rest while its tip goes to a target. Where the target is too far
from the rest, it cannot do both. By default the operators compromise: each yields as much as
demonstrations differed in what it says. ``priorities`` decides: what has a higher number is
fulfilled as if the others were not there, and these act in what is left of the joints.
"""

# sphinx_gallery_thumbnail_number = 1
import warnings

import matplotlib.pyplot as plt
import numpy as np
import torch

from tpgmm_control import rollout
from tpgmm_tools.plotting import BLUE, GREEN, ORANGE, STYLE, VERMILION
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativePosition,
    Robot,
    Situation,
    TaskParameterizedGMM,
)
from tpgmm_torch.exceptions import PlausibilityWarning
from tpgmm_torch.regression.fusion_forms import InformationFusion

# %%
# Demonstrations
# --------------
# Four joints in the plane. The elbow comes down on the rest, the tip goes to the target; both
# are met to a few millimetres. Rest and target stand somewhere else each time, at most 36 cm
# apart: beyond 40 cm the tip does not reach while the elbow rests.

warnings.simplefilter("ignore", PlausibilityWarning)  # it is meant to be unusual

LINKS = ("base", "upper_arm", "middle", "forearm", "hand", "tip")
urdf = '<robot name="planar arm">' + "".join(f'<link name="{link}"/>' for link in LINKS)
for place, length in enumerate((0.0, 0.3, 0.3, 0.25, 0.15)):
    urdf += f"""
    <joint name="joint_{place + 1}" type="{"revolute" if place < 4 else "fixed"}">
      <parent link="{LINKS[place]}"/><child link="{LINKS[place + 1]}"/>
      <origin xyz="{length} 0 0"/><axis xyz="0 0 1"/>
      <limit lower="-3" upper="3" velocity="3" effort="1"/>
    </joint>"""
# the elbow is where the forearm begins
robot = Robot.from_urdf(
    urdf + "</robot>", links=["upper_arm", "middle", "forearm", "hand", "tip"]
)

time = np.linspace(0, 3, 90)
REST = torch.tensor([2.2, -1.2, -1.0, -0.8], dtype=torch.float64)
MET = ("forearm", "tip")
generator = np.random.default_rng(0)


def place_both(apart):
    """The rest, and a target so far from it."""
    rest = generator.uniform((0.3, 0.15), (0.45, 0.3))
    angle = generator.uniform(-1.2, -0.2)
    target = rest + apart * np.array([np.cos(angle), np.sin(angle)])
    return {"rest": Frame([*rest, 0.0]), "target": Frame([*target, 0.0])}


def demonstrate(frames):
    """Elbow and tip go straight to where they belong, by Gauss-Newton steps."""
    u = torch.from_numpy(np.clip(time / 2, 0, 1))[:, None]
    s = u**3 * (10 - 15 * u + 6 * u**2)
    start = robot.state(REST)
    paths = []
    for link, name in zip(MET, frames, strict=True):
        goal = frames[name].position + torch.tensor([*generator.normal(0, 0.003, 2), 0.0])
        paths.append((1 - s) * start.position(link) + s * goal)
    joints, rows = REST, []
    for points in zip(*paths, strict=True):
        state = robot.state(joints)
        error = [p - state.position(link) for p, link in zip(points, MET, strict=True)]
        jacobian = [state.linear_jacobian(link) for link in MET]
        inverse = torch.linalg.pinv(torch.cat(jacobian), rtol=0.05)
        joints = joints + inverse @ torch.cat(error)
        rows.append(joints)
    return Demonstration(time, torch.stack(rows), frames, robot.joint_names)


demonstrations = [demonstrate(place_both(generator.uniform(0.2, 0.36))) for _ in range(8)]

# %%
# Two models
# ----------
# They differ in nothing but ``priorities``: the tip goes first, then the elbow, and the joints'
# posture counts in what these leave.

operators = [
    RelativePosition("tip", "target"),
    RelativePosition("forearm", "rest"),
    Canonical(),
]
models = {
    name: TaskParameterizedGMM(
        10,
        operators,
        robot,
        fusion=InformationFusion(priorities=priorities),
    ).fit(demonstrations)
    for name, priorities in (("compromise", None), ("the tip first", [2, 1, 0]))
}

# %%
# Farther and farther apart
# -------------------------
# How far tip and elbow are from where they should be, and how fast joints are on the way there:
# the limit is 3 rad/s. Ten situations for each distance.


def misses(trajectory, frames):
    """Of the tip and of the elbow, at the end [mm]."""
    state = robot.state(trajectory.joints[-1])
    goals = (("tip", "target"), ("forearm", "rest"))
    return [1e3 * float((state.position(a) - frames[b].position).norm()) for a, b in goals]


APART = (0.24, 0.3, 0.36, 0.4, 0.44, 0.5)
situations = [[Situation(REST, place_both(apart)) for _ in range(10)] for apart in APART]
found = {name: np.zeros((len(APART), 10, 3)) for name in models}
for name, model in models.items():
    for row, some in enumerate(situations):
        for column, t in enumerate(rollout(model.skill, some, bounds="robot", blend=1.0)):
            speed = float(t.joints.diff(dim=0).abs().max() / time[1])
            found[name][row, column] = (*misses(t, some[column].frames), speed)
        tip, elbow, speed = np.median(found[name][row], axis=0)
        print(
            f"{100 * APART[row]:.0f} cm, {name}: tip {tip:.1f} mm (worst "
            f"{found[name][row, :, 0].max():.0f}), elbow {elbow:.1f} mm, {speed:.1f} rad/s"
        )

# %%
# When to use it
# --------------
# Where one thing must not yield. Beyond what was shown the compromise loses centimetres at the
# tip; with priorities the elbow pays, and the tip arrives. It is no default: joints swing out
# for what goes first, up to their limits of speed, and then they are late: about a tenth of the
# tips miss, some by far. On the left how the arm ends at 50 cm, and where it began.

plt.style.use(STYLE)
figure, (plane, tips, speeds) = plt.subplots(
    1, 3, figsize=(10.5, 3.4), width_ratios=(1.5, 1, 1), layout="constrained"
)
one = situations[APART.index(0.5)][0]
plane.plot(*one.frames["rest"].position[:2], "s", color=GREEN, markersize=14)
plane.plot(*one.frames["target"].position[:2], "*", color=ORANGE, markersize=18)


def draw(joints, **style):
    corners = torch.cat((torch.zeros(1, 3), robot.state(joints).positions))
    plane.plot(*corners[:, :2].T, "o-", markersize=4, **style)


draw(REST, color="0.75")
for (name, model), color in zip(models.items(), (BLUE, VERMILION), strict=True):
    [trajectory] = rollout(model.skill, [one], bounds="robot", blend=1.0)
    draw(trajectory.joints[-1], color=color, label=name)
    for axes, values in ((tips, found[name][..., 0]), (speeds, found[name][..., 2])):
        distances = 100 * np.array(APART)
        axes.plot(distances, np.median(values, axis=1), color=color)
        axes.plot(distances, values, ".", color=color, markersize=3, alpha=0.5)
plane.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
plane.set(title="square: where the elbow rests, star: the target")
plane.margins(y=0.1)
plane.legend(loc="upper right")
tips.set(yscale="log", ylabel="tip off the target [mm]")
speeds.set(ylabel="largest speed of a joint [rad/s]", ylim=(0, 3.3))
for axes in (tips, speeds):
    axes.axvspan(20, 36, color="0.92", zorder=0)
    axes.set(xlabel="target from rest [cm]; grey: shown")
plt.show()

r"""
Is this new to me?
==================

A model answers everywhere, also where nobody showed it anything. How far a situation is from
those that were shown, it says by a number: ``novelty`` of a trajectory, and of each command of
a controller. One is the demonstration that is furthest from the others.
"""

# sphinx_gallery_thumbnail_number = 1
import warnings

import matplotlib.pyplot as plt
import numpy as np
import torch

from tpgmm_control import Controller
from tpgmm_tools.plotting import BLUE, ORANGE, STYLE, VERMILION
from tpgmm_torch import (
    Demonstration,
    Frame,
    RelativePosition,
    Robot,
    Situation,
    TaskParameterizedGMM,
)
from tpgmm_torch.exceptions import PlausibilityWarning

# %%
# A skill that was shown eight times
# ----------------------------------
# A planar arm slides its tip into an object, as in the first example. Objects stood in a box of
# 20 by 30 cm, turned by up to 14 degrees either way.

LINKS, LENGTHS = ("base", "upper_arm", "forearm", "hand", "tip"), (0.0, 0.4, 0.3, 0.2)
urdf = '<robot name="planar arm">' + "".join(f'<link name="{link}"/>' for link in LINKS)
for place, length in enumerate(LENGTHS):
    urdf += f"""
    <joint name="joint_{place + 1}" type="{"revolute" if place < 3 else "fixed"}">
      <parent link="{LINKS[place]}"/><child link="{LINKS[place + 1]}"/>
      <origin xyz="{length} 0 0"/><axis xyz="0 0 1"/>
      <limit lower="-3" upper="3" velocity="3" effort="1"/>
    </joint>"""
robot = Robot.from_urdf(urdf + "</robot>", links=["tip"])

time = np.linspace(0, 2, 60)
REST = torch.tensor([2.2, -1.4, -0.6], dtype=torch.float64)
LOW, HIGH, TURN = np.array([0.45, -0.15]), np.array([0.65, 0.15]), 0.25
generator = np.random.default_rng(0)


def place_object(low=LOW, high=HIGH):
    half = generator.uniform(-TURN, TURN) / 2
    return Frame((*generator.uniform(low, high), 0), (np.cos(half), 0, 0, np.sin(half)))


def demonstrate(target):
    """A curve with three control points: the start, 20 cm before the object, the object."""
    start = robot.state(REST).position("tip")
    before = target.transform(torch.tensor([-0.2, 0.0, 0.0], dtype=torch.float64))
    u = torch.from_numpy(time / 2)[:, None]
    s = u**3 * (10 - 15 * u + 6 * u**2)
    path = (1 - s) ** 2 * start + 2 * s * (1 - s) * before + s**2 * target.position
    joints, rows = REST, []
    for point in path:  # one Gauss-Newton step each
        state = robot.state(joints)
        inverse = torch.linalg.pinv(state.linear_jacobian("tip"))
        joints = joints + inverse @ (point - state.position("tip"))
        rows.append(joints)
    return Demonstration(time, torch.stack(rows), {"object": target}, robot.joint_names)


demonstrations = [demonstrate(place_object()) for _ in range(8)]
model = TaskParameterizedGMM(
    8,
    [RelativePosition("tip", "object")],
    robot,
)
model.fit(demonstrations)

# %%
# Near and far
# ------------
# Each of eight demonstrations and of one new situation like them is as likely to be the
# furthest: novelty is above one at most about once in nine times for what is like them.


warnings.simplefilter("ignore", PlausibilityWarning)  # of what is far outside


def ends(objects):
    """Novelty of each object, and by how much the tip misses it [mm]."""
    situations = [Situation(REST, {"object": one}) for one in objects]
    trajectories = model.predict(situations, candidates=False)
    pairs = zip(trajectories, objects, strict=True)
    tips = [robot.state(t.joints[-1]).position("tip") - one.position for t, one in pairs]
    return np.array([t.novelty for t in trajectories]), 1e3 * torch.stack(tips).norm(
        dim=1
    ).numpy()


inside, _ = ends([place_object() for _ in range(100)])
print(f"objects in the box: above 1 in {(inside > 1).mean():.0%}")

# %%
# Anywhere else
# -------------
# What is new may well succeed: seen from the object, the tip's way is the same everywhere. It
# need not: where the arm does not reach, it fails, and nobody had shown that it would. Novelty
# tells what was shown, and no more.

middle, size = (LOW + HIGH) / 2, HIGH - LOW
objects = [place_object(middle - 2 * size, middle + 2 * size) for _ in range(150)]
novelty, missed = ends(objects)
fails = missed > 10
for name, chosen in (("up to 1", novelty <= 1), ("above 1", novelty > 1)):
    print(f"novelty {name}: {fails[chosen].sum()} of {chosen.sum()} missed by more than 10 mm")

# %%
# While the robot runs
# --------------------
# Somebody pulls the object away while the arm is on its way. ``command.novelty`` is about where
# it is now, and a program can stop, or ask, before anything is missed.

controller = Controller(model.skill, REST, {"object": Frame([0.55, 0, 0])})
joints, record = REST, []
while not controller.finished:
    pulled = 0.4 * np.clip(0.01 * len(record) - 0.5, 0, 1)  # 40 cm in a second [m]
    frames = {"object": Frame([0.55 + pulled, 0.0, 0.0])}
    command = controller.step(0.01, joints=joints, frames=frames)
    joints = command.reference
    record.append((float(command.time), 100 * pulled, float(command.novelty)))
record = np.array(record)
new = int((record[:, 2] > 1).argmax())
print(f"new from {record[new, 0]:.2f} s on, when it was pulled by {record[new, 1]:.0f} cm")

# %%
# On the left novelty of an object anywhere in the plane, the box dashed, and how far the arm
# reaches. On the right what the controller said.

plt.style.use(STYLE)
figure, (plane, axes) = plt.subplots(
    1, 2, figsize=(8, 3.9), width_ratios=(1, 1.1), layout="constrained"
)
x, y = np.meshgrid(np.linspace(0.1, 1.0, 91), np.linspace(-0.65, 0.65, 131))
grid = Frame(np.stack((x, y, 0 * x), axis=-1))
image = plane.contourf(
    x,
    y,
    model.skill.summary.novelty(REST, {"object": grid}),
    np.arange(0, 3.1, 0.25),
    cmap="Blues",
    extend="max",
)
plane.contour(image, levels=[1.0], colors=VERMILION)
plane.add_patch(plt.Rectangle(LOW, *size, fill=False, linestyle="--"))
places = torch.stack([one.frames["object"].position for one in demonstrations])
plane.plot(*places[:, :2].T, "o", color=ORANGE, markeredgecolor="white", label="shown")
places = torch.stack([one.position for one in objects])[fails]
plane.plot(*places[:, :2].T, "x", color="0.2", markersize=5, label="missed")
plane.add_patch(plt.Circle((0, 0), sum(LENGTHS), fill=False, color="0.2", linewidth=0.8))
plane.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", xlim=(0.1, 1.0), ylim=(-0.65, 0.65))
plane.legend(loc="upper left", handlelength=1)
figure.colorbar(image, ax=plane, label="novelty")
axes.plot(record[:, 0], record[:, 2], color=BLUE)
axes.axhline(1.0, color=VERMILION)
axes.axvspan(0.5, 1.5, color="0.9", zorder=0)
axes.annotate("it is pulled away", (1.0, 2.1), ha="center", color="0.4")
axes.set(xlabel="time [s]", ylabel="command.novelty", ylim=(0, 2.3))
plt.show()

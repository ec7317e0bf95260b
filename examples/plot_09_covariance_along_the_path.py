r"""
Covariance along the path
=========================

A reproduction is more than a path: at every instant the model also says how sure it is. The
joints' covariance :math:`\hat\Sigma` becomes that of a link's position by the link's Jacobian,
:math:`J \hat\Sigma J^\top`: an ellipse along the path. Where demonstrations agree it is narrow,
and a controller should be stiff; where they do not it is wide, and the robot may give way. The
ellipsoids that ``tpgmm view`` draws in three dimensions are these.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np
import torch

from tpgmm_tools.plotting import BLUE, STYLE, VERMILION
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativePosition,
    Robot,
    Situation,
    TaskParameterizedGMM,
)

# %%
# Through a gate
# --------------
# A planar arm moves its tip through a gate and on to somewhere behind it. How it comes to the
# gate and where it ends differs; through the gate there is one way only.

LINKS, LENGTHS = ("base", "upper_arm", "forearm", "hand", "tip"), (0.0, 0.4, 0.3, 0.2)
urdf = '<robot name="planar arm">' + "".join(f'<link name="{link}"/>' for link in LINKS)
for place, length in enumerate(LENGTHS):
    urdf += f"""
    <joint name="joint_{place + 1}" type="{"revolute" if place < 3 else "fixed"}">
      <parent link="{LINKS[place]}"/><child link="{LINKS[place + 1]}"/>
      <origin xyz="{length} 0 0"/><axis xyz="0 0 1"/>
    </joint>"""
robot = Robot.from_urdf(urdf + "</robot>", links=["tip"])

time = np.linspace(0, 2, 80)
REST = torch.tensor([2.3, -1.3, -0.7], dtype=torch.float64)
generator = np.random.default_rng(4)


def follow(path, joints):
    """Joints whose tip follows a path: one Gauss-Newton step per time step."""
    rows = []
    for point in torch.from_numpy(path):
        state = robot.state(joints)
        inverse = torch.linalg.pinv(state.linear_jacobian("tip"))
        joints = joints + inverse @ (point - state.position("tip"))
        rows.append(joints)
    return torch.stack(rows)


def demonstrate():
    """Through the gate at second 1; a parabola through three points that differ."""
    gate = np.array([generator.uniform(0.4, 0.5), generator.uniform(0.2, 0.3), 0])
    start = robot.state(REST).position("tip").numpy()
    end = gate + np.append(generator.normal((0.15, -0.3), 0.05), 0)
    bend = np.array([*generator.normal(0, 0.06, 2), 0])
    t = time[:, None]
    path = start * (t - 1) * (t - 2) / 2 + gate * t * (2 - t) + end * t * (t - 1) / 2
    path += bend * (t * (t - 1) * (t - 2)) * 2
    return Demonstration(time, follow(path, REST), {"gate": Frame(gate)}, robot.joint_names)


demonstrations = [demonstrate() for _ in range(10)]
operators = [RelativePosition("tip", "gate"), Canonical()]
model = TaskParameterizedGMM(12, operators, robot, random_state=0).fit(demonstrations)

# %%
# From the joints' covariance to the tip's
# ----------------------------------------

gate = Frame([0.45, 0.26, 0.0])
[trajectory] = model.predict([Situation(REST, {"gate": gate})])
state = robot.state(trajectory.joints)
jacobian = state.linear_jacobian("tip")
covariance = jacobian @ trajectory.covariance @ jacobian.mT  # (T, 3, 3)
deviation = covariance.diagonal(dim1=-2, dim2=-1).sum(dim=-1).sqrt()
at_gate, at_end = float(deviation[len(time) // 2]), float(deviation[-1])
print(
    f"the tip's standard deviation: {1e3 * at_gate:.1f} mm in the gate, "
    f"{1e3 * at_end:.0f} mm at the end"
)

# %%
# Is it true? Trajectories drawn from the model, by
# :meth:`~tpgmm_torch.TaskParameterizedGMM.sample`, spread as the ellipses say, up to what the
# Jacobian leaves out.

samples = model.sample(Situation(REST, {"gate": gate}), 200, random_state=0)
tips = torch.stack([robot.state(sample.joints).position("tip") for sample in samples])
seen = tips.var(dim=0).sum(dim=-1).sqrt()
ratio = float((seen / deviation).median())
print(f"spread of 200 samples over what the ellipses say: {ratio:.2f} (median over time)")

# %%
# On the left the path in a new situation with its ellipses of two standard deviations, on the
# right their size over time. In the gate the model is more than three times surer than at the
# end; nobody said when the gate is passed.

plt.style.use(STYLE)
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
angle = torch.linspace(0, 2 * torch.pi, 60, dtype=torch.float64)
circle = 2 * torch.stack((angle.cos(), angle.sin()))
for step in range(0, len(time), 4):
    spread, axes = torch.linalg.eigh(covariance[step, :2, :2])
    contour = axes @ (spread.clamp(min=0).sqrt()[:, None] * circle)
    left.fill(*(state.position("tip")[step, :2, None] + contour), color=BLUE, alpha=0.25)
for path in tips[:15]:
    left.plot(*path[:, :2].T, color="0.6", linewidth=0.5)
left.plot(*state.position("tip")[:, :2].T, color=VERMILION)
left.plot(*gate.position[:2], "x", color="black", markersize=9, label="gate")
left.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
left.legend()
right.plot(time, 1e3 * deviation, color=BLUE, label=r"$J \hat\Sigma J^\top$")
right.plot(time, 1e3 * seen, "--", color="0.3", label="200 samples")
right.axvline(1.0, color="black", linewidth=0.8)
right.set(xlabel="time [s]", ylabel="standard deviation of the tip [mm]", ylim=(0, None))
right.legend()
plt.show()

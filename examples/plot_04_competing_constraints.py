r"""
Competing constraints in joint space and in task space
======================================================

Two hands reach for a bottle, bring it to the chest, and shake it. Until the grasp it matters
where the hands are *seen from the bottle*; while shaking it matters what the *shoulder joints*
do. The model has both and decides by what the demonstrations have in common. This is
figure 6 of the paper in small: five demonstrations at 20 steps per second.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import torch

from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_tools.plotting import STYLE, plot_candidates
from tpgmm_torch import (
    Canonical,
    RelativeOrientation,
    RelativePosition,
    Stack,
    TaskParameterizedGMM,
)
from tpgmm_torch.alignment import DynamicTimeWarping

torch.set_num_threads(1)  # the matrices are small

# %%
# Demonstrations
# --------------
# The package generates them by inverse kinematics, for an upper body with three waist joints
# and two arms of seven. They differ in where the bottle stands and in how long each phase
# takes, so they are aligned first.

skill = BottleShaking(rate=20)
recorded = skill.demonstrations(5)
demonstrations = DynamicTimeWarping(robot=skill.robot).fit_transform(recorded)

# %%
# Two operators
# -------------
# The poses of both hands in the bottle's frame (as it stood in the beginning) are stacked into
# one operator; the joints themselves are the other.

hands = [
    operator
    for hand in ("l_hand", "r_hand")
    for operator in (RelativePosition(hand, "bottle"), RelativeOrientation(hand, "bottle"))
]
model = TaskParameterizedGMM(25, [Stack(*hands), Canonical()], skill.robot, random_state=0)
model.fit(demonstrations)
[situation] = skill.situations(1)
[trajectory] = model.predict([situation])

# %%
# Who decides
# -----------
# A :class:`~tpgmm_torch.Trajectory` carries what each operator alone asked of the joints, and
# its share of the information about each joint. The shares follow from the covariances; nobody
# said which phase is which.

spans = {"grasp": (3.8, 4.6), "shake": (8.5, 12.0)}
shoulder = trajectory.joint_names.index("l_shoulder_pitch")
share = trajectory.candidates[1].share[:, shoulder]
shares = {}
for name, (start, end) in spans.items():
    during = (trajectory.time >= start) & (trajectory.time <= end)
    shares[name] = float(share[during].mean())
    print(
        f"{name}: {100 * shares[name]:.0f} % of the information about the left shoulder "
        "comes from joint space"
    )

# %%
# Above: what each operator asks of the left shoulder, with its envelope of one standard
# deviation, and the result in black. Below: the share of joint space. While the hands grasp,
# almost nothing is asked for in joint space; while they shake, more than half.

plt.style.use(STYLE)
figure, (above, below) = plt.subplots(
    2, 1, figsize=(8, 6), sharex=True, height_ratios=(3, 1), layout="constrained"
)
plot_candidates(above, trajectory, "l_shoulder_pitch", ("hands seen from the bottle", "joints"))
above.set_ylim(-0.8, 0.8)
above.legend(loc="lower left", fontsize="small", handlelength=3.5)
below.plot(trajectory.time, share, color=above.lines[1].get_color())  # of the joints
below.set(xlabel="time [s]", ylabel="share of joint space", ylim=(0, 1))
for axes in (above, below):
    for name, span in spans.items():
        axes.axvspan(*span, color="0.9", zorder=0)
        if axes is above:
            axes.annotate(name, (sum(span) / 2, 0.7), ha="center", color="0.4")
plt.show()

r"""
Pressing on a board that is not where it is thought
===================================================

Wiping is a motion along a board and a force into it. Positions alone press too hard on a board
that is 5 mm too high, and wipe the air above one that is too low. Demonstrations with wrenches,
and :class:`~tpgmm_torch.operators.Wrench`, tell a model which force belongs to which instant;
the controller's :class:`~tpgmm_control.contact.Admittance` moves references until it is felt.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np

from tpgmm_control import Controller
from tpgmm_tools.plotting import BLUE, ORANGE, STYLE, VERMILION
from tpgmm_torch import Canonical, Demonstration, Frame, RelativePosition, TaskParameterizedGMM
from tpgmm_torch.operators import Wrench
from tpgmm_torch.robots import Poses

# %%
# Demonstrations
# --------------
# A hand comes down on a board, wipes along it, and goes up again. It presses with 8 N and feels
# friction. Boards stand at other heights each time; a wrench is what the hand exerts.

hand = Poses(["hand"], orientation=False)
time, generator = np.arange(0, 6, 0.02), np.random.default_rng(0)


def demonstrate(height):
    """Touch at 1.5 s, leave at 4.5 s."""
    wiped = np.clip((time - 1.5) / 3, 0, 1)
    above = 0.1 * np.clip(np.maximum(1.5 - time, time - 4.5) / 1.5, 0, 1)
    joints = np.stack((0.4 + 0.2 * wiped, 0 * time, height + above), -1)
    wrench = 0.15 * generator.normal(size=(len(time), 6))
    wrench[(time >= 1.5) & (time < 4.5), :3] += (2.4, 0.0, -8.0)
    board = Frame([0.5, 0.0, height])
    return Demonstration(time, joints, {"board": board}, wrenches={"hand": wrench})


shown = [demonstrate(height) for height in (0.25, 0.3, 0.35)]

# %%
# Which axes
# ----------
# Fitting finds that the force along z does no work, and the one along x does: friction follows
# from the motion, and nobody has to control it.

operators = [
    Canonical(tolerance=0.05), RelativePosition("hand", "board"), Wrench("hand", "board"),
]  # fmt: skip
model = TaskParameterizedGMM(15, operators, hand, random_state=0).fit(shown)
print("axes:", model.operators_[-1].axes)

# %%
# Running it
# ----------
# The board is taken to be at 0.3 m. Where it is, it is a spring of 4 N/mm.


def run(true_height, **settings):
    """Forces and heights of the hand over time."""
    controller = Controller(
        model.skill,
        shown[1].joints[0],
        {"board": Frame([0.5, 0.0, 0.3])},
        clock="even",
        **settings,
    )
    force, rows = 0.0, []
    for _ in time:
        command = controller.step(
            0.02, controller.reference, wrenches={"hand": [0, 0, -force, 0, 0, 0]}
        )
        force = max(0.0, 4000 * (true_height - float(command.reference[2])))
        rows.append((force, 1e3 * (float(command.reference[2]) - true_height)))
    return np.array(rows).T


pressed = {}
plt.style.use(STYLE)
figure, axes = plt.subplots(
    2, 2, figsize=(10, 5), sharex=True, sharey="row", layout="constrained"
)
pairs = (("positions alone", {"admittance": None}), ("with admittance", {}))
for column, (title, settings) in zip(axes.T, pairs, strict=True):
    for error, color in ((-5, BLUE), (0, ORANGE), (5, VERMILION)):
        force, height = run(0.3 + 1e-3 * error, **settings)
        column[0].plot(time, force, color=color, label=f"board {error:+} mm")
        column[1].plot(time, height, color=color)
        pressed[title, error] = force[(time > 2.2) & (time < 4.3)].mean()
        print(f"{title}, board {error:+} mm: {pressed[title, error]:.1f} N")
    column[0].axhline(8, color="0.6", linestyle=":")
    column[1].axhline(0, color="0.6", linestyle=":")
    column[0].set_title(title)
    column[1].set(xlabel="time [s]", ylim=(-7, 20))
axes[0, 0].set(ylabel="force [N]")
axes[1, 0].set(ylabel="hand above the board [mm]")
axes[0, 0].legend(loc="upper right", fontsize="small")
plt.show()

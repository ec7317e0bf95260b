r"""
Frames without a robot
======================

Task-parameterised mixtures are older than their use with Jacobians: classically the data are
positions, and several *frames* look at them. Here a hand leaves a box in the direction in which
the box points, and enters a socket against the direction in which that points. Neither frame
alone explains the motion: the box does so in the beginning, the socket in the end, and the
product of their Gaussians weighs them at every instant.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np
import torch

from tpgmm_tools.plotting import BLUE, SKY, STYLE, VERMILION
from tpgmm_torch import Demonstration, Frame, RelativePosition, TaskParameterizedGMM
from tpgmm_torch.robots import Poses

# %%
# Demonstrations
# --------------
# :class:`~tpgmm_torch.robots.Poses` stands where otherwise the robot does: the "joints" are the
# coordinates of tracked bodies, here the position of one hand. Each demonstration is a smooth
# curve between two frames, with some noise.

hand = Poses(["hand"], orientation=False)
time = np.linspace(0, 1, 100)
generator = np.random.default_rng(0)


def frame(x, y, degrees):
    """A frame in the plane."""
    half = np.radians(degrees) / 2
    return Frame((x, y, 0), (np.cos(half), 0, 0, np.sin(half)))


def random_frames():
    """A box on the left and a socket on the right, each turned somehow."""
    x, y, turn = generator.uniform(-0.1, 0.1, 2), generator.uniform(-0.3, 0.3, 2), (-40, 40)
    return {
        "box": frame(x[0], y[0], generator.uniform(*turn)),
        "socket": frame(1 + x[1], y[1], 180 + generator.uniform(*turn)),
    }


def demonstrate(frames):
    """Out of the box, over into the socket: a Bezier curve with its ends along both x axes."""
    ahead = torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64)
    box, socket = frames["box"], frames["socket"]
    corners = (box.position, box.transform(ahead), socket.transform(ahead), socket.position)
    s = torch.from_numpy(time)[:, None]
    weights = ((1 - s) ** 3, 3 * s * (1 - s) ** 2, 3 * s**2 * (1 - s), s**3)
    path = sum(w * corner for w, corner in zip(weights, corners, strict=True))
    wobble = 0.02 * np.sin(np.pi * time)[:, None] * generator.standard_normal(3) * (1, 1, 0)
    return Demonstration(time, path + torch.from_numpy(wobble), frames, hand.joint_names)


demonstrations = [demonstrate(random_frames()) for _ in range(12)]

# %%
# Learn, once with both frames and once with each alone
# -----------------------------------------------------

operators = {
    "both frames": [RelativePosition("hand", "box"), RelativePosition("hand", "socket")],
    "box alone": [RelativePosition("hand", "box")],
    "socket alone": [RelativePosition("hand", "socket")],
}
situations = [demonstrate(random_frames()) for _ in range(20)]  # none of them learned from
results, misses = {}, {}
for name, chosen in operators.items():
    model = TaskParameterizedGMM(4, chosen, hand, random_state=0)
    results[name] = model.fit(demonstrations).predict(situations)
    ends = [
        (t.joints[[0, -1]] - s.joints[[0, -1]]).norm(dim=1)
        for t, s in zip(results[name], situations, strict=True)
    ]
    misses[name] = 1e3 * torch.stack(ends).median(dim=0).values
    print(
        f"{name:13} misses the start by {misses[name][0]:4.0f} mm and the end by "
        f"{misses[name][1]:4.0f} mm (median of {len(situations)} new situations)"
    )

# %%
# With both frames start and end are met to 10 mm in situations never seen; a model with one
# frame misses the other one by a third of a metre. The picture shows three new situations:
# boxes and sockets as axes, the curve that was wanted (dashed), and what each model makes of
# it.

plt.style.use(STYLE)
figure, panels = plt.subplots(1, 3, figsize=(11, 4.2), layout="constrained")
looks = {"both frames": (VERMILION, "-"), "box alone": (BLUE, "-."), "socket alone": (SKY, ":")}
for number, axes in enumerate(panels):
    axes.plot(*situations[number].joints[:, :2].T, "k--", linewidth=1, label="wanted")
    for name, trajectories in results.items():
        path = trajectories[number].joints
        color, line = looks[name]
        axes.plot(*path[:, :2].T, color=color, linestyle=line, label=name)
    for place in situations[number].frames.values():
        ends = place.transform(0.12 * torch.eye(3, dtype=torch.float64))
        for end, color in zip(ends[:2], (VERMILION, SKY), strict=True):
            corners = torch.stack((place.position, end))
            axes.plot(*corners[:, :2].T, color=color, linewidth=4, alpha=0.6)
    axes.set(title=f"new situation {number + 1}", xlabel="x [m]", ylabel="y [m]")
    axes.set(xlim=(-0.2, 1.25), ylim=(-0.75, 0.7), aspect="equal")
figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
plt.show()

r"""
Alignment
=========

People are not metronomes: the same skill takes different times, and its phases different
shares of them. Who averages by the clock averages one phase with another. Dynamic time warping
brings the demonstrations onto one clock, by what the joints do.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np
import torch

from tpgmm_tools.plotting import STYLE
from tpgmm_torch import Demonstration
from tpgmm_torch.alignment import DynamicTimeWarping, LinearTimeNormalization

# %%
# Demonstrations out of step
# --------------------------
# Two joints reach, wait, and wave three times. How long each phase lasts differs by a third.

generator = np.random.default_rng(3)
NOMINAL = np.array([1.0, 0.8, 2.2])  # seconds of reaching, waiting, waving


def demonstrate():
    """One demonstration at 30 steps per second."""
    ends = np.cumsum(NOMINAL * generator.uniform(2 / 3, 4 / 3, 3))
    time = np.arange(0, ends[-1], 1 / 30)
    phase = np.interp(time, (0, *ends), range(4))  # 0 to 3: which phase, and how far in it
    reach = 0.5 - 0.5 * np.cos(np.pi * phase.clip(0, 1))
    wave = np.sin(6 * np.pi * (phase - 2).clip(0, 1))
    height = generator.normal(1, 0.05)
    joints = np.stack((height * reach + 0.1 * wave, 0.5 * reach - 0.3 * wave), axis=1)
    return Demonstration(time, joints, events={"waving": ends[1]})


demonstrations = [demonstrate() for _ in range(8)]

# %%
# Three ways to one clock
# -----------------------
# Stretching time linearly makes durations equal, not phases. Time warping compares the motions
# themselves, with one of them (the most typical, the *medoid*) or with their average (the
# *barycenter*), which favours none.

ways = {
    "time stretched": LinearTimeNormalization(),
    "warped onto the most typical": DynamicTimeWarping("medoid"),
    "warped onto the average": DynamicTimeWarping("barycenter"),
}
spreads = {}
results = {name: way.fit_transform(demonstrations) for name, way in ways.items()}
for name, aligned in results.items():
    joints = torch.stack([demonstration.joints for demonstration in aligned])
    spreads[name] = float(joints.std(dim=0).square().mean().sqrt())
    starts = [demonstration.events["waving"] for demonstration in aligned]
    print(
        f"{name:29} spread {spreads[name]:.3f} rad, waving begins between "
        f"{min(starts):.2f} and {max(starts):.2f} s"
    )

# %%
# Events that a demonstration carries are moved along: after warping, the waving (dotted)
# begins at nearly the same instant everywhere. The demonstrations' spread about their mean
# (black) falls to less than a fifth of what it is with time stretched.

plt.style.use(STYLE)
figure, panels = plt.subplots(2, 2, figsize=(10, 5.5), sharey=True, layout="constrained")
for axes, (name, shown) in zip(
    panels.flat, {"as recorded": demonstrations, **results}.items(), strict=True
):
    for demonstration in shown:
        [line] = axes.plot(demonstration.time, demonstration.joints[:, 1], linewidth=0.9)
        axes.axvline(demonstration.events["waving"], color=line.get_color(), linestyle=":")
    if name in spreads:
        mean = torch.stack([demonstration.joints for demonstration in shown]).mean(dim=0)
        axes.plot(shown[0].time, mean[:, 1], "k", linewidth=2)
        name += f": spread {spreads[name]:.3f} rad"
    axes.set(title=name, xlabel="time [s]", ylabel="second joint [rad]")
plt.show()

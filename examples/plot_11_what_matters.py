r"""
What matters, and when
======================

Five objects stand around, and the demonstrations say nothing about which of them the skill is
about. That can be found: an operator matters if demonstrations that were left out are more
likely with it than without. :class:`~tpgmm_torch.SelectOperators` asks that of every link in
every frame, and says why it kept what it kept.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np

from tpgmm_tools.plotting import STYLE, plot_relevance
from tpgmm_torch import (
    Demonstration,
    Frame,
    SelectOperators,
    TaskParameterizedGMM,
)
from tpgmm_torch.robots import Poses

# %%
# Demonstrations
# --------------
# A tracked hand goes from home to the cup, rests there, and puts down what it took on the tray.
# All objects stand somewhere else each time, and are seen with 2 mm of noise.

hand = Poses(["hand"], orientation=False)
time = np.linspace(0, 6, 120)
generator = np.random.default_rng(0)
OBJECTS = ("bottle", "cup", "lamp", "plate", "tray")
ABOVE = np.array([0.0, 0.0, 0.08])


def between(begin, end, first, last):
    """Minimum jerk from one second to another."""
    s = np.clip((time - first) / (last - first), 0, 1)[:, None]
    return (end - begin) * s**3 * (10 - 15 * s + 6 * s**2)


def demonstrate():
    places = dict(zip(OBJECTS, generator.uniform(-0.3, 0.3, (5, 3)), strict=True))
    home = np.array([0.0, 0.0, 0.4]) + 0.02 * generator.normal(size=3)
    cup, tray = places["cup"] + ABOVE, places["tray"] + ABOVE
    path = home + between(home, cup, 0, 2) + between(cup, tray, 3, 5)
    seen = {name: Frame(x + 0.002 * generator.normal(size=3)) for name, x in places.items()}
    return Demonstration(time, path + 0.001 * generator.normal(size=path.shape), seen)


demonstrations = [demonstrate() for _ in range(5)]

# %%
# Which operators matter
# ----------------------
# The candidates are the joints (here the hand's coordinates), the hand in the base frame, and
# the hand seen from each object. *Gain* is by how much a demonstration that is left out becomes
# more likely; then follows when it gains most, and how far the demonstration is from what the
# operator expects there, beside what all others do.

selection = SelectOperators(robot=hand).fit(demonstrations)
print(selection.report())

# %%
# When
# ----
# The cup decides while the hand rests at it, the tray at the end. What stands below the line
# was dropped.

plt.style.use(STYLE)
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
plot_relevance(axes, selection)
plt.show()

# %%
# In a model
# ----------
# A model of these operators asks of a new situation only the
# frames that matter.

model = TaskParameterizedGMM(12, selection.operators_, hand).fit(demonstrations)
print(model.operators_)
print("frames:", ", ".join(model.frame_names_))

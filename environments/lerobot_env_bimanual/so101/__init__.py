"""Two SO-101 arms with hobby servos: backlash, sag, joints whose zero is not known."""

from collections.abc import Mapping
from types import MappingProxyType

#: The tasks, and what is observed in each, in that order; known without MuJoCo.
TASKS: Mapping[str, tuple[str, ...]] = MappingProxyType({"cup_on_saucer": ("cup", "saucer")})
#: How many joints both arms have, with their grippers.
N_JOINTS = 12

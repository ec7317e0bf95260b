"""Local data of one demonstration."""

from collections.abc import Sequence

from torch import Tensor

from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.held_objects import held_objects
from tpgmm_torch.robots.kinematics import Kinematics


def local_coordinates(
    operator: Operator,
    demonstration: Demonstration,
    kinematics: Kinematics,
    holds: Sequence[Hold] = (),
) -> Tensor:
    """The data set X^(j) (T, D); objects that were held are where they were last free."""
    demonstration = demonstration.reorder(kinematics.joint_names)
    state = kinematics.state(demonstration.joints)
    time = demonstration.time.to(state.joints)
    frames = {name: frame.to(state.joints) for name, frame in demonstration.frames.items()}
    if holds:
        state, frames = held_objects(state, time, frames, holds)
    return operator.along(time, state, frames, kinematics)

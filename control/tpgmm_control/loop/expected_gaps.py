"""What commands are beyond the postures that are wanted, as the demonstrations' were."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_control.loop.reach import Fade
from tpgmm_control.sensing.servo import FLOOR
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.skills.skill import Skill

#: Share of the largest gap at rest of any demonstration that means nothing here.
SHARE = 0.75
#: Gaps of no joint mean nothing from here on, whatever was shown [rad or m].
MOST = 0.1


@dataclass(frozen=True, eq=False)
class ExpectedGaps:
    """Gaps between commands and postures that are usual in a skill; immutable.

    Parameters
    ----------
    limbs : bool array of shape (n_limbs, n_joints)
        Joints that move each link: in contact, all of a limb bend.
    fade : Fade
        Of gaps that come in, or change.
    gap : Tensor of shape (..., n_joints)
        What the last command was beyond the posture that was wanted [rad or m].
    floor : array of shape (B, n_joints)
        Half the gap that means nothing [rad or m].
    """

    limbs: NDArray[np.bool_]
    fade: Fade
    gap: Tensor
    floor: Array

    @classmethod
    def start(cls, skill: Skill, joints: Tensor, blend: float) -> Self | None:
        """Begin without gaps; None where the skill knows of none.

        Parameters
        ----------
        skill : Skill
        joints : Tensor of shape (..., n_joints)
            The start postures.
        blend : float
            How long gaps take to come in [s].
        """
        if skill.command_gaps(np.array([skill.begin])) is None:
            return None
        none = torch.zeros_like(joints)
        floor = np.full((joints[..., 0].numel(), joints.shape[-1]), FLOOR)
        return cls(
            _find_limbs(skill.kinematics, joints), Fade.start(joints, blend), none, floor
        )

    def advance(self, skill: Skill, time: Array, dt: float | Tensor, first: bool) -> Self:
        """Find the gaps at a tick.

        Parameters
        ----------
        skill : Skill
        time : array of shape (B,)
            In the skill [s].
        dt : float or Tensor of shape (...)
            Since the last tick [s].
        first : bool
            Whether it is the first tick.
        """
        found = skill.command_gaps(time)
        assert found is not None
        gap = torch.from_numpy(found[0]).to(self.gap).reshape(self.gap.shape)
        shift, fade = self.fade.advance(self.gap, gap, dt, first)
        largest = np.where(self.limbs, found[1][:, None], 0.0).max(-1, keepdims=True)
        limb = np.where(self.limbs, largest, 0.0).max(-2)
        floor = np.clip(SHARE * limb, FLOOR, MOST)
        return replace(self, fade=fade, gap=gap if shift is None else gap + shift, floor=floor)

    def restart(self, robots: Tensor) -> Self:
        """Let gaps of some robots (...) change as they are now to those of another time."""
        return replace(self, fade=self.fade.again(robots))


def _find_limbs(kinematics: Kinematics, joints: Tensor) -> NDArray[np.bool_]:
    """Find the joints that move each link; where there is no link, each joint is alone."""
    alone: NDArray[np.bool_] = np.eye(kinematics.n_joints, dtype=bool)
    if not kinematics.links:
        return alone
    state = kinematics.state(joints.reshape(-1, joints.shape[-1])[0])
    moves: NDArray[np.bool_] = (state.jacobians.abs() > 0).any(-2).numpy(force=True)
    return np.concatenate((moves.reshape(-1, kinematics.n_joints), alone[~moves.any(0)]))

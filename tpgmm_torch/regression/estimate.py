"""The joint references of one control tick, as a Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from tpgmm_torch.data.trajectories import Candidate

__all__ = ["Estimate"]


@dataclass(frozen=True, eq=False)
class Estimate:
    """The joint references of one control tick.

    Parameters
    ----------
    joints : Tensor of shape (..., n_joints)
        Mean of the fused mixture, the reference q_hat_t.
    covariance : Tensor of shape (..., n_joints, n_joints)
        Of the fused mixture, within the components and between them.
    activation : Tensor of shape (..., K)
        Mixing weights h_i of the components.
    candidates : tuple of Candidate
        Each operator's own estimate; empty unless asked for.
    after : Skill, optional
        The skill for the next tick, if the one that made this estimate remembers something.
    """

    joints: Tensor
    covariance: Tensor
    activation: Tensor
    candidates: tuple[Candidate, ...] = ()
    after: Any = None

    def __repr__(self) -> str:
        return (
            f"Estimate(joints of shape {tuple(self.joints.shape)}, "
            f"{self.activation.shape[-1]} components, {len(self.candidates)} candidates)"
        )

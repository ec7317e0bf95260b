"""Nearness in one demonstration: a hand near an object is taken to be there because of it.

Demonstrations tell which frame matters by how little they vary in it. A single one varies in
none, and three vary little by chance. The prior here says what holds before any is seen: the
place of the hand in a frame varies in proportion to its distance from the frame's origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.regression import Regression


@dataclass(frozen=True)
class Nearness:
    """An inverse Wishart prior on the covariances given time.

    The most probable covariance of component i in frame j is then

        (N C_i^(j) + n (floor + ratio d_i^(j))^2 I) / (N + n)

    with N demonstrations, the covariance C given time that EM found, and the distance d of its
    mean from the frame's origin.

    Parameters
    ----------
    ratio : float, default=0.1
        Standard deviation at a distance, as a share of it.
    floor : float, default=0.002
        Standard deviation at the origin [m].
    power : float, default=2.0
        Of the distance: ``(d / reach)^power reach`` stands for it.
    reach : float, default=0.3
        The distance that powers leave as it is, and that the world counts as being away [m]:
        it has no origin that means something.
    strength : float, default=1.0
        How many demonstrations the prior counts as, n.
    """

    ratio: float = 0.1
    floor: float = 0.002
    power: float = 2.0
    reach: float = 0.3
    strength: float = 1.0

    def __post_init__(self) -> None:
        if not (self.ratio > 0 and self.floor > 0 and self.reach > 0 and self.strength >= 0):
            raise DataError(
                f"ratio, floor and reach are positive and strength is not negative, got {self}"
            )

    def deviation(self, distance: Tensor) -> Tensor:
        """Compute the prior's standard deviation [m] at distances [m]."""
        return self.floor + self.ratio * self.reach * (distance / self.reach) ** self.power

    def apply(self, skill: Regression, n_demonstrations: int) -> Regression:
        """Apply the prior to a skill with ``Canonical`` and relative positions as operators.

        Coordinates of ``Canonical`` that are no lengths keep their variance, and lose their
        covariance with those that are: a gripper does not close because a hand is elsewhere.
        """
        conditionals, total = [], n_demonstrations + self.strength
        for operator, found in zip(skill.operators, skill.conditionals, strict=True):
            covariance = found.covariance
            if operator.is_posture:
                lengths = torch.zeros(found.mean.shape[-1], dtype=torch.bool)
                lengths[list(skill.kinematics.lengths)] = True
                covariance = covariance * (lengths[:, None] == lengths)
                deviation = self.deviation(torch.full_like(found.mean, self.reach))
                deviation[:, ~lengths] = self.floor
            else:
                distance = found.mean.norm(dim=1, keepdim=True)
                deviation = self.deviation(distance).expand_as(found.mean)
            prior = self.strength * (deviation**2).diag_embed()
            blended = (n_demonstrations * covariance + prior) / total
            conditionals.append(replace(found, covariance=blended))
        # the prior says what few demonstrations do not
        return replace(skill, conditionals=conditionals, n_samples=None)

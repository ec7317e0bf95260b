"""What one demonstration cannot say: that a hand near an object is there because of it.

Demonstrations tell which frame matters by how little they vary in it. A single one varies in
none, and three vary little by chance. The prior here says what holds before any is seen: the
place of the hand in a frame varies in proportion to its distance from the frame's origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tpgmm_torch import Canonical, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError

__all__ = ["Nearness"]


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
        """The prior's standard deviation [m] at distances [m]."""
        return self.floor + self.ratio * self.reach * (distance / self.reach) ** self.power

    def posterior(
        self,
        covariances: Tensor,
        deviation: Tensor,
        n_demonstrations: int,
        lengths: Tensor | None = None,
    ) -> Tensor:
        """Covariances (K, 1 + D, 1 + D) under the prior; slopes over time stay.

        Parameters
        ----------
        covariances : Tensor of shape (K, 1 + D, 1 + D)
            Time first.
        deviation : Tensor of shape (K, D)
            The prior's standard deviations.
        n_demonstrations : int
        lengths : Tensor of shape (D,), dtype bool, optional
            Which coordinates are lengths: given time, they are independent of the others.
        """
        slope = covariances[:, 1:, :1] / covariances[:, :1, :1]
        steep = slope @ covariances[:, :1, 1:]
        given_time = covariances[:, 1:, 1:] - steep
        if lengths is not None:
            given_time = given_time * (lengths[:, None] == lengths)
        total = n_demonstrations + self.strength
        blended = n_demonstrations * given_time + self.strength * (deviation**2).diag_embed()
        result = covariances.clone()
        result[:, 1:, 1:] = blended / total + steep
        return result

    def applied(
        self, model: TaskParameterizedGMM, n_demonstrations: int
    ) -> TaskParameterizedGMM:
        """A fitted model under the prior; operators are ``Canonical`` and relative positions.

        Coordinates of ``Canonical`` that are no lengths keep their variance, and lose their
        covariance with those that are: a gripper does not close because a hand is elsewhere.
        """
        covariances = []
        for operator, mean, covariance in zip(
            model.operators_, model.means_, model.covariances_, strict=True
        ):
            lengths = None
            if isinstance(operator, Canonical):
                lengths = torch.zeros(mean.shape[1] - 1, dtype=torch.bool)
                lengths[list(model.kinematics_.lengths)] = True
                deviation = self.deviation(torch.full_like(mean[:, 1:], self.reach))
                deviation[:, ~lengths] = self.floor
            else:
                distance = mean[:, 1:].norm(dim=1, keepdim=True)
                deviation = self.deviation(distance).expand(-1, mean.shape[1] - 1)
            covariances.append(self.posterior(covariance, deviation, n_demonstrations, lengths))
        settings = model.get_params(deep=False) | {
            "n_components": len(model.weights_),
            "operators": list(model.operators_),
            "robot": model.kinematics_,
            "covariance_shrinkage": 0.0,  # the prior says what few demonstrations do not
        }
        return TaskParameterizedGMM.from_parameters(
            model.weights_,
            model.means_,
            covariances,
            model.time_,
            n_demonstrations=model.n_demonstrations_,
            peaks=model.skill.peaks,
            summary=model.skill.summary,
            **settings,
        )

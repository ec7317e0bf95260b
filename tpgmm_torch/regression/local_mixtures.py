"""What a mixture says about an operator's local coordinates at a given time."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from tpgmm_torch import gaussians

__all__ = ["LocalMixture"]


@dataclass(frozen=True, eq=False)
class LocalMixture:
    """The K local Gaussians of one operator, conditioned on time.

    Parameters
    ----------
    mean, gain : Tensor of shape (K, D)
        ``E[x | t] = mean + gain (t - time_mean)``.
    covariance : Tensor of shape (K, D, D)
        Of the local coordinates given time.
    time_mean, time_variance : Tensor of shape (K,)
        The components' time marginal [s], [s^2].
    """

    mean: Tensor
    gain: Tensor
    covariance: Tensor
    time_mean: Tensor
    time_variance: Tensor

    @classmethod
    def of(cls, means: Tensor, covariances: Tensor) -> LocalMixture:
        """Condition on the first coordinate: shapes (K, 1 + D) and (K, 1 + D, 1 + D)."""
        gain, covariance = gaussians.condition(means, covariances, 1)
        return cls(means[:, 1:], gain[..., 0], covariance, means[:, 0], covariances[:, 0, 0])

    def select(self, components: Tensor) -> LocalMixture:
        """Only some of the components."""
        return LocalMixture(*(getattr(self, name)[components] for name in self.__annotations__))

    def at(self, time: Tensor) -> Tensor:
        """Conditional means at times of shape (...): a tensor of shape (..., K, D)."""
        return self.mean + self.gain * (time[..., None] - self.time_mean)[..., None]

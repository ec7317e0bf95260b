"""Components conditioned on time: what they weigh, and what they say of coordinates."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from tpgmm_torch import gaussians

#: Windows to the narrowest component's standard deviation, and at most.
WINDOWS_PER_STD, MOST_WINDOWS = 4, 4096
#: Standard deviations beyond the components' means that the windows reach.
REACH = 6.0


def _degrees_of_freedom(n_samples: float) -> float:
    return max(n_samples - 1.0, 1.0)  # one sample leaves the widest law


def predictive_scale(n_samples: float | None) -> float:
    """Compute how much wider a new sample spreads than the covariance of n samples says.

    ``(n + 1) / (n - 1)``, which Student's t has for its scale matrix.

    Parameters
    ----------
    n_samples : float or None
        None says that the covariance is known, which gives 1.

    References
    ----------
    A. Gelman et al.: Bayesian Data Analysis, 3rd ed., section 3.2: the posterior predictive
    of a normal law of unknown mean and variance.
    """
    if n_samples is None:
        return 1.0
    return (n_samples + 1) / _degrees_of_freedom(n_samples)


class _OfComponents:
    """Tensors whose first dimension counts components."""

    def select(self, components: Tensor) -> Self:
        """Only some of the components, by their indices."""
        return type(self)(*(tensor[components] for tensor in vars(self).values()))


@dataclass(frozen=True, eq=False)
class TimeMarginals(_OfComponents):
    """The time marginals ``pi_i N(t | mu_t,i, Sigma_tt,i)`` of K components.

    Parameters
    ----------
    log_peak : Tensor of shape (K,)
        What of their logarithms does not depend on time, ``log pi_i - log(Sigma_tt,i) / 2``.
    mean : Tensor of shape (K,)
        ``mu_t,i`` [s].
    precision : Tensor of shape (K,)
        ``1 / Sigma_tt,i`` [1/s^2].
    """

    log_peak: Tensor
    mean: Tensor
    precision: Tensor

    @classmethod
    def of(cls, log_weights: Tensor, mean: Tensor, variance: Tensor) -> TimeMarginals:
        """From mixing coefficients pi_i and moments, each of shape (K,)."""
        return cls(log_weights - 0.5 * variance.log(), mean, 1 / variance)

    def log_activation(self, time: Tensor) -> Tensor:
        """``log h_i(t)``, (..., K), up to a constant that the components share.

        Parameters
        ----------
        time : Tensor of shape (..., 1), or (..., K) for times of each component's own
        """
        elapsed = time - self.mean
        return torch.addcmul(self.log_peak, self.precision, elapsed.square(), value=-0.5)


@dataclass(frozen=True, eq=False)
class Conditionals(_OfComponents):
    """K Gaussians over time and D coordinates, conditioned on time.

    Parameters
    ----------
    mean, gain : Tensor of shape (K, D)
        ``E[x | t] = mean + gain (t - time_mean)``.
    covariance : Tensor of shape (K, D, D)
        Of the coordinates given time, which it does not depend on.
    time_mean, time_variance : Tensor of shape (K,)
        The time marginals [s], [s^2].
    """

    mean: Tensor
    gain: Tensor
    covariance: Tensor
    time_mean: Tensor
    time_variance: Tensor

    @classmethod
    def of(cls, means: Tensor, covariances: Tensor) -> Conditionals:
        """Condition on the first coordinate: shapes (K, 1 + D) and (K, 1 + D, 1 + D)."""
        gain, covariance = gaussians.condition(means, covariances, 1)
        return cls(means[:, 1:], gain[..., 0], covariance, means[:, 0], covariances[:, 0, 0])

    @classmethod
    def stack(cls, parts: Sequence[Conditionals]) -> Conditionals:
        """Put coordinates of all parts side by side, which are independent given time."""
        time = parts[0].time_mean, parts[0].time_variance
        covariance = gaussians.block_diagonal([p.covariance for p in parts], time[0].shape)
        mean = torch.cat([part.recenter(time[0]) for part in parts], -1)
        return cls(mean, torch.cat([part.gain for part in parts], -1), covariance, *time)

    @classmethod
    def product(cls, parts: Sequence[Conditionals]) -> Conditionals:
        """Multiply (2) Gaussians over the same coordinates, component by component.

        Raises
        ------
        DataError
            If a covariance is singular.
        """
        if len(parts) == 1:
            return parts[0]
        like, time = parts[0].mean, (parts[0].time_mean, parts[0].time_variance)
        # in float64, as narrow directions lose digits soonest
        covariances = torch.stack([part.covariance.double() for part in parts])
        means = torch.stack([part.recenter(time[0]).double() for part in parts])
        gains = torch.stack([part.gain.double() for part in parts])
        gain, _ = gaussians.product(gains, covariances)
        mean, covariance = gaussians.product(means, covariances)
        return cls(mean.to(like), gain.to(like), covariance.to(like), *time)

    @property
    def second_moment(self) -> Tensor:
        """``E[x_d^2]`` of each coordinate, (K, D), time not given."""
        variance = self.covariance.diagonal(dim1=-2, dim2=-1)
        moved = self.gain.square() * self.time_variance.unsqueeze(-1)
        return self.mean.square() + variance + moved

    def marginal(self, coordinates: Tensor) -> Conditionals:
        """Select some of the coordinates, by their indices."""
        covariance = self.covariance[:, coordinates][:, :, coordinates]
        mean, gain = self.mean[:, coordinates], self.gain[:, coordinates]
        return replace(self, mean=mean, gain=gain, covariance=covariance)

    def recenter(self, time_mean: Tensor) -> Tensor:
        """Conditional means at a time of each component's own: shapes (K,) and (K, D)."""
        return self.mean + self.gain * (time_mean - self.time_mean).unsqueeze(-1)

    def at(self, time: Tensor) -> Tensor:
        """Conditional means at times of shape (...): a tensor of shape (..., K, D)."""
        elapsed = time.unsqueeze(-1) - self.time_mean
        return torch.addcmul(self.mean, self.gain, elapsed.unsqueeze(-1))

    def log_density(
        self, local: Tensor, time: Tensor, n_samples: float | None = None
    ) -> Tensor:
        """``log N(x_t | t)`` of coordinates (T, D) at times (T,), by component, (T, K).

        Parameters
        ----------
        local : Tensor of shape (T, D)
        time : Tensor of shape (T,)
        n_samples : float, optional
            How many independent samples n a component was learned from. Given that, the
            density of a new one: Student's t with n - 1 degrees of freedom around the same
            mean, of the scale matrix :func:`predictive_scale` times the covariance.
        """
        residuals = (local.unsqueeze(-2) - self.at(time)).movedim(-2, 0).mT
        covariance = predictive_scale(n_samples) * self.covariance
        degrees = None if n_samples is None else _degrees_of_freedom(n_samples)
        name = "the covariance of a component"
        return gaussians.log_density(residuals, covariance, name, degrees).mT


@dataclass(frozen=True, eq=False)
class Components:
    """Some components of the mixture: those that count.

    Parameters
    ----------
    index : Tensor of shape (A,)
        Which ones they are.
    places : Tensor of shape (A, K)
        The same as rows of the identity.
    marginals : TimeMarginals
        Their weights and time marginals.
    conditionals : tuple of Conditionals
        Of each operator; or of all operators' coordinates at once, where the fusion is a
        Kalman update.
    """

    index: Tensor
    places: Tensor
    marginals: TimeMarginals
    conditionals: tuple[Conditionals, ...]

    def select(self, index: Sequence[int]) -> Components:
        """Some of them, by their place among them."""
        places = torch.tensor(index, device=self.index.device)
        conditionals = tuple(one.select(places) for one in self.conditionals)
        marginals = self.marginals.select(places)
        return Components(self.index[places], self.places[places], marginals, conditionals)


class ActiveComponents:
    """The components whose weight counts, for windows of time; beyond these all of them.

    At time t component i has the weight ``h_i(t) ∝ pi_i N(t | mu_i, sigma_i)``. Those whose
    weight stays below a share of the largest all over a window are left out of it; references
    move by at most the weight left out times the distance of the components' estimates.

    Parameters
    ----------
    marginals : TimeMarginals
        Of K components.
    negligible : float
        Components with a smaller share of the largest weight all over a window are left out
        of it; 0 keeps all.
    """

    def __init__(self, marginals: TimeMarginals, negligible: float) -> None:
        marginals = TimeMarginals(
            *(x.detach().double().cpu() for x in vars(marginals).values())
        )
        means, deviations = marginals.mean, marginals.precision.rsqrt()
        low = float((means - REACH * deviations).min())
        high = float((means + REACH * deviations).max())
        wanted = WINDOWS_PER_STD * (high - low) / float(deviations.min())
        count = max(1, min(MOST_WINDOWS, math.ceil(wanted)))
        self._edges = torch.linspace(low, high, count + 1, dtype=torch.float64)
        start, end = self._edges[:-1, None], self._edges[1:, None]
        # the most a component can weigh in a window, and the least the heaviest one does
        most = marginals.log_activation(torch.minimum(torch.maximum(means, start), end))
        ends = marginals.log_activation(start), marginals.log_activation(end)
        least = torch.minimum(*ends).amax(1, keepdim=True)
        share = math.log(negligible) if negligible else -math.inf
        # a row for each window, and one before and behind them
        self._counts = torch.nn.functional.pad(most >= least + share, (0, 0, 1, 1), value=True)
        self._edge_list: list[float] = self._edges.tolist()
        self._sets = [tuple(row.nonzero()[:, 0].tolist()) for row in self._counts]

    @property
    def largest(self) -> int:
        """The most components that count in one window."""
        return max(map(len, self._sets[1:-1]))

    def at(self, time: float) -> tuple[int, ...]:
        """Components that count at an instant [s]."""
        return self._sets[bisect.bisect_right(self._edge_list, time)]

    def counts(self, time: Tensor) -> Tensor:
        """Check which components count at times of shape (...): bool of shape (..., K)."""
        instants = time.detach().double().cpu().contiguous()
        window = torch.bucketize(instants, self._edges, right=True)
        return self._counts[window].to(time.device)

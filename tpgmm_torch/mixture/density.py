"""What a fitted mixture answers: densities, responsibilities, criteria, samples."""

from __future__ import annotations

import math
from collections.abc import Iterator
from numbers import Integral
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import DensityMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import validate_data
from torch import Tensor

from tpgmm_torch.em.block_gaussians import Parameters, Standardization, Whitener
from tpgmm_torch.exceptions import DataError, NotFittedError

__all__ = ["MixtureDensity", "on_cpu"]


class MixtureDensity(DensityMixin):  # type: ignore[misc]
    """The density of a mixture with ``weights_``, ``means_`` and ``covariances_``.

    Attributes
    ----------
    weights_, means_, covariances_
        As in :class:`~tpgmm_torch.BlockGaussianMixture`.
    """

    weights_: Tensor
    means_: list[Tensor]
    covariances_: list[Tensor]
    covariance_type: str
    dtype: str
    random_state: Any

    def score_samples(self, X: Any) -> NDArray[np.floating]:
        """Log-density of each point.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)

        Returns
        -------
        array of shape (n_samples,)
        """
        return _to_numpy(torch.logsumexp(joint, 0) for joint in self._log_joint(X))

    def score(self, X: Any, y: Any = None) -> float:
        """Mean log-density of the points X (n_samples, n_features)."""
        return float(self.score_samples(X).mean(dtype=np.float64))

    def predict_proba(self, X: Any) -> NDArray[np.floating]:
        """Responsibilities of the components for each point.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)

        Returns
        -------
        array of shape (n_samples, K)
        """
        return _to_numpy(torch.softmax(joint, 0).T for joint in self._log_joint(X))

    def predict(self, X: Any) -> NDArray[np.int64]:
        """Most probable component of each of the points X, shape (n_samples,)."""
        return _to_numpy(joint.argmax(0) for joint in self._log_joint(X))

    @property
    def n_parameters_(self) -> int:
        """Number of free parameters: weights, means, and covariances of all blocks."""
        n_components, widths = len(self._fitted().weights), [m.shape[1] for m in self.means_]
        per_block = {
            "full": [n_components * width * (width + 1) // 2 for width in widths],
            "tied": [width * (width + 1) // 2 for width in widths],
            "diag": [n_components * width for width in widths],
            "spherical": [n_components for _ in widths],
        }[self.covariance_type]
        return n_components - 1 + n_components * sum(widths) + sum(per_block)

    def bic(self, X: Any) -> float:
        """Bayesian information criterion on X (n_samples, n_features); lower is better."""
        values = self.score_samples(X)
        penalty = self.n_parameters_ * math.log(len(values))
        return -2 * float(values.sum(dtype=np.float64)) + penalty

    def aic(self, X: Any) -> float:
        """Akaike information criterion on X (n_samples, n_features); lower is better."""
        values = self.score_samples(X)
        return -2 * float(values.sum(dtype=np.float64)) + 2 * self.n_parameters_

    def sample(self, n_samples: int = 1) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
        """Draw points from the mixture.

        Parameters
        ----------
        n_samples : int, default=1

        Returns
        -------
        X : array of shape (n_samples, n_features)
        labels : array of shape (n_samples,)
            The components that they came from, in ascending order.
        """
        parameters = self._fitted()
        if not isinstance(n_samples, Integral) or n_samples < 1:
            raise DataError(f"n_samples must be an integer of at least 1, got {n_samples!r}")
        X, labels = parameters.sample(n_samples, check_random_state(self.random_state))
        return X.astype(self.dtype), labels

    def _fitted(self) -> Parameters:
        """The fitted mixture in float64."""
        if not hasattr(self, "weights_"):
            raise NotFittedError(
                f"this {type(self).__name__} is not fitted yet; call fit before this method"
            )
        return Parameters.from_covariances(
            self.weights_.double(),
            [mean.double() for mean in self.means_],
            [covariance.double() for covariance in self.covariances_],
        )

    def _log_joint(self, X: Any) -> Iterator[Tensor]:
        """Log of weight times density, (K, n), chunk by chunk."""
        parameters = self._fitted()
        points = validate_data(self, on_cpu(X), dtype=[np.float64, np.float32], reset=False)
        units = Standardization.of_mixture(parameters)
        chunks = units.chunks(points, len(parameters.weights), self.weights_.dtype)
        whitener = Whitener(units.standardize(parameters), self.weights_.dtype)
        for chunk in chunks:
            yield whitener(chunk)[0] - units.log_volume


def on_cpu(X: Any) -> Any:
    """X as an array if it is a tensor, as it is if not."""
    return X.detach().cpu().numpy() if isinstance(X, Tensor) else X


def _to_numpy(chunks: Iterator[Tensor]) -> NDArray[Any]:
    """Put the results of the chunks together."""
    result: NDArray[Any] = torch.cat(list(chunks)).cpu().numpy()
    return result

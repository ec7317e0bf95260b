"""A Gaussian mixture over blocks of columns, as a scikit-learn estimator."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, DensityMixin
from sklearn.utils import check_random_state
from sklearn.utils._param_validation import Interval, StrOptions
from sklearn.utils.validation import validate_data
from torch import Tensor

from tpgmm_torch.block_gaussians import (
    Family,
    Parameters,
    Standardization,
    Whitener,
    check_blocks,
)
from tpgmm_torch.exceptions import DataError, NotFittedError, ShapeError
from tpgmm_torch.expectation_maximization import ascend
from tpgmm_torch.initialization import GivenStart, StartDrawer

__all__ = ["BlockGaussianMixture"]


class BlockGaussianMixture(DensityMixin, BaseEstimator):  # type: ignore[misc]
    """Gaussian mixture whose covariance is block-diagonal, learned by EM.

    The columns are split into P blocks, independent of each other given the component:
    the density of a point is ``sum_k pi_k prod_j N(x_j | mu_kj, Sigma_kj)``. This is the
    model of the paper's section II-B, where each block is the data seen in one frame. With
    one block it is :class:`sklearn.mixture.GaussianMixture`.

    Columns are centred and scaled inside, so neither offsets nor units matter. EM never
    lowers the log-likelihood: M steps add the regularisation to the diagonals as
    scikit-learn does, and should this ever lower the likelihood, that step and all later
    ones take the most likely covariances not below the regularisation instead.

    Parameters
    ----------
    n_components : int, default=1
        Number K of components.
    blocks : sequence of int, optional
        Widths D_j of the blocks, which add up to the number of columns; None is one block.
    covariance_type : {"full", "tied", "diag", "spherical"}, default="full"
        Within a block: any matrix per component, one matrix for all components, a diagonal
        one per component, or one variance per component.
    tol : float, default=1e-3
        EM stops when the mean log-likelihood changes by less.
    reg_covar : float or array-like of shape (n_features,), default=1e-6
        Regularisation of the covariances' diagonals.
    regularization : {"relative", "absolute"}, default="relative"
        Whether ``reg_covar`` is a share of each column's variance (of its block's mean
        variance where a column is constant), or in squared units of the data as in
        scikit-learn. It is never less than 1e-12 (float64), 2e-6 (float32) of the variance.
    max_iter : int, default=100
        Most EM iterations per start.
    n_init : int, default=1
        Number of starts; the one with the highest bound wins.
    init_params : {"time", "kmeans", "random"}, default="time"
        Equal bins along ``time_feature`` (with bins of random sizes in further starts),
        k-means on standardised data, or the nearest of K random points.
    time_feature : int, default=0
        Column of the first block that holds time.
    group_size : int, default=1
        In ``fit``, so many consecutive rows share one responsibility, that of the geometric
        mean of their densities: demonstrations of one skill at one instant, for example.
    weights_init : array-like of shape (K,), optional
        Start of the weights, in place of what ``init_params`` gives.
    means_init : sequence of array-like of shape (K, D_j), optional
        Start of the means, one array per block.
    covariances_init : sequence of array-like of shape (K, D_j, D_j), optional
        Start of the covariances, one array per block. They are brought into the family
        ``covariance_type`` and raised to the regularisation where they are below it.
    random_state : int, RandomState or None, default=None
        For the starts, for components placed anew, and for :meth:`sample`.
    warm_start : bool, default=False
        Continue from the last fit instead of starting anew.
    verbose : int, default=0
        1 prints a line per start, 2 also one per iteration.
    dtype : {"float64", "float32"}, default="float64"
        Precision of the passes over the data and of the result; sums are in float64.
    device : str or torch.device, default="cpu"
        Where to compute.

    Attributes
    ----------
    weights_ : Tensor of shape (K,)
    means_ : list of Tensor of shape (K, D_j)
        One per block.
    covariances_ : list of Tensor of shape (K, D_j, D_j)
        One per block, full matrices whatever the ``covariance_type``.
    converged_ : bool
    n_iter_ : int
        Iterations of the best start.
    lower_bound_ : float
        Mean log-likelihood of the training data under the mixture before the last M step,
        as in scikit-learn; ``score`` of the result is not below it.
    lower_bounds_ : list of float
        Its history, which never falls. Where a component placed anew lowers it, the
        history begins again at that point.
    n_features_in_ : int

    Warns
    -----
    ConvergenceWarning
        If the best start did not converge.
    DegenerateComponentWarning
        If one of its components lost its data and was placed anew.

    Examples
    --------
    >>> import numpy as np
    >>> from tpgmm_torch.mixture import BlockGaussianMixture
    >>> time = np.linspace(0, 1, 50)
    >>> X = np.column_stack([time, time**2, time, np.sin(3 * time)])
    >>> model = BlockGaussianMixture(n_components=3, blocks=(2, 2)).fit(X)
    >>> [tuple(mean.shape) for mean in model.means_]
    [(3, 2), (3, 2)]
    """

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012
        "n_components": [Interval(Integral, 1, None, closed="left")],
        "blocks": ["array-like", None],
        "covariance_type": [StrOptions({"full", "tied", "diag", "spherical"})],
        "tol": [Interval(Real, 0.0, None, closed="left")],
        "reg_covar": [Interval(Real, 0.0, None, closed="left"), "array-like"],
        "regularization": [StrOptions({"relative", "absolute"})],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "n_init": [Interval(Integral, 1, None, closed="left")],
        "init_params": [StrOptions({"time", "kmeans", "random"})],
        "time_feature": [Interval(Integral, 0, None, closed="left")],
        "group_size": [Interval(Integral, 1, None, closed="left")],
        "weights_init": ["array-like", None],
        "means_init": ["array-like", None],
        "covariances_init": ["array-like", None],
        "random_state": ["random_state"],
        "warm_start": ["boolean"],
        "verbose": ["verbose"],
        "dtype": [StrOptions({"float64", "float32"})],
        "device": [str, torch.device],
    }

    def __init__(
        self,
        n_components: int = 1,
        *,
        blocks: Sequence[int] | None = None,
        covariance_type: str = "full",
        tol: float = 1e-3,
        reg_covar: float | Sequence[float] | NDArray[np.float64] = 1e-6,
        regularization: str = "relative",
        max_iter: int = 100,
        n_init: int = 1,
        init_params: str = "time",
        time_feature: int = 0,
        group_size: int = 1,
        weights_init: Any = None,
        means_init: Any = None,
        covariances_init: Any = None,
        random_state: Any = None,
        warm_start: bool = False,
        verbose: int = 0,
        dtype: str = "float64",
        device: str | torch.device = "cpu",
    ) -> None:
        self.n_components = n_components
        self.blocks = blocks
        self.covariance_type = covariance_type
        self.tol = tol
        self.reg_covar = reg_covar
        self.regularization = regularization
        self.max_iter = max_iter
        self.n_init = n_init
        self.init_params = init_params
        self.time_feature = time_feature
        self.group_size = group_size
        self.weights_init = weights_init
        self.means_init = means_init
        self.covariances_init = covariances_init
        self.random_state = random_state
        self.warm_start = warm_start
        self.verbose = verbose
        self.dtype = dtype
        self.device = device

    @classmethod
    def from_parameters(
        cls,
        weights: Tensor,
        means: Sequence[Tensor],
        covariances: Sequence[Tensor],
        **settings: Any,
    ) -> Self:
        """A fitted mixture from weights (K,), means (K, D_j), covariances (K, D_j, D_j).

        Parameters
        ----------
        weights, means, covariances : Tensor, sequences of Tensor
            As in the attributes.
        **settings
            Parameters of the constructor.

        Raises
        ------
        ShapeError, DataError
            If they do not fit together or are no mixture.
        """
        widths = tuple(len(mean[0]) for mean in means)
        defaults: dict[str, Any] = {"n_components": len(weights), "blocks": widths}
        model = cls(**(defaults | settings))
        widths = check_blocks(model.blocks, sum(widths))
        given = GivenStart.checked(weights, means, covariances, model.n_components, widths)
        model.n_features_in_ = sum(widths)
        model._set(given.over(Parameters.standard(model.n_components, widths)))
        return model

    def fit(self, X: Any, y: Any = None) -> Self:
        """Learn the mixture by EM.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
        y : Ignored

        Returns
        -------
        self

        Raises
        ------
        ShapeError
            If the blocks, the groups, or the arrays of the start do not fit the data.
        DataError
            If there are fewer distinct points than components.
        """
        self._validate_params()
        points = validate_data(
            self, _on_cpu(X), dtype=[np.float64, np.float32], ensure_min_samples=2
        )
        widths = check_blocks(self.blocks, points.shape[1])
        if len(points) % self.group_size:
            raise ShapeError(f"{len(points)} rows are no multiple of {self.group_size=}")
        isotropic = self.covariance_type == "spherical"
        units = Standardization.of_data(points, widths, isotropic=isotropic)
        units = units.to(torch.device(self.device))
        dtype = getattr(torch, self.dtype)
        chunks = units.chunks(points, self.n_components, dtype, self.group_size)
        relative = self.regularization == "relative"
        family = Family.regularized(
            self.covariance_type, units, self.reg_covar, relative=relative, dtype=dtype
        )
        known = (self.weights_init, self.means_init, self.covariances_init)
        if self.warm_start and hasattr(self, "weights_"):
            known = (self.weights_, self.means_, self.covariances_)
        given = GivenStart.checked(*known, self.n_components, widths).standardize(units)
        drawer = StartDrawer(self.init_params, self.time_feature, self.n_components, chunks)
        names = ("tol", "max_iter", "group_size", "verbose")
        settings = {name: getattr(self, name) for name in names}
        rng = check_random_state(self.random_state)
        runs = []
        for attempt in range(1 if given.complete else self.n_init):
            start = family.admit(given.over(drawer.draw(attempt, family, rng)))
            runs.append(ascend(start, chunks, family, rng=rng, **settings))
        best = max(runs, key=lambda run: run.bound)
        self._set(units.restore(best.expectation.parameters))
        self.converged_, self.n_iter_ = best.converged, best.n_iter
        self.lower_bound_ = best.bound - units.log_volume
        self.lower_bounds_ = [bound - units.log_volume for bound in best.bounds]
        for category, message in best.complaints():
            warnings.warn(message, category, stacklevel=2)
        return self

    def fit_predict(self, X: Any, y: Any = None) -> NDArray[np.int64]:
        """Fit, and return :meth:`predict` of the same points."""
        return self.fit(X).predict(X)

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

    def _set(self, parameters: Parameters) -> None:
        """Set the mixture in units of the data."""
        target = {"dtype": getattr(torch, self.dtype), "device": torch.device(self.device)}
        self.weights_ = parameters.weights.to(**target)
        self.means_ = [mean.to(**target) for mean in parameters.means]
        self.covariances_ = [covariance.to(**target) for covariance in parameters.covariances]

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
        points = validate_data(self, _on_cpu(X), dtype=[np.float64, np.float32], reset=False)
        units = Standardization.of_mixture(parameters)
        chunks = units.chunks(points, len(parameters.weights), self.weights_.dtype)
        whitener = Whitener(units.standardize(parameters), self.weights_.dtype)
        for chunk in chunks:
            yield whitener(chunk)[0] - units.log_volume


def _on_cpu(X: Any) -> Any:
    """A tensor as an array, anything else as it is."""
    return X.detach().cpu().numpy() if isinstance(X, Tensor) else X


def _to_numpy(chunks: Iterator[Tensor]) -> NDArray[Any]:
    """Put the results of the chunks together."""
    result: NDArray[Any] = torch.cat(list(chunks)).cpu().numpy()
    return result

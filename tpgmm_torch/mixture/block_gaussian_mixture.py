"""A Gaussian mixture over blocks of columns, as a scikit-learn estimator."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.utils._param_validation import Interval, StrOptions
from sklearn.utils.validation import validate_data
from torch import Tensor

from tpgmm_torch.em.ascent import Run
from tpgmm_torch.em.block_gaussians import Parameters, Standardization, check_blocks
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.large_data.processes import ALONE, Processes
from tpgmm_torch.large_data.row_batches import BatchedRows, Rows, StoredRows, are_batches
from tpgmm_torch.mixture.checkpoints import Checkpoint
from tpgmm_torch.mixture.density import MixtureDensity, on_cpu
from tpgmm_torch.mixture.fitting import Learning, learn_subsets
from tpgmm_torch.mixture.initial_parameters import GivenStart

__all__ = ["BlockGaussianMixture", "fit_subsets"]


class BlockGaussianMixture(MixtureDensity, BaseEstimator):  # type: ignore[misc]
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
    >>> from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
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

    def fit(
        self,
        X: Any,
        y: Any = None,
        *,
        checkpoint: Checkpoint | None = None,
        processes: Processes = ALONE,
    ) -> Self:
        """Learn the mixture by EM.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features), or iterable of such arrays
            Batches, for data larger than memory: each ``iter(X)`` has to give the same ones
            anew, one pass per iteration of EM.
        y : Ignored
        checkpoint : Checkpoint, optional
            Where to keep the state of EM, and to go on from if there is one.
        processes : Processes, optional
            Those that learn together: what
            :func:`~tpgmm_torch.large_data.processes.joined_processes` gives;
            X is then the share of this one, and each has the whole result.

        Returns
        -------
        self

        Raises
        ------
        ShapeError
            If the blocks, the groups, or the arrays of the start do not fit the data.
        DataError
            If there are fewer distinct points than components, a batch is no finite array
            like the others, or batches can be walked through only once.
        ModelFileError
            If the checkpoint is damaged, or of other data or settings.
        DistributedError
            If another of the processes died.
        """
        self._validate_params()
        if are_batches(X):
            rows: Rows = BatchedRows(X, self.group_size)
            return self.fit_rows(rows, checkpoint=checkpoint, processes=processes)
        points = validate_data(
            self, on_cpu(X), dtype=[np.float64, np.float32], ensure_min_samples=2
        )
        rows = StoredRows(points)
        return self.fit_rows(rows, checkpoint=checkpoint, processes=processes)

    def fit_rows(
        self,
        rows: Rows,
        *,
        moments: ColumnMoments | None = None,
        checkpoint: Checkpoint | None = None,
        processes: Processes = ALONE,
    ) -> Self:
        """Learn the mixture from rows that are wherever they are; :meth:`fit` calls this.

        Parameters
        ----------
        rows : Rows
            Of this process.
        moments : ColumnMoments, optional
            Of the rows of all processes, where they are known already.
        checkpoint : Checkpoint, optional
        processes : Processes, optional

        Returns
        -------
        self

        Raises
        ------
        ShapeError, DataError, ModelFileError, DistributedError
            As :meth:`fit`.
        """
        moments = moments or ColumnMoments.of_batches(rows, processes)
        learning = self._learning(rows, moments, processes)
        self._take(learning.runs(checkpoint), learning.units)
        return self

    def _learning(
        self, rows: Rows, moments: ColumnMoments, processes: Processes = ALONE
    ) -> Learning:
        known = (self.weights_init, self.means_init, self.covariances_init)
        if self.warm_start and hasattr(self, "weights_"):
            known = (self.weights_, self.means_, self.covariances_)
        return Learning(self.get_params(deep=False), known, rows, moments, processes)

    def _take(self, runs: Sequence[Run], units: Standardization) -> None:
        """Take over the best of the runs."""
        best = max(runs, key=lambda run: run.bound)
        self.n_features_in_ = sum(len(shift) for shift in units.shifts)
        self._set(units.restore(best.parameters))
        self.converged_, self.n_iter_ = best.converged, best.n_iter
        self.lower_bound_ = best.bound - units.log_volume
        self.lower_bounds_ = [bound - units.log_volume for bound in best.bounds]
        for category, message in best.complaints():
            warnings.warn(message, category, stacklevel=4)

    def fit_predict(self, X: Any, y: Any = None) -> NDArray[np.int64]:
        """Fit, and return :meth:`predict` of the same points."""
        return self.fit(X).predict(X)

    def _set(self, parameters: Parameters) -> None:
        """Set the mixture in units of the data."""
        target = {"dtype": getattr(torch, self.dtype), "device": torch.device(self.device)}
        self.weights_ = parameters.weights.to(**target)
        self.means_ = [mean.to(**target) for mean in parameters.means]
        self.covariances_ = [covariance.to(**target) for covariance in parameters.covariances]


def fit_subsets(
    mixtures: Sequence[BlockGaussianMixture],
    X: NDArray[np.floating],
    members: NDArray[np.bool_],
    group_size: int = 1,
    moments: Sequence[ColumnMoments] | None = None,
) -> None:
    """Fit several mixtures, each to some of the rows, in passes that they share.

    The result is that of fitting each to its rows alone, to rounding, in less time: points are
    expanded once for all, as for restarts. That is what cross-validation asks for.

    Parameters
    ----------
    mixtures : sequence of BlockGaussianMixture
        Of equal settings, but for ``reg_covar``, ``group_size`` and what the start is.
    X : array of shape (n_samples, n_features)
        All rows.
    members : array of bool, of shape (S, n_samples)
        The rows of each mixture: ``group_size`` of its own from each group of all.
    group_size : int, default=1
        So many consecutive rows of ``X`` share one responsibility.
    moments : sequence of ColumnMoments, optional
        Of the rows of each mixture, where they are known already.

    Raises
    ------
    ShapeError, DataError
        As :meth:`BlockGaussianMixture.fit_rows`.
    """
    rows = StoredRows(X)
    whole = mixtures[0]._learning(rows, ColumnMoments.of_batches(rows))
    whole = replace(whole, settings={**whole.settings, "group_size": group_size})
    own = [StoredRows(X[chosen]) for chosen in members]
    moments = moments or [ColumnMoments.of_batches(part) for part in own]
    parts = [
        mixture._learning(part, known)
        for mixture, part, known in zip(mixtures, own, moments, strict=True)
    ]
    for mixture, runs in zip(mixtures, learn_subsets(whole, parts, members), strict=True):
        mixture._take(runs, whole.units)

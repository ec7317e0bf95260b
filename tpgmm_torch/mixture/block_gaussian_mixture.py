"""A Gaussian mixture over blocks of columns, as a scikit-learn estimator."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from itertools import islice
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
import torch
from numpy.random import RandomState
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, DensityMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import validate_data
from torch import Tensor

from tpgmm_torch.constraints import Interval, Options, check_parameters
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.em.covariance_family import CovarianceFamily
from tpgmm_torch.em.covariance_shrinkage import shrink
from tpgmm_torch.em.expectation_maximization import Fit, expectation_maximization
from tpgmm_torch.em.parameters import Parameters, Standardization, check_blocks
from tpgmm_torch.em.points import standardized_chunks
from tpgmm_torch.em.whitening import Whitener
from tpgmm_torch.exceptions import (
    ConvergenceWarning,
    DataError,
    DegenerateComponentWarning,
    NotFittedError,
    ShapeError,
)
from tpgmm_torch.large_data.checkpoints import Checkpoint
from tpgmm_torch.large_data.processes import (
    ALONE,
    Processes,
    column_moments,
    common_random_state,
)
from tpgmm_torch.large_data.row_batches import BatchedRows, Rows, StoredRows, are_batches
from tpgmm_torch.large_data.row_points import RowPoints
from tpgmm_torch.mixture.initial_parameters import InitialParameters
from tpgmm_torch.mixture.initialization import check_distinct, draw_starts
from tpgmm_torch.mixture.variance_moderation import moderate

__all__ = ["BlockGaussianMixture", "fit_subsets"]

#: Settings that a checkpoint has to share, beside the blocks and the initial parameters.
SHAPING = (
    "n_components", "covariance_type", "tol", "reg_covar", "regularization", "n_init",
    "init_params", "time_feature", "group_size", "random_state", "dtype",
)  # fmt: skip


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
    covariance_shrinkage : float or "auto", default=0
        How far the full or tied covariances that EM found go towards their diagonals, from 0
        to 1. "auto" follows from the number of samples and of columns, component by component
        (:func:`~tpgmm_torch.em.covariance_shrinkage.oracle_approximating_intensity`); it also
        moderates the variances of columns of one unit by each other
        (:func:`~tpgmm_torch.mixture.variance_moderation.moderated_variances`).
    column_units : sequence of str or None, of shape (n_features,), optional
        The unit of each column, for "auto": those of one unit in one block are alike. None is
        for columns that are like no other; by default all are.
    n_demonstrations : float, optional
        How many samples there are for "auto", where the rows are those of so many
        demonstrations that each visit every component; None counts each row.
    timed_blocks : bool, default=False
        Whether every block begins with time: the covariances *given time* shrink then, and
        slopes over time stay as they are.
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
        For the starts, for components that are reseeded, and for :meth:`sample`.
    warm_start : bool, default=False
        Continue from the last fit instead of from the beginning.
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
        as in scikit-learn; ``score`` of the result is not below it, unless the covariances
        were shrunk thereafter.
    lower_bounds_ : list of float
        Its history, which never falls. Where reseeding a component lowers it, the history
        begins again at that point.
    n_features_in_ : int

    Warns
    -----
    ConvergenceWarning
        If the best start did not converge.
    DegenerateComponentWarning
        If one of its components lost its data and was reseeded.

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
        "covariance_type": [Options("full", "tied", "diag", "spherical")],
        "tol": [Interval(Real, 0.0, None, closed="left")],
        "reg_covar": [Interval(Real, 0.0, None, closed="left"), "array-like"],
        "regularization": [Options("relative", "absolute")],
        "covariance_shrinkage": [Interval(Real, 0, 1, closed="both"), Options("auto")],
        "column_units": ["array-like", None],
        "n_demonstrations": [Interval(Real, 0, None, closed="neither"), None],
        "timed_blocks": ["boolean"],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "n_init": [Interval(Integral, 1, None, closed="left")],
        "init_params": [Options("time", "kmeans", "random")],
        "time_feature": [Interval(Integral, 0, None, closed="left")],
        "group_size": [Interval(Integral, 1, None, closed="left")],
        "weights_init": ["array-like", None],
        "means_init": ["array-like", None],
        "covariances_init": ["array-like", None],
        "random_state": ["random_state"],
        "warm_start": ["boolean"],
        "verbose": ["verbose"],
        "dtype": [Options("float64", "float32")],
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
        covariance_shrinkage: float | str = 0.0,
        column_units: Sequence[str | None] | None = None,
        n_demonstrations: float | None = None,
        timed_blocks: bool = False,
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
        self.covariance_shrinkage = covariance_shrinkage
        self.column_units = column_units
        self.n_demonstrations = n_demonstrations
        self.timed_blocks = timed_blocks
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
        given = InitialParameters.checked(
            weights, means, covariances, model.n_components, widths
        )
        model.n_features_in_ = sum(widths)
        model._set(given.over(None))
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
            Batches, for data larger than memory: each ``iter(X)`` has to give the same ones,
            from the first on, in one pass per iteration of EM.
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
        check_parameters(self)
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

        Returns
        -------
        self

        Raises
        ------
        ShapeError, DataError, ModelFileError, DistributedError
            As :meth:`fit`.
        """
        moments = moments or column_moments(rows, processes)
        units = self._units(rows, moments)
        family = self._family(units)
        points = self._points(rows, units, moments.count, processes=processes)
        fits, after = None, None
        if checkpoint is not None:
            settings: dict[str, Any] = {name: getattr(self, name) for name in SHAPING}
            settings |= {"blocks": units.widths, "start": self._initial_parameters()}
            fits = checkpoint.resume(settings, moments, processes)

            def after(fits: Sequence[Fit]) -> None:
                if processes.rank == 0:
                    checkpoint.keep(fits, settings, moments, self.max_iter)

        fits = fits or self._starts(rows, moments, units, family, processes)
        expectation_maximization(
            fits, points, family, group_size=self.group_size, after=after, **self._loop()
        )
        return self._take_best(fits, units, moments.count)

    def _units(self, rows: Rows, moments: ColumnMoments) -> Standardization:
        """The units in which the mixture is learned."""
        if moments.count < 2:
            raise DataError("the data hold 1 sample; a mixture is learned from at least 2")
        if rows.n_rows % self.group_size:
            raise ShapeError(
                f"{rows.n_rows} rows are no multiple of group_size={self.group_size}"
            )
        units = moments.standardization(
            check_blocks(self.blocks, len(moments.mean)),
            isotropic=self.covariance_type == "spherical",
        )
        return units.to(torch.device(self.device))

    def _family(self, units: Standardization) -> CovarianceFamily:
        """The covariances that are admitted, in those units."""
        return CovarianceFamily.regularized(
            self.covariance_type,
            units,
            self.reg_covar,
            relative=self.regularization == "relative",
            dtype=getattr(torch, self.dtype),
        )

    def _points(
        self,
        rows: Rows,
        units: Standardization,
        total: int,
        *,
        group_size: int | None = None,
        processes: Processes = ALONE,
    ) -> RowPoints:
        """The rows as EM walks through them, sorted by time where there is such a column."""
        return RowPoints(
            rows,
            total,
            units,
            self.n_components,
            getattr(torch, self.dtype),
            group_size=group_size or self.group_size,
            time_feature=self.time_feature if self.time_feature < units.widths[0] else None,
            processes=processes,
        )

    @property
    def unshrunk_covariances(self) -> list[Tensor]:
        """Where EM ended, before covariances were shrunk; one tensor per block."""
        return getattr(self, "_unshrunk", None) or self.covariances_

    @unshrunk_covariances.setter
    def unshrunk_covariances(self, covariances: Sequence[Tensor]) -> None:
        self._unshrunk = list(covariances)

    def _initial_parameters(self) -> tuple[Any, Any, Any]:
        """Weights, means and covariances as far as they are given, else None."""
        if self.warm_start and hasattr(self, "weights_"):
            # where EM ended, which what was shrunk thereafter is not
            return self.weights_, self.means_, self.unshrunk_covariances
        return self.weights_init, self.means_init, self.covariances_init

    def _starts(
        self,
        rows: Rows,
        moments: ColumnMoments,
        units: Standardization,
        family: CovarianceFamily,
        processes: Processes = ALONE,
    ) -> list[Fit]:
        """Where EM starts, drawn as far as it is not given."""
        given = InitialParameters.checked(
            *self._initial_parameters(), self.n_components, units.widths, self.device
        )
        check_distinct(rows, moments.count, self.n_components, processes)
        rng = common_random_state(self.random_state, processes)
        drawn: Sequence[Parameters | None] = [None]
        if not given.complete:
            standardized = draw_starts(
                self.init_params,
                self.n_init,
                rows,
                moments.count,
                units,
                family,
                rng,
                n_components=self.n_components,
                time_feature=self.time_feature,
                group_size=self.group_size,
                processes=processes,
            )
            drawn = [units.restore(start) for start in standardized]
        starts = [units.standardize(given.over(start)) for start in drawn]
        return [
            Fit(family.admit(start), RandomState(rng.randint(2**31 - 1))) for start in starts
        ]

    def _loop(self) -> dict[str, Any]:
        """The settings of the loop of EM."""
        return {"tol": self.tol, "max_iter": self.max_iter, "verbose": self.verbose}

    def _take_best(self, fits: Sequence[Fit], units: Standardization, n_rows: int) -> Self:
        """Take over the best of the fits, and warn of what the user should know."""
        best = max(fits, key=lambda fit: fit.bounds[-1])
        self.n_features_in_ = sum(units.widths)
        self._set(units.restore(best.parameters))
        self.unshrunk_covariances = self.covariances_
        self._set(self._shrunk(best.parameters, n_rows, units))
        self.converged_, self.n_iter_ = best.converged, best.n_iter
        self.lower_bounds_ = [bound - units.log_volume for bound in best.bounds]
        self.lower_bound_ = self.lower_bounds_[-1]
        if best.reseedings:
            warnings.warn(
                f"reseeded for having lost their data: {'; '.join(best.reseedings)}; "
                "use fewer components, a larger reg_covar or another start",
                DegenerateComponentWarning,
                stacklevel=4,
            )
        if not best.converged:
            warnings.warn(
                f"EM did not converge in {best.n_iter} iterations: raise max_iter or tol, or "
                "use another start",
                ConvergenceWarning,
                stacklevel=4,
            )
        return self

    def _shrunk(
        self, parameters: Parameters, n_rows: int, units: Standardization
    ) -> Parameters:
        """What EM found, restored, with covariances shrunk where they have correlations."""
        if self.covariance_type not in ("full", "tied") or self.covariance_shrinkage == 0:
            return units.restore(parameters)
        n_samples: Tensor | float = n_rows  # those of a tied covariance
        if self.n_demonstrations is not None:
            n_samples = self.n_demonstrations
        elif self.covariance_type == "full":
            n_samples = n_rows * parameters.weights
        given = int(self.timed_blocks)
        shrunk = shrink(parameters, self.covariance_shrinkage, n_samples, given=given)
        restored = units.restore(shrunk)
        if self.column_units is None or self.covariance_shrinkage != "auto":
            return restored
        names = iter(self.column_units)
        if len(self.column_units) != sum(units.widths):
            raise ShapeError(
                f"column_units has {len(self.column_units)} units, but the data have "
                f"{sum(units.widths)} columns"
            )
        of_blocks = [tuple(islice(names, width))[given:] for width in units.widths]
        return moderate(restored, of_blocks, n_samples, given=given)

    def fit_predict(self, X: Any, y: Any = None) -> NDArray[np.int64]:
        """Fit, and return :meth:`predict` of the same points."""
        return self.fit(X).predict(X)

    def _set(self, parameters: Parameters) -> None:
        """Set the mixture in units of the data."""
        target = {"dtype": getattr(torch, self.dtype), "device": torch.device(self.device)}
        self.weights_ = parameters.weights.to(**target)
        self.means_ = [mean.to(**target) for mean in parameters.means]
        self.covariances_ = [covariance.to(**target) for covariance in parameters.covariances]

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
        whitener = Whitener(units.standardize(parameters), self.weights_.dtype)
        for chunk in standardized_chunks(
            points, units, len(parameters.weights), self.weights_.dtype
        ):
            yield whitener.log_joint(chunk)[0] - units.log_volume


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
        Of equal settings, but for ``reg_covar``, ``group_size``, ``n_demonstrations`` and what
        the start is.
    X : array of shape (n_samples, n_features)
        All rows.
    members : array of bool, of shape (S, n_samples)
        The rows of each mixture. Where its start is drawn, ``group_size`` of its own from each
        group of all.
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
    first = mixtures[0]
    units = column_moments(rows).standardization(
        check_blocks(first.blocks, X.shape[1]), isotropic=first.covariance_type == "spherical"
    )
    units = units.to(torch.device(first.device))
    points = first._points(rows, units, len(X), group_size=group_size)
    parts = [StoredRows(X[own]) for own in members]
    moments = moments or [column_moments(part) for part in parts]
    fits: list[list[Fit]] = []
    families: list[CovarianceFamily] = []
    for mixture, part, known in zip(mixtures, parts, moments, strict=True):
        own_units = mixture._units(part, known)
        family = mixture._family(own_units)
        starts = mixture._starts(part, known, own_units, family)
        for fit in starts:
            fit.parameters = units.standardize(own_units.restore(fit.parameters))
        fits.append(starts)
        families += [family.rescaled(own_units, units)] * len(starts)
    belongs = torch.from_numpy(members[:, points.numbers()]).to(points.device)
    expectation_maximization(
        [fit for starts in fits for fit in starts],
        points,
        families,
        group_size=group_size,
        members=belongs.repeat_interleave(len(fits[0]), 0),
        **first._loop(),
    )
    for mixture, starts, known in zip(mixtures, fits, moments, strict=True):
        mixture._take_best(starts, units, known.count)


def on_cpu(X: Any) -> Any:
    """X as an array if it is a tensor, as it is if not."""
    return X.detach().cpu().numpy() if isinstance(X, Tensor) else X


def _to_numpy(chunks: Iterator[Tensor]) -> NDArray[Any]:
    """Put the results of the chunks together."""
    result: NDArray[Any] = torch.cat(list(chunks)).cpu().numpy()
    return result

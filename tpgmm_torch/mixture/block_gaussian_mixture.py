"""A Gaussian mixture over blocks of columns, as a scikit-learn estimator."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
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
from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.exceptions import (
    ConvergenceWarning,
    DataError,
    DegenerateComponentWarning,
    NotFittedError,
    ShapeError,
)
from tpgmm_torch.mixture import expectation_maximization as em
from tpgmm_torch.mixture.initialization import draw_starts
from tpgmm_torch.mixture.points import Points
from tpgmm_torch.mixture.processes import ALONE, Processes
from tpgmm_torch.mixture.row_file import FILE_ROWS, ColumnMoments, RowFile, Rows

__all__ = ["BlockGaussianMixture"]

#: Least regularisation, as a share of the variance, that survives rounding.
SMALLEST_SHARE = {torch.float64: 1e-12, torch.float32: 2e-6}


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
        Regularisation of the covariances' diagonals, as a share of each column's variance (of
        its block's mean variance where a column is constant, or ``covariance_type`` is
        "spherical"). It is never less than 1e-12 (float64), 2e-6 (float32).
    max_iter : int, default=100
        Most EM iterations per start.
    n_init : int, default=1
        Number of starts; the one with the highest bound wins.
    init_params : {"time", "kmeans", "random"}, default="time"
        Equal bins along the first column (with bins of random sizes in further starts),
        k-means on standardised data, or the nearest of K random points.
    group_size : int, default=1
        In ``fit``, this many consecutive rows share one responsibility, that of the geometric
        mean of their densities: demonstrations of one skill at one instant, for example.
    random_state : int, RandomState or None, default=None
        For the starts, for components that are reseeded, and for :meth:`sample`.
    dtype : {"float64", "float32"}, default="float64"
        Precision of the passes over the data and of the result; sums are in float64.
    device : str or torch.device, default="cpu"
        Where to compute.

    Attributes
    ----------
    weights_ : Tensor of shape (K,)
        Shares of the components; they add up to 1.
    means_ : list of Tensor of shape (K, D_j)
        One per block.
    covariances_ : list of Tensor of shape (K, D_j, D_j)
        One per block, full matrices whatever the ``covariance_type``.
    converged_ : bool
        Whether the best start came to its end before ``max_iter``.
    n_iter_ : int
        Iterations of the best start.
    lower_bound_ : float
        Mean log-likelihood of the training data under the mixture before the last M step,
        as in scikit-learn; ``score`` of the result is not below it.
    lower_bounds_ : list of float
        Its history, which never falls. Where reseeding a component lowers it, the history
        begins again at that point.
    n_features_in_ : int
        Number of columns of all blocks.

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
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "n_init": [Interval(Integral, 1, None, closed="left")],
        "init_params": [Options("time", "kmeans", "random")],
        "group_size": [Interval(Integral, 1, None, closed="left")],
        "random_state": ["random_state"],
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
        max_iter: int = 100,
        n_init: int = 1,
        init_params: str = "time",
        group_size: int = 1,
        random_state: Any = None,
        dtype: str = "float64",
        device: str | torch.device = "cpu",
    ) -> None:
        self.n_components = n_components
        self.blocks = blocks
        self.covariance_type = covariance_type
        self.tol = tol
        self.reg_covar = reg_covar
        self.max_iter = max_iter
        self.n_init = n_init
        self.init_params = init_params
        self.group_size = group_size
        self.random_state = random_state
        self.dtype = dtype
        self.device = device

    @classmethod
    def from_parameters(
        cls, weights: Any, means: Sequence[Any], covariances: Sequence[Any], **settings: Any
    ) -> Self:
        """Make a mixture of weights (K,), means (K, D_j), covariances (K, D_j, D_j).

        Parameters
        ----------
        weights, means, covariances : array-like, sequences of array-like
            As in the attributes.
        **settings
            Parameters of the constructor.

        Raises
        ------
        ShapeError, DataError
            If they do not fit together or are no mixture.
        """
        widths = [len(mean[0]) for mean in means]
        defaults: dict[str, Any] = {"n_components": len(weights), "blocks": widths}
        model = cls(**(defaults | settings))
        widths, k = model._widths(sum(widths)), model.n_components
        shapes = [(k,), *((k, d) for d in widths), *((k, d, d) for d in widths)]
        tensors = [
            as_tensor(one, "a mixture").double() for one in (weights, *means, *covariances)
        ]
        if [tuple(tensor.shape) for tensor in tensors] != shapes:
            raise ShapeError(
                f"weights, means and covariances of {k} components have the shapes {shapes}, "
                f"got {[tuple(tensor.shape) for tensor in tensors]}"
            )
        shares, count = tensors[0], len(widths)
        if bool((shares < 0).any()) or abs(float(shares.sum()) - 1) > 1e-3:
            raise DataError(f"weights must be positive and add up to 1, got {weights!r}")
        moments = tuple(tensors[1 : count + 1]), tuple(tensors[count + 1 :])
        em.whiten(parameters := em.Parameters(shares / shares.sum(), *moments))
        return model._set(parameters)

    def fit(
        self,
        X: Any,
        y: Any = None,
        *,
        start: BlockGaussianMixture | None = None,
        processes: Processes = ALONE,
    ) -> Self:
        """Learn the mixture by EM.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features), or RowFile
            Data larger than memory are
            :meth:`RowFile.of(batches) <tpgmm_torch.mixture.row_file.RowFile.of>`.
        y : ignored
            Here for scikit-learn.
        start : BlockGaussianMixture, optional
            Fitted; EM begins with its parameters, in place of ``init_params``.
        processes : Processes, optional
            Those that learn together: what
            :func:`~tpgmm_torch.mixture.processes.joined_processes` gives;
            X is then the share of this one, and each has the whole result.

        Returns
        -------
        self

        Raises
        ------
        ShapeError
            If the blocks, the groups, or the start do not fit the data.
        DataError
            If there are fewer distinct points than components.
        DistributedError
            If another of the processes died.
        """
        check_parameters(self)
        rows = self._rows(X)
        moments = ColumnMoments.of(rows, processes)
        if moments.count < 2:
            raise DataError("the data hold 1 sample; a mixture is learned from at least 2")
        widths = self._widths(len(moments.mean))
        scales = moments.scales(widths, isotropic=self.covariance_type == "spherical")
        shift, scale = (torch.from_numpy(x).to(self.device) for x in (moments.mean, scales))
        points = Points(
            rows, shift, scale, widths, self.n_components, getattr(torch, self.dtype),
            self.group_size, processes,
        )  # fmt: skip
        seed, family = self.random_state, self._family(widths)
        if processes.count > 1 and not isinstance(seed, Integral):
            seed = processes.gather(check_random_state(seed).randint(2**31))[0]
        rng = check_random_state(seed)
        starts = self._starts(start, points, family, rng)
        fits = [
            em.expectation_maximization(
                begin, points, family, RandomState(rng.randint(2**31 - 1)),
                tol=self.tol, max_iter=self.max_iter,
            )
            for begin in starts
        ]  # fmt: skip
        best = max(fits, key=lambda fit: fit.bounds[-1])
        self.converged_, self.n_iter_ = best.converged, best.n_iter
        self.lower_bounds_ = [bound - float(scale.log().sum()) for bound in best.bounds]
        self.lower_bound_ = self.lower_bounds_[-1]
        _warn(best)
        return self._set(best.parameters.affine(scale, shift))

    def _starts(
        self,
        start: BlockGaussianMixture | None,
        points: Points,
        family: em.CovarianceFamily,
        rng: RandomState,
    ) -> list[em.Parameters]:
        """Choose where EM begins, in standardised units."""
        if start is None:
            settings = self.init_params, self.n_init, self.n_components
            return draw_starts(*settings, points, family, rng)
        given = len(start.weights_), [*map(_width, start.means_)]
        if given != (self.n_components, points.widths):
            raise ShapeError(
                f"the start has {given[0]} components in blocks of {given[1]} columns, "
                f"asked for are {self.n_components} in blocks of {points.widths}"
            )
        standard = 1 / points.scale, -points.shift / points.scale
        return [family.admit(start._parameters().affine(*standard))]

    def _rows(self, X: Any) -> Rows:
        """Check the rows of X."""
        rows: Rows = X
        if not isinstance(X, RowFile):
            kinds = [np.float64, np.float32]
            rows = validate_data(self, _on_cpu(X), dtype=kinds, ensure_min_samples=2)
        if len(rows) % self.group_size:
            raise ShapeError(
                f"{len(rows)} rows are no multiple of group_size={self.group_size}"
            )
        return rows

    def _widths(self, n_features: int) -> list[int]:
        """Check widths of the blocks against the data."""
        widths = [n_features] if self.blocks is None else list(self.blocks)
        if not all(isinstance(width, Integral) and width > 0 for width in widths):
            raise ShapeError(f"blocks must be positive integers, got {self.blocks!r}")
        if sum(widths) != n_features:
            raise ShapeError(
                f"blocks={self.blocks!r} add up to {sum(widths)} columns, but the data have "
                f"{n_features}"
            )
        return list(map(int, widths))

    def _family(self, widths: list[int]) -> em.CovarianceFamily:
        """Make the family of admitted covariances, in standardised units."""
        shares = np.asarray(self.reg_covar, dtype=np.float64)
        if shares.shape not in ((), (sum(widths),)):
            raise ShapeError(
                f"reg_covar is one number or one for each of the {sum(widths)} columns, got "
                f"shape {shares.shape}"
            )
        if not (np.isfinite(shares) & (shares >= 0)).all():
            raise DataError(
                f"reg_covar must be finite and not negative, got {self.reg_covar!r}"
            )
        smallest = SMALLEST_SHARE[getattr(torch, self.dtype)]
        diagonal = torch.from_numpy(np.broadcast_to(shares, sum(widths)).clip(min=smallest))
        return em.CovarianceFamily(self.covariance_type, diagonal.to(self.device).split(widths))

    def _set(self, parameters: em.Parameters) -> Self:
        """Set the mixture in units of the data."""
        target = {"dtype": getattr(torch, self.dtype), "device": torch.device(self.device)}
        self.weights_ = parameters.weights.to(**target)
        self.means_ = [mean.to(**target) for mean in parameters.means]
        self.covariances_ = [covariance.to(**target) for covariance in parameters.covariances]
        self.n_features_in_ = sum(map(_width, self.means_))
        return self

    def score_samples(self, X: Any) -> NDArray[np.floating]:
        """Compute the log-density of each point.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Points, one in each row.

        Returns
        -------
        array of shape (n_samples,)
        """
        return self._evaluate(X, lambda joint: joint.logsumexp(0))

    def score(self, X: Any, y: Any = None) -> float:
        """Compute the mean log-density of the points X (n_samples, n_features)."""
        return float(self.score_samples(X).mean(dtype=np.float64))

    def predict_proba(self, X: Any) -> NDArray[np.floating]:
        """Compute responsibilities of the components for each point.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Points, one in each row.

        Returns
        -------
        array of shape (n_samples, K)
        """
        return self._evaluate(X, lambda joint: joint.softmax(0).T)

    def predict(self, X: Any) -> NDArray[np.int64]:
        """Return the most probable component of each of the points X, shape (n_samples,)."""
        return self._evaluate(X, lambda joint: joint.argmax(0))

    @property
    def n_parameters_(self) -> int:
        """Number of free parameters: weights, means, and covariances of all blocks."""
        k, widths = len(self._parameters().weights), list(map(_width, self.means_))
        triangles = sum(width * (width + 1) // 2 for width in widths)
        covariances = {
            "full": k * triangles,
            "tied": triangles,
            "diag": k * sum(widths),
            "spherical": k * len(widths),
        }
        return k - 1 + k * sum(widths) + covariances[self.covariance_type]

    def bic(self, X: Any) -> float:
        """Compute the Bayesian information criterion on X (n_samples, n_features)."""
        return -2 * len(X) * self.score(X) + self.n_parameters_ * math.log(len(X))

    def sample(self, n_samples: int = 1) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
        """Draw points from the mixture.

        Parameters
        ----------
        n_samples : int, default=1
            Number of points.

        Returns
        -------
        X : array of shape (n_samples, n_features)
        labels : array of shape (n_samples,)
            The components that they came from, in ascending order.
        """
        parameters = self._parameters()
        if not isinstance(n_samples, Integral) or n_samples < 1:
            raise DataError(f"n_samples must be an integer of at least 1, got {n_samples!r}")
        rng = check_random_state(self.random_state)
        weights = parameters.weights.cpu().numpy()
        counts = rng.multinomial(n_samples, weights / weights.sum())
        labels = np.repeat(np.arange(len(counts)), counts)
        columns = []
        for mean, covariance in zip(parameters.means, parameters.covariances, strict=True):
            normal = rng.standard_normal((n_samples, mean.shape[1], 1))
            factor = torch.linalg.cholesky(covariance).cpu().numpy()
            columns.append(mean.cpu().numpy()[labels] + (factor[labels] @ normal)[..., 0])
        return np.concatenate(columns, axis=1).astype(self.dtype), labels

    def _parameters(self) -> em.Parameters:
        """Return the fitted mixture in float64."""
        if not hasattr(self, "weights_"):
            raise NotFittedError(
                f"this {type(self).__name__} is not fitted yet; call fit before this method"
            )
        doubled = (
            tuple(x.double() for x in blocks) for blocks in (self.means_, self.covariances_)
        )
        return em.Parameters(self.weights_.double(), *doubled)

    def _evaluate(self, X: Any, reduce: Callable[[Tensor], Tensor]) -> NDArray[Any]:
        """Apply a function to the log of weight times density, (K, n), of the rows."""
        parameters, dtype = self._parameters(), self.weights_.dtype
        points = validate_data(self, _on_cpu(X), dtype=[np.float64, np.float32], reset=False)
        # centred, so that offsets cost no digits
        center = torch.cat([parameters.weights @ mean for mean in parameters.means])
        exact, peaks = em.whiten(parameters.affine(torch.ones_like(center), -center))
        maps, peaks = [block_map.to(dtype) for block_map in exact], peaks.to(dtype)
        widths, found = [block_map.shape[1] for block_map in maps], []
        for start in range(0, len(points), FILE_ROWS):
            rows = torch.from_numpy(np.array(points[start : start + FILE_ROWS])).to(center)
            blocks = [
                torch.nn.functional.pad(block, (0, 1), value=1.0).T.to(dtype)
                for block in (rows - center).split(widths, 1)
            ]
            found.append(reduce(em.log_joint(blocks, maps, peaks)[0]).cpu().numpy())
        return np.concatenate(found)


def _width(block: Tensor) -> int:
    return block.shape[-1]


def _on_cpu(X: Any) -> Any:
    """Convert X to an array if it is a tensor."""
    return X.detach().cpu().numpy() if isinstance(X, Tensor) else X


def _warn(fit: em.Fit) -> None:
    """Warn of what the user should know of the best start."""
    if fit.reseedings:
        warnings.warn(
            f"reseeded for having lost their data: {'; '.join(fit.reseedings)}; use fewer "
            "components, a larger reg_covar or another start",
            DegenerateComponentWarning,
            stacklevel=4,
        )
    if not fit.converged:
        warnings.warn(
            f"EM did not converge in {fit.n_iter} iterations: raise max_iter or tol, or use "
            "another start",
            ConvergenceWarning,
            stacklevel=4,
        )

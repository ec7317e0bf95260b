"""Expectation-maximisation for Gaussian mixtures with block-diagonal covariances.

A point is made of P blocks of columns, independent given the component, which therefore share
their responsibilities (section II-B of the paper):

    gamma_k(x) ∝ pi_k prod_j N(x_j | mu_kj, Sigma_kj)

One iteration is one pass over chunks of points, wherever they are: what the M step needs are
sums over all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture.points import Points
from tpgmm_torch.mixture.row_file import FILE_ROWS

#: A component is left out of a chunk where its responsibilities are below exp(-36), rounding,
NEGLIGIBLE = -math.log(torch.finfo(torch.float64).eps)
#: and guessed to be by densities of the last pass that are less by so much more [nats]: of
#: smaller margins more guesses are wrong, and evaluated again.
MARGIN = 4.0
#: By how much a mean log-density may be off by rounding, relative to 1 and to itself: a few
#: 1e-12 where standardised covariances have a condition of 1e5, more or less by processor.
ROUNDING = {torch.float64: 1e-10, torch.float32: 1e-5}

#: Components (n,) of the points of a chunk, given its standardised rows (n, sum D_j) and their
#: numbers (n,).
Labeller = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Parameters:
    """A mixture in float64.

    Parameters
    ----------
    weights : Tensor of shape (K,)
        Positive; they add up to 1.
    means : tuple of Tensor of shape (K, D_j)
        One per block.
    covariances : tuple of Tensor of shape (K, D_j, D_j)
        One per block.
    """

    weights: Tensor
    means: tuple[Tensor, ...]
    covariances: tuple[Tensor, ...]

    def affine(self, scale: Tensor, shift: Tensor) -> Parameters:
        """Compute the mixture of ``scale * x + shift``, both of shape (sum D_j,)."""
        widths = [mean.shape[1] for mean in self.means]
        scales, shifts = scale.split(widths), shift.split(widths)
        means = [m * s + b for m, s, b in zip(self.means, scales, shifts, strict=True)]
        covariances = [
            c * s[:, None] * s for c, s in zip(self.covariances, scales, strict=True)
        ]
        return Parameters(self.weights, tuple(means), tuple(covariances))


@dataclass(frozen=True)
class CovarianceFamily:
    """Which covariances a mixture may have, in standardised units.

    Parameters
    ----------
    covariance_type : {"full", "tied", "diag", "spherical"}
        As of the estimator.
    diagonals : tuple of Tensor of shape (D_j,)
        Per block the diagonal of the regularisation ``Lambda``.
    """

    covariance_type: str
    diagonals: tuple[Tensor, ...]

    def restrict(self, covariance: Tensor, weights: Tensor) -> Tensor:
        """Find the most likely member for scatter (K, D_j, D_j) and weights (K,)."""
        diagonal = covariance.diagonal(dim1=1, dim2=2)
        match self.covariance_type:
            case "tied":
                return torch.einsum("k,kij->ij", weights, covariance).expand_as(covariance)
            case "diag":
                return torch.diag_embed(diagonal)
            case "spherical":
                return torch.diag_embed(diagonal.mean(1, keepdim=True).expand_as(diagonal))
        return covariance

    def regularize(self, covariance: Tensor, block: int, *, floor: bool) -> Tensor:
        """Add ``Lambda`` to covariances (K, D_j, D_j) of a block, or keep them above it.

        ``-log|Sigma| - tr(Sigma^-1 S)`` with ``Sigma - Lambda`` positive semi-definite is
        largest where the eigenvalues of ``Lambda^-1/2 S Lambda^-1/2`` below 1 are raised to 1.
        """
        diagonal = self.diagonals[block]
        if not floor:
            return covariance + torch.diag(diagonal)
        outer = torch.outer(diagonal, diagonal).sqrt()
        values, vectors = torch.linalg.eigh(covariance / outer)
        raised: Tensor = (vectors * values.clamp(min=1.0)[:, None]) @ vectors.mT * outer
        return raised

    def admit(self, parameters: Parameters) -> Parameters:
        """Bring any mixture into the family and above the regularisation."""
        covariances = [
            self.regularize(self.restrict(covariance, parameters.weights), block, floor=True)
            for block, covariance in enumerate(parameters.covariances)
        ]
        return Parameters(parameters.weights, parameters.means, tuple(covariances))


def whiten(parameters: Parameters) -> tuple[list[Tensor], Tensor]:
    """Compute maps to whitened ``L_k^-1 (x_j - mu_kj)``, and log-densities at the means.

    Parameters
    ----------
    parameters : Parameters
        In float64; ``Sigma_kj = L_k L_k^T``.

    Returns
    -------
    list of Tensor of shape (K, D_j, D_j + 1)
        Per block, to be multiplied with (x_j; 1).
    Tensor of shape (K,)
        Log of weight times density at the means of all blocks.

    Raises
    ------
    DataError
        If a covariance is not positive definite; the message says which.
    """
    maps, peaks = [], parameters.weights.log()
    for block, (mean, covariance) in enumerate(
        zip(parameters.means, parameters.covariances, strict=True)
    ):
        factor, info = torch.linalg.cholesky_ex(covariance)
        if bool(info.any()):
            raise DataError(
                f"the covariance of component {int(info.nonzero()[0, 0])}, block {block} is "
                "not positive definite; raise reg_covar, or use dtype='float64'"
            )
        width = mean.shape[1]
        eye = torch.eye(width).to(mean).expand_as(factor)
        homogeneous = torch.cat((eye, -mean[..., None]), -1)
        maps.append(torch.linalg.solve_triangular(factor, homogeneous, upper=False))
        log_determinant = factor.diagonal(dim1=1, dim2=2).log().sum(1)
        peaks = peaks - log_determinant - width * math.log(2 * math.pi) / 2
    return maps, peaks


def log_joint(
    blocks: Sequence[Tensor], maps: Sequence[Tensor], peaks: Tensor, group_size: int = 1
) -> tuple[Tensor, list[Tensor]]:
    """Log of ``pi_k prod_j N(x_j | mu_kj, Sigma_kj)``, and the whitened coordinates.

    Parameters
    ----------
    blocks : sequence of Tensor of shape (D_j + 1, n)
        (x_j; 1).
    maps, peaks : sequence of Tensor of shape (K, D_j, D_j + 1), Tensor of shape (K,)
        What :func:`whiten` gives, for some or all components.
    group_size : int, default=1
        So many consecutive points have the mean of their logarithms.

    Returns
    -------
    Tensor of shape (K, n)
    list of Tensor of shape (K, D_j, n)
    """
    joint, whitened = peaks[:, None], []
    for x, block_map in zip(blocks, maps, strict=True):
        y = (block_map.flatten(0, 1) @ x).view(*block_map.shape[:2], -1)
        joint = torch.sub(joint, y.square().sum(1), alpha=0.5)
        whitened.append(y)
    if group_size > 1:
        groups = joint.unflatten(1, (-1, group_size)).mean(2)
        joint = groups.repeat_interleave(group_size, 1)
    return joint, whitened


@dataclass(frozen=True)
class Expectation:
    """Sufficient statistics of one pass over the points: all that the M step needs.

    Attributes
    ----------
    parameters : Parameters
        The mixture that gave the responsibilities gamma.
    maps : list of Tensor of shape (K, D_j, D_j + 1)
        What took points to the whitened coordinates y: float64, rounded as the points are.
    mass : Tensor of shape (K,)
        ``sum_n gamma``, as all sums in float64 and over all processes.
    sums : list of Tensor of shape (D_j + 1, K, D_j)
        ``sum_n (x; 1) gamma y^T``.
    bound : float
        Mean log-density of the points.
    least : Tensor of shape (n_chunks,)
        Least log-density in each chunk of this process.
    """

    parameters: Parameters
    maps: list[Tensor]
    mass: Tensor
    sums: list[Tensor]
    bound: float
    least: Tensor


def e_step(parameters: Parameters, points: Points, least: Tensor | None = None) -> Expectation:
    """Pass over the points, each chunk with the components near it in time.

    Within a chunk no log-density of component k exceeds ``ub_k``, that at its mean less
    ``sum_j gap_kj^2 / 2 sigma_kj^2``, where ``gap_kj`` is how far the mean lies from the
    chunk's span of the first column of block j, and ``sigma_kj`` its deviation there: no
    Mahalanobis distance is less than that of a marginal. Components with ``ub_k`` below the
    chunk's least log-density by ``NEGLIGIBLE`` do not matter to it. Which ones these are is
    guessed from the last pass, and verified: a chunk whose least log-density does not confirm
    it is evaluated again.

    Parameters
    ----------
    parameters : Parameters
        In the units of the points.
    points : Points
        What the mixture is learned from.
    least : Tensor of shape (n_chunks,), optional
        That of the last pass; without it all components are evaluated at all points.
    """
    found, lowest = _Pass(parameters, points), list[float]()
    ceilings = _ceilings(parameters, found.peaks, points.spans)
    if least is None:
        least = torch.full_like(ceilings[:, 0], -math.inf)
    limits = torch.minimum(least, ceilings.amax(1)) - (NEGLIGIBLE + MARGIN)
    needed = ceilings > limits[:, None]
    chosen = needed.nonzero()[:, 1].split(needed.sum(1).tolist())
    every = zip(points, chosen, limits.tolist(), ceilings, strict=True)
    for (chunk, _), index, limit, ceiling in every:
        blocks = points.blocks(chunk)
        while True:
            joint, whitened = found.log_joint(blocks, index, points.group_size)
            density = joint.logsumexp(0)
            lowest.append(float(density.min()))
            if not limit > lowest[-1] - NEGLIGIBLE:  # nor where it is NaN
                break
            limit = -math.inf  # the guess was wrong
            index = (ceiling > lowest.pop() - NEGLIGIBLE).nonzero()[:, 0]
        # products with denormal numbers take very long
        gamma = joint.sub_(density).clamp_(min=-2 * NEGLIGIBLE).exp_()
        found.add(index, gamma, blocks, whitened)
        found.total += density.sum(dtype=found.total.dtype)
    return found.expectation(limits.new_tensor(lowest))


def labelled_step(points: Points, labeller: Labeller, n_components: int) -> Expectation:
    """Pass over the points, each of which belongs to one component.

    Parameters
    ----------
    points : Points
        What the mixture is learned from.
    labeller : callable
        Gives the components of points.
    n_components : int
        Number of components K.
    """
    like = points.shift
    zeros = [like.new_zeros(n_components, width) for width in points.widths]
    ones = [torch.diag_embed(torch.ones_like(mean)) for mean in zeros]
    shares = like.new_full((n_components,), 1 / n_components)
    unit = Parameters(shares, tuple(zeros), tuple(ones))
    found = _Pass(unit, points)
    for chunk, numbers in points:
        labels = labeller(chunk[points.values].T, numbers)
        index, places = labels.unique(return_inverse=True)
        blocks = points.blocks(chunk)
        joint, whitened = found.log_joint(blocks, index)
        gamma = torch.nn.functional.one_hot(places, len(index)).T.to(joint)
        found.add(index, gamma, blocks, whitened)
    return found.expectation(points.spans.new_zeros(len(points.spans)))


class _Pass:
    """One pass over the points of this process: what whitens them, and sums over them."""

    def __init__(self, parameters: Parameters, points: Points) -> None:
        self.parameters, self.points = parameters, points
        maps, self.peaks = whiten(parameters)
        self.maps = [block_map.to(points.dtype) for block_map in maps]
        self._heights = self.peaks.to(points.dtype)
        self.mass, self.total = torch.zeros_like(self.peaks), torch.zeros_like(self.peaks[0])
        self.moments = [one.new_zeros(one.shape[2], *one.shape[:2]) for one in maps]

    def log_joint(
        self, blocks: Sequence[Tensor], index: Tensor | slice, group_size: int = 1
    ) -> tuple[Tensor, list[Tensor]]:
        """Compute :func:`log_joint` of some components."""
        near = [block_map[index] for block_map in self.maps], self._heights[index]
        return log_joint(blocks, *near, group_size)

    def add(
        self, index: Tensor, gamma: Tensor, blocks: Sequence[Tensor], whitened: Sequence[Tensor]
    ) -> None:
        """Add a chunk, given the responsibilities (K', n) of some components."""
        self.mass.index_add_(0, index, gamma.sum(1, dtype=self.mass.dtype))
        for x, y, moments in zip(blocks, whitened, self.moments, strict=True):
            y.mul_(gamma[:, None])
            part = (x @ y.flatten(0, 1).T).view(len(x), len(index), -1)
            moments.index_add_(1, index, part.double())

    def expectation(self, least: Tensor) -> Expectation:
        """Add up the sums of all processes."""
        points, rounded = self.points, [block_map.double() for block_map in self.maps]
        mass, total, *sums = points.processes.sum(self.mass, self.total, *self.moments)
        bound = float(total) / points.total
        return Expectation(self.parameters, rounded, mass, sums, bound, least)


def _ceilings(parameters: Parameters, peaks: Tensor, spans: Tensor) -> Tensor:
    """Bound the log-densities of the components in each chunk, (n_chunks, K)."""
    mean = torch.stack([mean[:, 0] for mean in parameters.means], 1)
    variance = torch.stack([covariance[:, 0, 0] for covariance in parameters.covariances], 1)
    low, high = spans[:, :, None].unbind(1)
    gap = torch.maximum(low - mean, mean - high).clamp(min=0)
    return peaks - (gap.square() / variance).sum(-1) / 2


def m_step(expectation: Expectation, family: CovarianceFamily, *, floor: bool) -> Parameters:
    """Compute the mixture that the responsibilities ask for.

    Parameters
    ----------
    expectation : Expectation
        Sums of a pass over the points.
    family : CovarianceFamily
        Of covariances, with their regularisation.
    floor : bool
        False adds ``Lambda`` to every covariance, as scikit-learn does: close to the most
        likely mixture, but not exactly it, so that the likelihood can fall by a little.
        True takes the most likely covariances among those not below ``Lambda``: this
        cannot lower the likelihood of a mixture that is not below ``Lambda`` itself.
    """
    mass = expectation.mass
    weights = mass / mass.sum()
    # a component without data keeps its place and its shape
    alive = (mass > torch.finfo(mass.dtype).tiny)[:, None]
    divisor = torch.where(alive, mass[:, None], 1.0)
    means, covariances = [], []
    for block, (maps, sums) in enumerate(zip(expectation.maps, expectation.sums, strict=True)):
        width = maps.shape[1]
        whitening, offset = maps[..., :width], maps[..., width]
        # mean and scatter in whitened coordinates, where the old ones are 0 and the identity
        shift = sums[width] / divisor
        scatter = sums.permute(1, 2, 0) @ maps.mT / divisor[..., None]
        scatter = scatter - shift[..., None] * shift[:, None]
        scatter = torch.where(alive[..., None], scatter, torch.eye(width).to(scatter))
        back = torch.linalg.inv(whitening)
        covariance = back @ scatter @ back.mT
        covariance = family.restrict((covariance + covariance.mT) / 2, weights)
        means.append((back @ (shift - offset)[..., None])[..., 0])
        covariances.append(family.regularize(covariance, block, floor=floor))
    return Parameters(weights, tuple(means), tuple(covariances))


def dead_components(
    expectation: Expectation, family: CovarianceFamily, points: Points
) -> Tensor:
    """Find components that have lost their data, shape (K,).

    Either nothing is left of its mass, or at most two points are, without any spread
    beyond the regularisation, though there is data enough to give each component more.

    Parameters
    ----------
    expectation : Expectation
        Of the present mixture.
    family : CovarianceFamily
        With the regularisation.
    points : Points
        What the mixture is learned from.
    """
    mass = expectation.mass
    vanished = mass < 10 * torch.finfo(points.dtype).eps * points.total
    few = (mass <= 2) & (points.total > 2 * len(mass))
    variances = [c.diagonal(dim1=1, dim2=2) for c in expectation.parameters.covariances]
    floor = sum(float(diagonal.sum()) for diagonal in family.diagonals)
    return vanished | (few & (torch.cat(variances, 1).sum(1) <= 2 * floor))


def restart_components(
    proposal: Parameters,
    dead: Tensor,
    explaining: Parameters,
    points: Points,
    rng: np.random.RandomState,
) -> Parameters:
    """Move dead components to badly explained points, with the others' mean covariance.

    The points are drawn among the twentieth of the data with the lowest density: the very
    worst are often outliers, on which the component would die again.

    Parameters
    ----------
    proposal : Parameters
        What the M step gave.
    dead : Tensor of bool, of shape (K,)
        Components to be moved.
    explaining : Parameters
        The mixture of the E step, whose densities count.
    points : Points
        What the mixture is learned from.
    rng : RandomState
        In the same state in all processes.
    """
    n_dead = int(dead.sum())
    worst = _worst(explaining, points, max(n_dead, min(points.total // 20, FILE_ROWS)))
    places = worst[rng.choice(len(worst), n_dead, replace=False)].split(points.widths, 1)
    weights = torch.where(dead, 1 / len(dead), proposal.weights)
    share = torch.where(dead, 0.0, proposal.weights)
    means, covariances = [], []
    for mean, covariance, place in zip(
        proposal.means, proposal.covariances, places, strict=True
    ):
        means.append(mean.index_put((dead,), place))
        pooled = torch.einsum("k,kij->ij", share / share.sum(), covariance)
        covariances.append(torch.where(dead[:, None, None], pooled, covariance))
    return Parameters(weights / weights.sum(), tuple(means), tuple(covariances))


def _worst(parameters: Parameters, points: Points, count: int) -> Tensor:
    """Find the points of lowest density (count, sum D_j), worst first."""
    whole = _Pass(parameters, points)
    worst = whole.maps[0].new_zeros(0, 1 + len(points.values))
    for chunk, _ in points:
        joint, _ = whole.log_joint(points.blocks(chunk), slice(None), points.group_size)
        rows = torch.cat((joint.logsumexp(0)[None], chunk[points.values])).T
        worst = torch.cat((worst, rows))
        worst = worst[worst[:, 0].argsort(stable=True)[:count]]
    worst = torch.cat(points.processes.gather(worst.double().cpu())).to(points.shift)
    return worst[worst[:, 0].argsort(stable=True)[:count], 1:]


@dataclass
class Fit:
    """Result of expectation-maximisation.

    Attributes
    ----------
    parameters : Parameters
        The mixture after the last M step.
    bounds : list of float
        Mean log-likelihood of the mixture before each M step, never falling: where reseeding
        a component lowers it, the list begins again.
    n_iter : int
        Number of M steps.
    converged : bool
        Whether the bound rose by less than the tolerance.
    reseedings : list of str
        Which components were reseeded when, as text.
    """

    parameters: Parameters
    bounds: list[float] = field(default_factory=list)
    n_iter: int = 0
    converged: bool = False
    reseedings: list[str] = field(default_factory=list)


def expectation_maximization(
    start: Parameters,
    points: Points,
    family: CovarianceFamily,
    rng: np.random.RandomState,
    *,
    tol: float,
    max_iter: int,
) -> Fit:
    """Iterate until the bound rises by less than ``tol``.

    The likelihood never falls: M steps add the regularisation until one of them lowers the
    likelihood beyond rounding; it is undone, and from then on the regularisation is a floor
    (see :func:`m_step`). Only reseeding a component, which happens at most K times, can lower
    it; the bounds are then counted from there.

    Parameters
    ----------
    start : Parameters
        A mixture of the family.
    points : Points
        What the mixture is learned from.
    family : CovarianceFamily
        Of covariances, with their regularisation.
    rng : RandomState
        Chooses where dead components start again; in the same state in all processes.
    tol : float
        Rise of the bound at which EM ends [nats].
    max_iter : int
        Most M steps, at least 1.
    """
    fit, floor, left = Fit(start), False, len(start.weights)
    current = e_step(start, points)
    while not fit.converged and fit.n_iter < max_iter:
        lowest = current.bound - ROUNDING[points.dtype] * max(1.0, abs(current.bound))
        fit.n_iter += 1
        proposal = m_step(current, family, floor=floor)
        dead = dead_components(current, family, points)
        n_dead = int(dead.sum())
        if 0 < n_dead <= min(left, len(dead) - 1):
            left -= n_dead
            components = dead.nonzero()[:, 0].tolist()
            fit.reseedings.append(f"component(s) {components} in iteration {fit.n_iter}")
            proposal = restart_components(proposal, dead, current.parameters, points, rng)
            following = e_step(proposal, points, current.least)
            fit.bounds = [] if following.bound < lowest else [*fit.bounds, current.bound]
        else:
            following = e_step(proposal, points, current.least)
            if following.bound < lowest and not floor:
                floor = True
                proposal = m_step(current, family, floor=True)
                following = e_step(proposal, points, current.least)
            following = current if following.bound < lowest else following
            fit.converged = bool(fit.bounds) and abs(current.bound - fit.bounds[-1]) < tol
            fit.bounds.append(current.bound)
        current, fit.parameters = following, following.parameters
    fit.bounds = fit.bounds or [current.bound]
    return fit

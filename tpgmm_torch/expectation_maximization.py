"""Expectation-maximisation for Gaussian mixtures with block-diagonal covariance.

The components share their responsibilities across the blocks (section II-B of the paper):

    gamma_k(x) ∝ pi_k prod_j N(x_j | mu_kj, Sigma_kj)

One pass over the points gathers the moments that the M step needs.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.block_gaussians import Chunk, Family, Parameters
from tpgmm_torch.exceptions import ConvergenceWarning, DegenerateComponentWarning
from tpgmm_torch.sufficient_statistics import statistics

__all__ = ["Expectation", "Run", "ascend", "expect", "maximize"]


@dataclass(frozen=True)
class Expectation:
    """What one pass over the points leaves: all that the M step needs.

    Attributes
    ----------
    parameters : Parameters
        The mixture that gave the responsibilities.
    moments : tuple of Tensor of shape (K, D_j + 1, D_j + 1)
        Per block ``sum_n gamma (y; 1) (y; 1)^T`` in whitened coordinates, float64.
    log_likelihoods : Tensor of shape (n_samples,)
        Log-density of each point.
    bound : float
        Their mean.
    rounding : float
        By how much, relative to 1 and to the bound, the bound may be off.
    """

    parameters: Parameters
    moments: tuple[Tensor, ...]
    log_likelihoods: Tensor
    bound: float
    rounding: float

    @property
    def mass(self) -> Tensor:
        """Number of points that each component answers for, shape (K,)."""
        return self.moments[0][:, -1, -1]


def expect(
    parameters: Parameters,
    chunks: Sequence[Chunk],
    labels: Tensor | None = None,
    group_size: int = 1,
) -> Expectation:
    """E step: one pass over the points.

    Parameters
    ----------
    parameters : Parameters
        The mixture; where labels are given it only chooses the coordinates.
    chunks : sequence of tuple of Tensor of shape (D_j + 1, n)
    labels : Tensor of shape (n_samples,), optional
        Give each point wholly to one component, instead of by its responsibilities.
    group_size : int, default=1
        So many consecutive points have one responsibility together: that of the geometric
        mean of their densities. The chunks end where groups end.
    """
    gathered = statistics(parameters, chunks)
    totals, start = [], 0
    for chunk in chunks:
        joint = gathered.joint(chunk)
        if group_size > 1:
            grouped = joint.unflatten(1, (-1, group_size))
            grouped.copy_(grouped.mean(-1, keepdim=True))
        total = torch.logsumexp(joint, dim=0)
        if labels is None:
            responsibilities = joint.sub_(total).exp_()
        else:
            chosen = labels[start : start + len(total)]
            components = torch.arange(len(joint), device=chosen.device)
            responsibilities = (components[:, None] == chosen).to(joint)
        gathered.gather(responsibilities)
        totals.append(total)
        start += len(total)
    log_likelihoods = torch.cat(totals)
    bound = float(log_likelihoods.double().mean())
    return Expectation(
        parameters, gathered.moments(), log_likelihoods, bound, gathered.rounding
    )


def maximize(expectation: Expectation, family: Family, *, floored: bool) -> Parameters:
    """M step.

    Parameters
    ----------
    expectation : Expectation
    family : Family
    floored : bool
        False adds ``Lambda`` to every covariance, as scikit-learn does: close to the most
        likely mixture, but not exactly it, so that the likelihood can fall by a little.
        True takes the most likely covariances among those not below ``Lambda``: this
        cannot lower the likelihood of a mixture that is not below ``Lambda`` itself.
    """
    old, mass = expectation.parameters, expectation.mass
    weights = mass / mass.sum()
    # a component without data keeps its place and its shape
    alive = (mass > torch.finfo(mass.dtype).tiny)[:, None]
    divisor = torch.where(alive, mass[:, None], 1.0)
    means, covariances = [], []
    for mean, factor, moment, diagonal in zip(
        old.means, old.factors, expectation.moments, family.diagonals, strict=True
    ):
        shift = moment[:, :-1, -1] / divisor
        scatter = moment[:, :-1, :-1] / divisor[..., None] - shift[..., None] * shift[:, None]
        eye = torch.eye(scatter.shape[-1]).to(scatter)
        scatter = torch.where(alive[..., None], scatter, eye)
        covariance = factor @ scatter @ factor.mT
        covariance = family.restrict((covariance + covariance.mT) / 2, weights)
        if floored:
            covariance = family.floor(covariance, diagonal)
        else:
            covariance = covariance + torch.diag(diagonal)
        means.append(mean + (factor @ shift[..., None])[..., 0])
        covariances.append(covariance)
    return Parameters.from_covariances(weights, means, covariances)


@dataclass
class Run:
    """One ascent from one start.

    Attributes
    ----------
    expectation : Expectation
        Of the mixture that was reached.
    bounds : list of float
        Mean log-likelihood of the mixture before each M step, never falling: where a
        component placed anew lowers it, the list begins again.
    n_iter : int
    converged : bool
    replaced : list of str
        What was placed anew, in words.
    """

    expectation: Expectation
    bounds: list[float] = field(default_factory=list)
    n_iter: int = 0
    converged: bool = False
    replaced: list[str] = field(default_factory=list)

    @property
    def bound(self) -> float:
        """The last of the bounds."""
        return self.bounds[-1]

    def complaints(self) -> Iterator[tuple[type[Warning], str]]:
        """What the user should know, as categories and messages of warnings."""
        if self.replaced:
            yield (
                DegenerateComponentWarning,
                f"placed anew for having lost their data: {'; '.join(self.replaced)}; "
                "use fewer components, a larger reg_covar or another start",
            )
        if not self.converged:
            yield (
                ConvergenceWarning,
                f"EM did not converge in {self.n_iter} iterations: raise max_iter or tol, or "
                "use another start",
            )


def degenerate(expectation: Expectation, family: Family) -> Tensor:
    """Which components have lost their data, shape (K,).

    Either nothing is left of its mass, or at most two points are, without any spread
    beyond the regularisation, though there is data enough to give each component more.
    """
    count, mass = len(expectation.log_likelihoods), expectation.mass
    vanished = mass < 10 * torch.finfo(expectation.log_likelihoods.dtype).eps * count
    spread = sum(
        c.diagonal(dim1=-2, dim2=-1).sum(-1) for c in expectation.parameters.covariances
    )
    lambda_trace = sum(float(diagonal.sum()) for diagonal in family.diagonals)
    collapsed = (mass <= 2) & (spread <= 2 * lambda_trace) & (count > 2 * len(mass))
    return vanished | collapsed


def place_anew(
    parameters: Parameters,
    dead: Tensor,
    expectation: Expectation,
    chunks: Sequence[Chunk],
    rng: np.random.RandomState,
) -> Parameters:
    """Move dead components to badly explained points, with the others' mean covariance.

    The points are drawn among the twentieth of the data with the lowest density: the very
    worst are often outliers, on which the component would die again.
    """
    log_likelihoods = expectation.log_likelihoods
    needed = int(dead.sum())
    n_worst = max(needed, len(log_likelihoods) // 20)
    worst = torch.topk(log_likelihoods, n_worst, largest=False).indices.cpu().numpy()
    size = chunks[0][0].shape[-1]
    places = [divmod(int(point), size) for point in rng.choice(worst, needed, replace=False)]
    weights = torch.where(dead, 1 / len(dead), parameters.weights)
    share = torch.where(dead, 0.0, parameters.weights)
    share = share / share.sum()
    means, covariances = [], []
    for block, (mean, covariance) in enumerate(
        zip(parameters.means, parameters.covariances, strict=True)
    ):
        points = [chunks[chunk][block][:-1, column] for chunk, column in places]
        means.append(mean.masked_scatter(dead[:, None], torch.stack(points).to(mean)))
        pooled = torch.einsum("k,kij->ij", share, covariance)
        covariances.append(torch.where(dead[:, None, None], pooled, covariance))
    return Parameters.from_covariances(weights / weights.sum(), means, covariances)


def ascend(
    start: Parameters,
    chunks: Sequence[Chunk],
    family: Family,
    *,
    tol: float,
    max_iter: int,
    rng: np.random.RandomState,
    group_size: int = 1,
    verbose: int = 0,
) -> Run:
    """Iterate from a start that the family admits until the bound rises by less than ``tol``.

    The likelihood never falls: M steps add the regularisation until one of them lowers the
    likelihood beyond rounding; it is undone, and from then on the regularisation is a floor
    (see :func:`maximize`). Only a component placed anew, which happens at most K times,
    can lower it; the bounds are then counted from there.

    Parameters
    ----------
    start : Parameters
    chunks : sequence of tuple of Tensor of shape (D_j + 1, n)
    family : Family
    tol : float
    max_iter : int
        Most M steps, at least 1.
    rng : RandomState
        Chooses the places of components placed anew.
    group_size : int, default=1
        See :func:`expect`.
    verbose : int, default=0
        1 prints a line at the end, 2 also one per iteration.
    """

    def expectation(parameters: Parameters) -> Expectation:
        return expect(parameters, chunks, group_size=group_size)

    run = Run(expectation(start))
    floored, allowed = False, len(start.weights)
    for run.n_iter in range(1, max_iter + 1):
        current = run.expectation
        change = current.bound - run.bounds[-1] if run.bounds else math.inf
        run.bounds.append(current.bound)
        if verbose > 1:
            print(f"  iteration {run.n_iter}: bound {current.bound:.6g} ({change:+.3g})")
        least = current.bound - current.rounding * max(1.0, abs(current.bound))
        proposal = maximize(current, family, floored=floored)
        dead = degenerate(current, family)
        if 0 < int(dead.sum()) <= min(allowed, len(dead) - 1):
            allowed -= int(dead.sum())
            run.replaced.append(_obituary(dead, current, run.n_iter))
            proposal = place_anew(proposal, dead, current, chunks, rng)
            run.expectation = expectation(proposal)
            if run.expectation.bound < least:
                run.bounds.clear()
            continue
        run.expectation = expectation(proposal)
        if run.expectation.bound < least and not floored:
            floored = True
            run.expectation = expectation(maximize(current, family, floored=True))
        if run.expectation.bound < least:
            run.expectation = current
        if abs(change) < tol:
            run.converged = True
            break
    if not run.bounds:  # a component was placed anew in the last iteration
        run.bounds.append(run.expectation.bound)
    if verbose:
        end = "converged" if run.converged else "not converged"
        print(f"start: {end} in {run.n_iter} iterations, bound {run.bound:.6g}")
    return run


def _obituary(dead: Tensor, expectation: Expectation, n_iter: int) -> str:
    components = dead.nonzero()[:, 0].tolist()
    masses = ", ".join(f"{float(expectation.mass[k]):.3g}" for k in components)
    total = len(expectation.log_likelihoods)
    return f"component(s) {components} in iteration {n_iter} (left: {masses} of {total} points)"

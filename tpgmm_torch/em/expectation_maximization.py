"""Expectation-maximisation for Gaussian mixtures with block-diagonal covariance.

Several mixtures, from several starts or of several folds, share their passes over the points:
they are stacked along a leading dimension S.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.em.component_gating import Gate
from tpgmm_torch.em.covariance_family import CovarianceFamily
from tpgmm_torch.em.e_step import Expectation, e_step
from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.em.points import Points
from tpgmm_torch.em.reseeding import dead_components, reseed

__all__ = ["Fit", "expectation_maximization", "m_step"]


@dataclass
class Fit:
    """One mixture on its way: between iterations, all that is needed to go on from there.

    Attributes
    ----------
    parameters : Parameters
        A mixture that the family admits.
    rng : RandomState
        Chooses where dead components start again.
    bounds : list of float
        Mean log-likelihood of the mixture before each M step, never falling: where reseeding
        a component lowers it, the list begins again.
    n_iter : int
    converged : bool
    reseedings : list of str
        Which components were reseeded when, as text.
    n_reseeded : int
        How many components that were.
    floored : bool
        Whether the regularisation is a floor; see :func:`m_step`.
    """

    parameters: Parameters
    rng: np.random.RandomState
    bounds: list[float] = field(default_factory=list)
    n_iter: int = 0
    converged: bool = False
    reseedings: list[str] = field(default_factory=list)
    n_reseeded: int = 0
    floored: bool = False


def m_step(expectation: Expectation, family: CovarianceFamily, floored: Tensor) -> Parameters:
    """The mixtures that the responsibilities ask for.

    Parameters
    ----------
    expectation : Expectation
        Of S mixtures.
    family : CovarianceFamily
        One for all, or one for each.
    floored : Tensor of bool, of shape (S,)
        False adds ``Lambda`` to every covariance, as scikit-learn does: close to the most
        likely mixture, but not exactly it, so that the likelihood can fall by a little.
        True takes the most likely covariances among those not below ``Lambda``: this
        cannot lower the likelihood of a mixture that is not below ``Lambda`` itself.
    """
    old, mass = expectation.parameters, expectation.mass
    weights = mass / mass.sum(-1, keepdim=True)
    # a component without data keeps its place and its shape
    alive = (mass > torch.finfo(mass.dtype).tiny)[..., None]
    divisor = torch.where(alive, mass[..., None], 1.0)
    means, covariances = [], []
    for block, (mean, factor, moment) in enumerate(
        zip(old.means, old.factors, expectation.moments, strict=True)
    ):
        # mean and scatter in whitened coordinates, where the old ones are 0 and the identity
        shift = moment[..., :-1, -1] / divisor
        scatter = moment[..., :-1, :-1] / divisor[..., None]
        scatter = scatter - shift[..., None] * shift[..., None, :]
        eye = torch.eye(scatter.shape[-1]).to(scatter)
        scatter = torch.where(alive[..., None], scatter, eye)
        covariance = factor @ scatter @ factor.mT
        covariance = family.restrict((covariance + covariance.mT) / 2, weights)
        regularized = family.add(covariance, block)
        if bool(floored.any()):
            raised = family.floor(covariance, block)
            regularized = torch.where(floored.view(-1, 1, 1, 1), raised, regularized)
        means.append(mean + (factor @ shift[..., None])[..., 0])
        covariances.append(regularized)
    return Parameters.from_covariances(weights, means, covariances)


def expectation_maximization(
    fits: Sequence[Fit],
    points: Points,
    family: CovarianceFamily | Sequence[CovarianceFamily],
    *,
    tol: float,
    max_iter: int,
    group_size: int = 1,
    members: Tensor | None = None,
    verbose: int = 0,
    after: Callable[[Sequence[Fit]], None] | None = None,
) -> None:
    """Iterate each fit until its bound rises by less than ``tol``.

    The likelihood never falls: M steps add the regularisation until one of them lowers the
    likelihood beyond rounding; it is undone, and from then on the regularisation is a floor
    (see :func:`m_step`). Only reseeding a component, which happens at most K times, can lower
    it; the bounds are then counted from there.

    All fits that are not finished share each pass over the points. They do not influence each
    other: the results are those of one after the other, to rounding.

    Parameters
    ----------
    fits : sequence of Fit
        Starts, or fits that were interrupted, with equal numbers of components; they are
        changed.
    family : CovarianceFamily, or sequence of CovarianceFamily
        Of all fits, or one for each.
    max_iter : int
        Most M steps of a fit, at least 1.
    group_size : int, default=1
        See :func:`tpgmm_torch.em.e_step.e_step`.
    members : Tensor of bool, of shape (len(fits), n_points), optional
        The points that each fit is learned from; all by default.
    verbose : int, default=0
        1 prints a line at the end of a fit, 2 also one per iteration.
    after : callable, optional
        Called with all fits after each iteration.
    """
    families = [family] * len(fits) if isinstance(family, CovarianceFamily) else family
    going = [s for s, fit in enumerate(fits) if not fit.converged and fit.n_iter < max_iter]
    if not going:
        return
    family = CovarianceFamily.stack([families[s] for s in going])
    members = None if members is None else members[going]
    shared: dict[str, Any] = {"points": points, "group_size": group_size, "gate": Gate()}
    start = Parameters.stack([fits[s].parameters for s in going])
    current = e_step(start, members=members, **shared)
    while going:
        active = [fits[s] for s in going]
        floored = torch.tensor([fit.floored for fit in active], device=points.device)
        bound = current.bound
        lowest = bound - current.rounding * bound.abs().clamp(min=1.0)
        proposal = m_step(current, family, floored)
        proposal, reseeded = _reseed_dead(
            proposal, current, family, active, points, group_size, members
        )
        following = e_step(proposal, members=members, previous=current, **shared)
        # an M step that lowered the likelihood is made again, with the regularisation as floor
        again = ((following.bound < lowest) & ~floored & ~reseeded).nonzero()[:, 0]
        if len(again):
            floored[again] = True
            own = None if members is None else members[again]
            proposal = m_step(current[again], family[again], floored[again])
            better = e_step(proposal, members=own, previous=current[again], **shared)
            following = following.replaced(again, better)
        # and undone, should it lower it even so
        lowered = following.bound < lowest
        keep = lowered & ~reseeded
        if bool(keep.any()):
            following = following.replaced(keep, current[keep])
        for s, fit in enumerate(active):
            change = float(bound[s]) - fit.bounds[-1] if fit.bounds else math.inf
            fit.n_iter += 1
            fit.bounds.append(float(bound[s]))
            fit.floored = bool(floored[s])
            if not reseeded[s]:
                fit.converged = abs(change) < tol
            elif lowered[s]:
                fit.bounds = []
            fit.parameters = following.parameters[s]
            if verbose > 1:
                print(f"  iteration {fit.n_iter}: bound {float(bound[s]):.6g} ({change:+.3g})")
            done = fit.converged or fit.n_iter == max_iter
            if done and not fit.bounds:  # a component was reseeded in the last iteration
                fit.bounds.append(float(following.bound[s]))
            if done and verbose:
                end = "converged" if fit.converged else "not converged"
                print(f"start: {end} in {fit.n_iter} iterations, bound {fit.bounds[-1]:.6g}")
        if after is not None:
            after(fits)
        left = [
            s for s, fit in enumerate(active) if not fit.converged and fit.n_iter < max_iter
        ]
        current = following
        if len(left) < len(going):
            going = [going[s] for s in left]
            current, family = following[left], family[left]
            members = None if members is None else members[left]


def _reseed_dead(
    proposal: Parameters,
    current: Expectation,
    family: CovarianceFamily,
    fits: Sequence[Fit],
    points: Points,
    group_size: int,
    members: Tensor | None,
) -> tuple[Parameters, Tensor]:
    """The proposal with dead components reseeded, and of which mixtures (S,) some were."""
    dead = dead_components(current, family, points.dtype)
    n_components = dead.shape[1]
    reseeded = torch.zeros_like(dead[:, 0])
    mixtures = []
    for s, count in enumerate(dead.sum(1).tolist()):
        mixture, fit = proposal[s], fits[s]
        if 0 < count <= min(n_components - fit.n_reseeded, n_components - 1):
            own = None if members is None else members[s]
            mixture = reseed(
                mixture, dead[s], current.parameters[s], points, fit.rng, group_size, own
            )
            reseeded[s] = True
            fit.n_reseeded += count
            components = dead[s].nonzero()[:, 0].tolist()
            # to the digits that do not depend on what the gate left out
            masses = ", ".join(f"{round(float(current.mass[s, k]), 9):.3g}" for k in components)
            fit.reseedings.append(
                f"component(s) {components} in iteration {fit.n_iter + 1} "
                f"(left: {masses} of {int(current.n_points[s])} points)"
            )
        mixtures.append(mixture)
    return (Parameters.stack(mixtures) if bool(reseeded.any()) else proposal), reseeded

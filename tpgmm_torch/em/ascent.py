"""Expectation-maximisation for Gaussian mixtures with block-diagonal covariance.

Several ascents, from several starts or of several folds, share their passes over the points.
"""

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import torch

from tpgmm_torch.em.block_gaussians import Family, Parameters
from tpgmm_torch.em.e_step import Expectation, Workspace, expect
from tpgmm_torch.em.points import Points, Subset
from tpgmm_torch.em.reseeding import degenerate, obituary, place_anew
from tpgmm_torch.exceptions import ConvergenceWarning, DegenerateComponentWarning

__all__ = ["Run", "ascend", "maximize"]


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
    """One ascent: where it starts, and after :func:`ascend` how far it came.

    Between iterations it holds all that is needed to go on from there.

    Attributes
    ----------
    parameters : Parameters
        A mixture that the family admits.
    rng : RandomState
        Chooses the places of components placed anew.
    bounds : list of float
        Mean log-likelihood of the mixture before each M step, never falling: where a
        component placed anew lowers it, the list begins again.
    n_iter : int
    converged : bool
    replaced : list of str
        What was placed anew, in words.
    n_replaced : int
        How many components that were.
    floored : bool
        Whether the regularisation is a floor; see :func:`maximize`.
    """

    parameters: Parameters
    rng: np.random.RandomState
    bounds: list[float] = field(default_factory=list)
    n_iter: int = 0
    converged: bool = False
    replaced: list[str] = field(default_factory=list)
    n_replaced: int = 0
    floored: bool = False

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


#: Asks for the expectations of mixtures, one after the other.
Ascent = Generator[Parameters, Expectation, None]


def ascend(
    runs: Sequence[Run],
    points: Points,
    family: Family | Sequence[Family],
    *,
    tol: float,
    max_iter: int,
    group_size: int = 1,
    verbose: int = 0,
    after: Callable[[Sequence[Run]], None] | None = None,
    subsets: Sequence[Subset] = (),
) -> None:
    """Iterate each run until its bound rises by less than ``tol``.

    The likelihood never falls: M steps add the regularisation until one of them lowers the
    likelihood beyond rounding; it is undone, and from then on the regularisation is a floor
    (see :func:`maximize`). Only a component placed anew, which happens at most K times,
    can lower it; the bounds are then counted from there.

    Every pass over the points serves all runs that are not finished. They do not influence
    each other: the results are those of one run after the other, to rounding.

    Parameters
    ----------
    runs : sequence of Run
        Starts, or runs that were interrupted; they are changed.
    points : Points
    family : Family, or sequence of Family
        Of all runs, or one per run.
    tol : float
    max_iter : int
        Most M steps of a run, at least 1.
    group_size : int, default=1
        See :func:`tpgmm_torch.em.e_step.expect`.
    verbose : int, default=0
        1 prints a line at the end of a run, 2 also one per iteration.
    after : callable, optional
        Called with all runs after each pass over the points in which one of them completed
        an iteration.
    subsets : sequence of Subset, optional
        One per run: the points that it learns from, where these are not all.
    """
    workspace = Workspace(points)
    families = [family] * len(runs) if isinstance(family, Family) else family
    sources: list[tuple[Points, int]] = [(points, group_size)] * len(runs)
    if subsets:
        sources = [(subset, subset.group_size) for subset in subsets]
    ascents: list[tuple[int, Ascent, Parameters, list[Expectation]]] = []
    for number, run in enumerate(runs):
        if run.converged or run.n_iter >= max_iter:
            continue
        source, size = sources[number]
        ascent = _ascent(run, source, families[number], tol, max_iter, size, verbose)
        ascents.append((number, ascent, next(ascent), []))
    while ascents:
        wanted = [parameters for *_, parameters, _ in ascents]
        previous = [expectation for *_, last in ascents for expectation in last]
        completed = sum(run.n_iter for run in runs)
        expectations = expect(
            wanted, points, group_size=group_size, workspace=workspace, previous=previous,
            subsets=[subsets[number] for number, *_ in ascents] if subsets else (),
        )  # fmt: skip
        going = []
        for (number, ascent, *_), expectation in zip(ascents, expectations, strict=True):
            with suppress(StopIteration):
                going.append((number, ascent, ascent.send(expectation), [expectation]))
        ascents = going
        if after is not None and sum(run.n_iter for run in runs) > completed:
            after(runs)


def _ascent(
    run: Run,
    points: Points,
    family: Family,
    tol: float,
    max_iter: int,
    group_size: int,
    verbose: int,
) -> Ascent:
    """The iterations of one run; see :func:`ascend`."""
    current = yield run.parameters
    while not run.converged and run.n_iter < max_iter:
        change = current.bound - run.bounds[-1] if run.bounds else math.inf
        bounds, n_iter = [*run.bounds, current.bound], run.n_iter + 1
        if verbose > 1:
            print(f"  iteration {n_iter}: bound {current.bound:.6g} ({change:+.3g})")
        least = current.bound - current.rounding * max(1.0, abs(current.bound))
        proposal = maximize(current, family, floored=run.floored)
        dead = degenerate(current, family, points)
        n_dead = int(dead.sum())
        if 0 < n_dead <= min(len(dead) - run.n_replaced, len(dead) - 1):
            report = obituary(dead, current, points, n_iter)
            proposal = place_anew(proposal, dead, current, points, run.rng, group_size)
            current = yield proposal
            run.n_replaced += n_dead
            run.replaced.append(report)
            if current.bound < least:
                bounds = []
        else:
            following = yield proposal
            if following.bound < least and not run.floored:
                run.floored = True
                following = yield maximize(current, family, floored=True)
            if following.bound >= least:
                current = following
            run.converged = abs(change) < tol
        run.parameters, run.bounds, run.n_iter = current.parameters, bounds, n_iter
    if not run.bounds:  # a component was placed anew in the last iteration
        run.bounds.append(current.bound)
    if verbose:
        end = "converged" if run.converged else "not converged"
        print(f"start: {end} in {run.n_iter} iterations, bound {run.bound:.6g}")

"""Components that a chunk of points can do without, by a bound that is verified.

A chunk of points that are sorted by time lies in a small box, and most components are far
away from it. Inside the box ``[a, b]`` the log-density of component k is at most

    ub_k = log pi_k + sum_j (log N(mu_kj | mu_kj, Sigma_kj) - max_d gap_kjd^2 / 2 sigma_kjd^2)

where ``gap_kjd`` is the distance of the mean from ``[a_d, b_d]`` in column d of block j, and
``sigma_kjd`` the component's standard deviation there: no Mahalanobis distance is less than
that of a marginal. A component is left out where ``ub_k <= lo - 36`` and ``lo`` is the least
log-density among the points of the chunk: each responsibility that is not counted is below
exp(-36) = 2e-16. Which ones those are is guessed, mostly from ``lo`` in the last pass, and the
chunk is done again in the rare case that the present ``lo`` does not confirm it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import ge

import torch
from torch import Tensor

from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.em.points import Chunk

__all__ = ["Gate", "Selection"]

#: A component is left out where its responsibilities are below exp of minus this.
NEGLIGIBLE = 36.0

#: By how much the least log-density of a chunk may fall between two passes before the chunk
#: has to be done again.
SLACK = 4.0

#: By how much the least log-density of a chunk is thought to lie below the highest bound of a
#: component, before any pass.
DEPTH = 80.0

#: So many numbers are bounded at a time.
SLAB = 2**17


@dataclass(frozen=True)
class Selection:
    """Components of S mixtures that one chunk needs, the same number A for each mixture.

    Attributes
    ----------
    ceilings : Tensor of shape (S, K)
        What no log-density of the components exceeds in the chunk.
    least : list of float
        S numbers: the selection holds where no point's log-density is below these.
    components : Tensor of shape (S * A,) or None
        Numbers of the components among all S * K; None is all of them.
    """

    ceilings: Tensor
    least: list[float]
    components: Tensor | None

    @classmethod
    def above(cls, ceilings: Tensor, least: list[float]) -> "Selection":
        """The components that are not negligible where ``least`` is the least log-density."""
        n_components = ceilings.shape[1]
        limits = ceilings.new_tensor(least)[:, None] - NEGLIGIBLE
        count = int((ceilings > limits).sum(1).max())
        if count == n_components:
            return cls(ceilings, least, None)
        chosen = _numbered(ceilings.topk(count, dim=1).indices, n_components)
        return cls(ceilings, least, chosen.reshape(-1))

    def holds(self, least: Sequence[float]) -> bool:
        """Whether the least log-densities (S) of the selected components confirm it."""
        return self.components is None or all(map(ge, least, self.least))


class Gate:
    """The boxes of all chunks, and the components that each needs.

    It is filled during the first pass, and needs the same chunks in every later one.
    """

    def __init__(self) -> None:
        self._boxes = torch.empty(0)
        self._count = 0

    def record(self, index: int, chunk: Chunk) -> None:
        """Measure the box of a chunk, unless that has been done."""
        if index < self._count:
            return
        extremes = [torch.aminmax(block[:-1], dim=1) for block in chunk]
        box = torch.stack([torch.cat(sides) for sides in zip(*extremes, strict=True)]).double()
        if self._count == len(self._boxes):
            # in one piece: small ones that stay would keep the memory around them from use
            self._boxes = torch.cat(
                [self._boxes.to(box), box.new_empty(self._count + 64, *box.shape)]
            )
        self._boxes[self._count] = box
        self._count += 1

    def selections(
        self, parameters: Parameters, peaks: Tensor, guess: Tensor | None = None
    ) -> Iterator[Selection]:
        """What each chunk probably needs, of those that are recorded when it is asked for.

        Parameters
        ----------
        parameters : Parameters
            S mixtures of K components.
        peaks : Tensor of shape (S, K)
            Log of weight times density at the components' means.
        guess : Tensor of shape (S, n_chunks), optional
            Least log-density of each chunk in the last pass.
        """
        n_components = peaks.shape[1]
        means = torch.cat(parameters.means, -1)
        narrowness = torch.cat([f.square().sum(-1).rsqrt() for f in parameters.factors], -1)
        widths = [mean.shape[-1] for mean in parameters.means]
        slab = max(1, SLAB // means.numel())
        first = 0
        while first < self._count:
            part = slice(first, min(first + slab, self._count))
            lowest, highest = self._boxes[part, :, None, None].unbind(1)
            gap = torch.maximum(lowest - means, means - highest).clamp_(min=0)
            gap.mul_(narrowness).square_()
            distance = torch.stack([g.amax(-1) for g in gap.split(widths, -1)]).sum(0)
            ceilings = peaks - distance / 2
            least = ceilings.amax(-1) - DEPTH if guess is None else guess.T[part] - SLACK
            needed = ceilings > (least - NEGLIGIBLE)[..., None]
            # none at all, if the guess is far too high
            counts = needed.sum(-1).amax(-1).clamp_(min=1).tolist()
            ranked = _numbered(ceilings.topk(max(counts), dim=-1).indices, n_components)
            limits = least.tolist()
            for row, count in enumerate(counts):
                chosen = None if count == n_components else ranked[row, :, :count].reshape(-1)
                yield Selection(ceilings[row], limits[row], chosen)
            first = part.stop


def _numbered(chosen: Tensor, n_components: int) -> Tensor:
    """Numbers among all S * K components, from those (..., S, A) within each mixture."""
    firsts = torch.arange(chosen.shape[-2], device=chosen.device) * n_components
    return chosen + firsts[:, None]

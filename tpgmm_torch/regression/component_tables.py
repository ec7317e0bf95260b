"""What a control tick needs of a mixture's components, prepared once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.regression.local_mixtures import LocalMixture

__all__ = ["Tables"]


@dataclass(frozen=True, eq=False)
class Tables:
    """What a control tick needs of A components, prepared once.

    Parameters
    ----------
    places : Tensor of shape (A, K)
        One-hot rows: which components of the mixture they are.
    time_mean, time_precision : Tensor of shape (A,)
        The time marginals [s], [1/s^2].
    log_weights : Tensor of shape (A,)
        Of the components, with what of the time marginal's density does not change.
    mean, gain : Tensor of shape (A, D + n)
        Local coordinates of the D task dimensions, and the *negative* n joints:
        ``E[x | t] = mean + gain (t - time_mean)``.
    tasks : Tensor of shape (D, A D)
        Covariances of the task coordinates given time, a block for each task; those of all
        components side by side, since all are multiplied with at once.
    joints : Tensor of shape (n, A n)
        Those of the joints, C.
    priors : Tensor of shape (A, n n)
        The same once more, each in one row, to be summed.
    """

    places: Tensor
    time_mean: Tensor
    time_precision: Tensor
    log_weights: Tensor
    mean: Tensor
    gain: Tensor
    tasks: Tensor
    joints: Tensor
    priors: Tensor

    def select(self, components: Sequence[int]) -> Tables:
        """Only some of the components."""
        index = torch.tensor(components, device=self.time_mean.device)

        def chosen(name: str) -> Tensor:
            table: Tensor = getattr(self, name)
            if name not in ("tasks", "joints"):
                return table[index]
            size = len(table)
            each = table.view(size, len(self.time_mean), size)[:, index]
            return each.reshape(size, len(index) * size)

        return Tables(*(chosen(field.name) for field in fields(self)))

    def padded(self, components: Sequence[int], count: int) -> Tables:
        """Some of the components, and others without weight up to ``count``."""
        spare = [components[0]] * (count - len(components))
        tables = self.select([*components, *spare])
        tables.log_weights[len(components) :] = -torch.inf
        return tables

    @classmethod
    def prepared(
        cls,
        first: LocalMixture,
        tasks: Sequence[LocalMixture],
        priors: Sequence[LocalMixture],
        log_weights: Tensor,
    ) -> Tables:
        """Tables of all components, in float64 first: narrow directions lose digits soonest.

        Parameters
        ----------
        first : LocalMixture
            Whose time marginal weighs the components.
        tasks : sequence of LocalMixture
            In the order of their coordinates.
        priors : sequence of LocalMixture
            Over the joints; they are fused into one.
        log_weights : Tensor of shape (K,)

        Raises
        ------
        DataError
            If a covariance is singular.
        """
        like = first.mean
        time_mean, variance = first.time_mean.double(), first.time_variance.double()

        def recentred(mixture: LocalMixture) -> tuple[Tensor, Tensor, Tensor]:
            gain = mixture.gain.double()
            apart = time_mean - mixture.time_mean.double()
            covariance = mixture.covariance.double()
            gaussians.cholesky(covariance, "the covariance of a projected component")
            return mixture.mean.double() + gain * apart[:, None], gain, covariance

        parts = [recentred(mixture) for mixture in tasks]
        parts.append(_product([recentred(mixture) for mixture in priors]))
        means, gains, covariances = zip(*parts, strict=True)
        size, start, blocks = sum(mean.shape[-1] for mean in means[:-1]), 0, []
        for covariance in covariances[:-1]:
            end = start + covariance.shape[-1]
            blocks.append(torch.nn.functional.pad(covariance, (start, size - end)))
            start = end
        count = len(time_mean)
        whole = torch.cat(blocks, -2) if blocks else means[-1].new_zeros(count, 0, 0)
        joints = covariances[-1]
        return cls(
            torch.eye(count, dtype=like.dtype, device=like.device),
            *(
                table.to(like)
                for table in (
                    time_mean,
                    1 / variance,
                    log_weights.double() - 0.5 * variance.log(),
                    torch.cat((*means[:-1], -means[-1]), -1),
                    torch.cat((*gains[:-1], -gains[-1]), -1),
                    whole.transpose(0, 1).reshape(size, count * size),
                    joints.transpose(0, 1).flatten(1),
                    joints.flatten(1),
                )
            ),
        )


def _product(
    priors: Sequence[tuple[Tensor, Tensor, Tensor]],
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, gain and covariance of the product (2) of Gaussians over the joints."""
    if len(priors) == 1:
        return priors[0]
    covariances = torch.stack([covariance for _, _, covariance in priors])
    vectors = torch.stack([torch.stack((mean, gain), -1) for mean, gain, _ in priors])
    inverses = torch.cholesky_inverse(gaussians.cholesky(covariances, "a joints' operator"))
    factor = gaussians.cholesky(inverses.sum(0), "the product of the joints' operators")
    mean, gain = torch.cholesky_solve((inverses @ vectors).sum(0), factor).unbind(-1)
    return mean, gain, torch.cholesky_inverse(factor)

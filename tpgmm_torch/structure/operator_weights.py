"""How much each operator counts in each component: found by what was left out.

The product (2) takes operators for independent witnesses. They are none: on the way between two
frames, every frame that does not matter repeats, less exactly, what the joints say, and six of
them outvote those who know better. A generalised product of experts lets each Gaussian given
time count for a share,

    prod_j N_ij(x | t)^w_ij,   0 < w_ij <= 1,

which divides its covariance by w_ij. The weights are those with which demonstrations that were
left out are most likely.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators import Operator
from tpgmm_torch.regression.conditionals import TimeMarginals
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.structure.evidence import Fused, gather_evidence

__all__ = ["held_out_weights", "weighted"]

#: With one demonstration to learn from there is no variance.
FEWEST = 3
#: Agreement of the joints below it means nothing [rad or m].
TOLERANCE = 0.005
#: At so many instants demonstrations are looked at, or at so many per component.
INSTANTS, PER_COMPONENT = 50, 2
#: What a weight less than one has to gain [nats per instant]: where all are as good, all count.
PENALTY = 0.01
#: No Gaussian is left out altogether, as nothing else may know a direction.
LEAST = 1e-3
#: Ascent (Adam) on the weights' logits, from BEGIN.
STEPS, RATE, BEGIN = 60, 0.4, 2.0


def held_out_weights(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    marginals: TimeMarginals,
    holds: Sequence[Hold] = (),
) -> Tensor:
    """Weights w_ij of J operators in K components, (K, J).

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        At least three, aligned.
    operators : sequence of Operator
    kinematics : Kinematics
    marginals : TimeMarginals
        When each component counts.
    holds : sequence of Hold, default=()
        Objects that the robot held.

    Raises
    ------
    DataError
        If there are fewer demonstrations.

    References
    ----------
    Cao, Fleet: Generalized Product of Experts for Automatic and Principled Fusion of Gaussian
    Process Predictions, arXiv:1410.7827, 2014.
    """
    if len(demonstrations) < FEWEST:
        raise DataError(
            "how much operators count is seen from demonstrations that are left out: it takes "
            f'at least {FEWEST}, got {len(demonstrations)}; use operator_weights="equal"'
        )
    count = len(marginals.mean)
    with torch.no_grad():
        evidence = gather_evidence(
            demonstrations,
            operators,
            kinematics,
            tolerance=TOLERANCE,
            n_instants=max(INSTANTS, PER_COMPONENT * count),
            holds=holds,
        )
        white = [row[..., :-1] for row in evidence.rows]
        precisions = torch.stack([one.mT @ one for one in white], -1)
        pairs = zip(white, evidence.rows, strict=True)
        vectors = torch.cat([one.mT @ row[..., -1:] for one, row in pairs], -1)
        activation = marginals.log_activation(evidence.time[:, None]).softmax(-1)
    with torch.enable_grad():
        logits = activation.new_full((count, len(operators)), BEGIN).requires_grad_()
        ascent = torch.optim.Adam([logits], lr=RATE, maximize=True)
        for _ in range(STEPS):
            shares = activation @ logits.sigmoid()  # (T, J)
            fused = Fused(
                evidence.nothing.precision + (precisions @ shares[:, None, :, None])[..., 0],
                evidence.nothing.vector + (vectors @ shares[..., None])[..., 0],
            )
            gain = evidence.log_likelihood(fused).mean() + PENALTY * shares.sum(-1).mean()
            ascent.zero_grad()
            gain.backward()  # type: ignore[no-untyped-call]
            ascent.step()
    return logits.detach().sigmoid().clamp(min=LEAST)


def weighted(covariances: Tensor, weights: Tensor) -> Tensor:
    """Covariances whose coordinates given time count for ``weights`` only.

    Parameters
    ----------
    covariances : Tensor of shape (K, 1 + D, 1 + D)
        Of time and the coordinates; how these depend on time stays as it is.
    weights : Tensor of shape (K,)
    """
    gain, given_time = gaussians.condition(covariances[..., 0], covariances, 1)
    changed = covariances.clone()
    cross = gain @ covariances[:, :1, 1:]
    changed[:, 1:, 1:] = given_time / weights[:, None, None] + cross
    return changed

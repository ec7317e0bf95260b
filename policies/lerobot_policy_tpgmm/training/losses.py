"""Losses of training by gradient, differentiable in the parameters of the mixture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.mixture_parameters import MixtureParameters
from lerobot_policy_tpgmm.training.covariance_prior import CovariancePrior
from tpgmm_torch import Frame, quaternions
from tpgmm_torch.operators import Operator
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots import Kinematics, RobotState

__all__ = ["Samples", "imitation_loss", "likelihood_loss", "local_points", "regression"]

#: Loss per squared radian: LeRobot's log shows three digits.
SQUARE_MILLIRADIANS = 1e6


@dataclass(frozen=True, eq=False)
class Samples:
    """A batch in the model's units.

    Parameters
    ----------
    time : Tensor of shape (B,)
        Of the model, at which the state was reached [s].
    next_time : Tensor of shape (B,)
        At which the action shall be [s].
    state : RobotState
        Of batch shape (B,).
    poses : dict of str to Frame
        Of shape (B,).
    """

    time: Tensor
    next_time: Tensor
    state: RobotState
    poses: dict[str, Frame]


def regression(
    config: TPGMMConfig,
    kinematics: Kinematics,
    operators: Sequence[Operator],
    mixture: MixtureParameters,
    n_demonstrations: int | None,
) -> Regression:
    """The regression of a policy, with parameters that carry gradients."""
    local = []
    for mean, triangle in zip(mixture.means, mixture.triangles(), strict=True):
        # time stands first, so conditioning on it leaves the other rows of the factor
        first, others = triangle[:, 0, 0], triangle[:, 1:, 1:]
        gain, covariance = triangle[:, 1:, 0] / first[:, None], others @ others.mT
        local.append(Conditionals(mean[:, 1:], gain, covariance, mean[:, 0], first.square()))
    return Regression(
        kinematics,
        operators,
        local,
        mixture.logits.log_softmax(0),
        fusion=config.fusion.value(),
        n_samples=n_demonstrations if config.em.covariance_shrinkage == "auto" else None,
    )


@torch.no_grad()
def local_points(model: Regression, samples: Samples) -> list[Tensor]:
    """Time and local coordinates (B, 1 + D_j) of each operator.

    Parameters
    ----------
    model : Regression
        Quaternions are brought to the side that it expects at their time.
    """
    points = []
    for j, operator in enumerate(model.operators):
        local = operator.at(samples.time).coordinates(samples.state, samples.poses)
        expected = model.expect(j, samples.time)
        starts = operator.quaternion_starts(model.kinematics)
        local = quaternions.match_hemisphere(local, expected, starts)
        points.append(torch.cat((samples.time[:, None], local), dim=1))
    return points


def likelihood_loss(
    mixture: MixtureParameters, points: Sequence[Tensor], prior: CovariancePrior | None = None
) -> Tensor:
    """Negative mean log-likelihood per frame, over all local data sets.

    It is what EM maximises with ``responsibilities="point"``, and counts time once for each
    operator, which :meth:`TaskParameterizedGMM.score` does not. With a prior on covariances,
    each component's counts in proportion to what it answers for: what EM regularises and
    shrinks stays so, and covariances do not shrink to nothing.

    Parameters
    ----------
    points : sequence of Tensor of shape (B, 1 + D_j)
        From :func:`local_points`.
    prior : CovariancePrior, optional
    """
    joint = mixture.log_joint(points)
    loss = -torch.logsumexp(joint, 0).mean()
    if prior is None:
        return loss
    shares = torch.softmax(joint.detach(), 0).mean(1)
    return loss + (shares * prior.penalty(mixture.triangles())).sum()


def imitation_loss(
    model: Regression, samples: Samples, wanted: Tensor, asked: Tensor
) -> Tensor:
    """Mean squared error of the reference that follows each state [mrad^2].

    Parameters
    ----------
    samples : Samples
        Their states are q_{t-1}.
    wanted : Tensor of shape (B, n)
        The joints that the action asks for [rad].
    asked : Tensor of shape (n,)
        Which of the model's joints these are.
    """
    estimate = model.estimate(samples.next_time, samples.state, samples.poses)
    return SQUARE_MILLIRADIANS * (estimate.joints[:, asked] - wanted).square().mean()

"""The mixture of a policy as torch parameters: saved, loaded, and trained by gradient."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import MultivariateNormal

from tpgmm_torch import TaskParameterizedGMM, gaussians
from tpgmm_torch.exceptions import DataError, NotFittedError, ShapeError

__all__ = ["MixtureParameters"]


class MixtureParameters(nn.Module):
    """A task-parameterised Gaussian mixture in coordinates without constraints.

    Weights are the softmax of the logits. Covariances are ``L L^T`` with ``L = D (I + N)``:
    the factor's diagonal holds the logarithms of the diagonal matrix D, and N is what stands
    below it. Whatever a gradient step does, they stay positive definite, and its effect is
    relative to D, the standard deviation of a coordinate given those before it. All entries
    of ``state_dict`` have sizes that follow from the arguments.

    Parameters
    ----------
    n_components : int
        K.
    dimensions : sequence of int
        D_j, the number of local coordinates of each operator, time not counted.

    Attributes
    ----------
    logits : Parameter of shape (K,)
    means : ParameterList
        Of shape (K, 1 + D_j), time first, one for each operator.
    factors : ParameterList
        Of shape (K, 1 + D_j, 1 + D_j): log D and N. The upper triangle is not used.
    time : Tensor of shape (T,)
        Buffer: time grid of a typical demonstration [s]; empty before a fit.
    fitted : Tensor of shape ()
        Buffer: whether the numbers come from a fitted model.
    """

    logits: nn.Parameter
    time: Tensor
    fitted: Tensor

    def __init__(
        self, n_components: int, dimensions: Sequence[int], dtype: torch.dtype = torch.float64
    ) -> None:
        super().__init__()
        widths = [1 + dimension for dimension in dimensions]
        self.logits = nn.Parameter(torch.zeros(n_components, dtype=dtype))
        self.means = nn.ParameterList(
            torch.zeros(n_components, width, dtype=dtype) for width in widths
        )
        self.factors = nn.ParameterList(
            torch.zeros(n_components, width, width, dtype=dtype) for width in widths
        )
        self.register_buffer("time", torch.zeros(0, dtype=dtype))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))

    def tensors(self) -> tuple[Tensor, list[Tensor], list[Tensor]]:
        """The mixture, differentiable.

        Returns
        -------
        weights : Tensor of shape (K,)
        means : list of Tensor of shape (K, 1 + D_j)
        covariances : list of Tensor of shape (K, 1 + D_j, 1 + D_j)
        """
        covariances = [factor @ factor.mT for factor in self.triangles()]
        return torch.softmax(self.logits, 0), list(self.means), covariances

    def triangles(self) -> list[Tensor]:
        """Lower Cholesky factors of the covariances, (K, 1 + D_j, 1 + D_j), differentiable."""
        triangles = []
        for factor in self.factors:
            unit = factor.tril(-1) + torch.eye(factor.shape[-1]).to(factor)
            scale = factor.diagonal(dim1=-2, dim2=-1).exp()
            triangles.append(scale[..., None] * unit)
        return triangles

    def log_joint(self, points: Sequence[Tensor]) -> Tensor:
        """Logarithms of weight times density of each component, (K, N), differentiable.

        Parameters
        ----------
        points : sequence of Tensor of shape (N, 1 + D_j)
            Time and local coordinates of each operator.
        """
        joint = torch.log_softmax(self.logits, 0)[:, None]
        for mean, triangle, x in zip(self.means, self.triangles(), points, strict=True):
            normal = MultivariateNormal(mean, scale_tril=triangle, validate_args=False)
            joint = joint + normal.log_prob(x[:, None]).mT
        return joint

    @torch.no_grad()
    def copy_from(self, model: TaskParameterizedGMM) -> None:
        """Take the parameters of a fitted model.

        Raises
        ------
        NotFittedError
            If it is not fitted.
        ShapeError
            If it has other numbers of components, operators or local coordinates.
        DataError
            If one of its covariances is not positive definite.
        """
        if not hasattr(model, "weights_"):
            raise NotFittedError("the model is not fitted: call fit(demonstrations) first")
        shapes, given = (
            [tuple(m.shape) for m in means] for means in (self.means, model.means_)
        )
        if shapes != given:
            raise ShapeError(
                f"the model has means of shapes {given} (components, 1 + local coordinates), "
                f"the policy's configuration asks for {shapes}: make both with the same "
                "n_components and operators"
            )
        # a weight that underflowed to zero would be an infinite logit
        smallest = torch.finfo(self.logits.dtype).tiny
        self.logits.copy_(model.weights_.clamp(min=smallest).log())
        pairs = zip(self.means, self.factors, model.means_, model.covariances_, strict=True)
        for j, (mean, factor, new_mean, covariance) in enumerate(pairs):
            triangle = gaussians.cholesky(
                covariance.double(), f"a covariance of the model's operator {j}"
            )
            mean.copy_(new_mean)
            scale = triangle.diagonal(dim1=-2, dim2=-1)
            below = (triangle / scale[..., None]).tril(-1)
            factor.copy_(below + scale.log().diag_embed())
        self.time = model.time_.to(self.time, copy=True)
        self.fitted.fill_(True)

    @torch.no_grad()
    def to_estimator(self, model: TaskParameterizedGMM, **learned: Any) -> TaskParameterizedGMM:
        """The fitted model that these parameters describe.

        Parameters
        ----------
        model : TaskParameterizedGMM
            With the settings, the operators and the robot that the parameters belong to; a
            :class:`~tpgmm_torch.robots.kinematics.JointSpace` serves as robot where the
            operators need none.

        Raises
        ------
        NotFittedError
            If these parameters come from no fit.
        DataError
            If a number is not finite, or the operators do not fit.
        """
        if not self.fitted:
            raise NotFittedError("the policy is not fitted: train it, or use from_estimator")
        broken = [
            name for name, value in self.state_dict().items() if not value.isfinite().all()
        ]
        if broken:
            raise DataError(f"the policy's parameters {broken} hold NaN or infinity")
        settings = model.get_params(deep=False)
        weights, means, covariances = self.tensors()
        copies, time = [mean.clone() for mean in means], self.time.clone()
        return TaskParameterizedGMM.from_parameters(
            weights, copies, covariances, time, **learned, **settings
        )

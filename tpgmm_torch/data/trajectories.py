"""Joint references that a model predicts, and what they are made of."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

__all__ = ["Candidate", "Trajectory"]


@dataclass(frozen=True, eq=False)
class Candidate:
    """The estimate of the joints by one operator alone (one colour of the paper's figure 6).

    Parameters
    ----------
    mean : Tensor of shape (..., n_joints)
        ``A mu + b`` of Table I, mixed over the components [rad or m].
    covariance : Tensor of shape (..., n_joints, n_joints)
        ``A Sigma A^T`` of eq. (1), mixed over the components.
    share : Tensor of shape (..., n_joints)
        Fraction in [0, 1] of the information about each joint that comes from this
        operator: its marginal precision over the sum of all operators' marginal precisions.
    """

    mean: Tensor
    covariance: Tensor
    share: Tensor

    def __repr__(self) -> str:
        return f"Candidate(shape {tuple(self.mean.shape)}, mean share {self.share.mean():.2f})"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A reproduction: joint references over time, and where they come from.

    Parameters
    ----------
    time : Tensor of shape (T,)
        Seconds.
    joints : Tensor of shape (T, n_joints)
        References q_hat_t [rad or m].
    covariance : Tensor of shape (T, n_joints, n_joints)
        Their covariance, the spread between the mixture's components included.
    candidates : tuple of Candidate
        One per operator of the model, in its order, each with leading shape (T,).
    joint_names : tuple of str
        Names of the columns of ``joints``.
    novelty : float, optional
        How new the situation is to the model: 1 is as far from the demonstrations as the one
        of these that is furthest from the others
        (:class:`~tpgmm_torch.checks.TrainingSummary`). None where the model does not know its
        demonstrations.
    """

    time: Tensor
    joints: Tensor
    covariance: Tensor
    candidates: tuple[Candidate, ...]
    joint_names: tuple[str, ...]
    novelty: float | None = None

    def __len__(self) -> int:
        """Number of time steps T."""
        return len(self.time)

    def __repr__(self) -> str:
        return (
            f"Trajectory({len(self)} steps, {float(self.time[-1] - self.time[0]):.2f} s, "
            f"{self.joints.shape[-1]} joints, {len(self.candidates)} candidates)"
        )

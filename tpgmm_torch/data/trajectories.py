"""What comes out of a model: joint references, and where they come from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from torch import Tensor

from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.notebook import Tabular, listed, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Candidate", "Trajectory"]


@dataclass(frozen=True, eq=False)
class Candidate(Tabular):
    """What one operator alone asks of the joints (one colour of the paper's figure 6).

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

    def _rows(self) -> dict[str, object]:
        shares = self.share.flatten(0, -2).mean(0).tolist()
        return {
            "shape": tuple(self.mean.shape),
            "mean share of each joint": listed(f"{share:.2f}" for share in shares),
        }


@dataclass(frozen=True, eq=False)
class Trajectory(Tabular):
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

    def plot(
        self,
        joints: Sequence[str] | None = None,
        axes: Sequence[Axes] | None = None,
        **line: Any,
    ) -> list[Axes]:
        """Draw the joints over time, one panel each, with bands of two standard deviations.

        Parameters
        ----------
        joints : sequence of str, optional
            Names of those to draw; all by default.
        axes : sequence of matplotlib Axes, optional
            Panels to draw into, those of a demonstration for example; new ones by default.
        **line
            As for ``Axes.plot``.

        Returns
        -------
        list of matplotlib Axes

        Raises
        ------
        UnknownNameError, DependencyError
            If there is no such joint, or no matplotlib.
        """
        chosen = panels(self.joint_names, joints, axes)
        time, mean = as_array(self.time), as_array(self.joints)
        variance = as_array(self.covariance.diagonal(dim1=-2, dim2=-1))
        band = 2 * variance.clip(min=0) ** 0.5
        for column, panel in chosen.values():
            [curve] = panel.plot(time, mean[:, column], **line)
            low, high = mean - band, mean + band
            panel.fill_between(
                time, low[:, column], high[:, column], color=curve.get_color(), alpha=0.2, lw=0
            )
        return [panel for _, panel in chosen.values()]

    def _rows(self) -> dict[str, object]:
        duration = float(self.time[-1] - self.time[0])
        novelty = "-" if self.novelty is None else f"{self.novelty:.2f}"
        return {
            "steps": f"{len(self)} in {duration:.2f} s",
            "joints": listed(self.joint_names),
            "candidates": len(self.candidates),
            "novelty": novelty,
        }

    def __repr__(self) -> str:
        return (
            f"Trajectory({len(self)} steps, {float(self.time[-1] - self.time[0]):.2f} s, "
            f"{self.joints.shape[-1]} joints, {len(self.candidates)} candidates)"
        )

"""Demonstrations checked, read and summarised: all that is learned from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

from torch import Tensor

from tpgmm_torch.checks.report import Report
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.checks.training import EpisodeSummary, check, summarize
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.mixture.processes import ALONE, Processes
from tpgmm_torch.motion.demonstrated_peaks import DemonstratedPeaks
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.outlying_demonstrations import outlying_rows, unlike_the_others
from tpgmm_torch.training.training_rows import TrainingRows, read_rows

__all__ = ["TrainingData", "read"]


@dataclass(frozen=True, eq=False)
class TrainingData:
    """What is learned from.

    Parameters
    ----------
    rows : TrainingRows
    peaks : tuple of two Tensor of shape (n_joints,), or None
        Accelerations [rad/s^2] and jerks [rad/s^3] of the demonstrations.
    summary : TrainingSummary or None
    """

    rows: TrainingRows
    peaks: tuple[Tensor, Tensor] | None
    summary: TrainingSummary | None


def read(
    batches: Iterable[Sequence[Demonstration]],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    *,
    responsibilities: str = "auto",
    correlated: bool = False,
    interval: tuple[float, float] | None = None,
    processes: Processes = ALONE,
) -> TrainingData:
    """Read demonstrations once, and warn of all that is implausible about them.

    Parameters
    ----------
    batches : iterable of sequence of Demonstration
        Of this process, at least one.
    operators : sequence of Operator
    kinematics : Kinematics
    responsibilities : {"auto", "instant", "point"}
    correlated : bool, default=False
        Whether all correlations of coordinates are learned as they are.
    interval : tuple of float, optional
        Learn from this part of the time only, begin and end [s].
    processes : Processes

    Raises
    ------
    DataError, ShapeError, UnknownNameError, PlausibilityError
        If demonstrations do not fit together, or with the robot and the operators, or cannot
        be what they are taken for.
    """
    peaks, episodes = DemonstratedPeaks(kinematics.joint_names), list[EpisodeSummary]()

    def watched() -> Iterator[Sequence[Demonstration]]:
        for batch in peaks.watch(batches):
            episodes.extend(summarize(batch, kinematics))
            yield batch

    rows = read_rows(
        watched(), operators, kinematics, responsibilities=responsibilities, processes=processes
    )
    rows = rows if interval is None else rows.within(*interval)
    episodes = list(chain.from_iterable(processes.gather(episodes)))
    known = episodes, kinematics, rows.operators, rows.holds
    findings = list(check(*known, correlated=correlated))
    if outlying := outlying_rows(rows, kinematics):
        findings.append(unlike_the_others(outlying, rows.n_demonstrations))
    report = Report.of(findings, f"{len(episodes)} demonstrations")
    if processes.rank == 0 or report.errors():
        report.act()
    summary = TrainingSummary.of(episodes, kinematics)
    return TrainingData(rows, peaks.result(processes), summary)

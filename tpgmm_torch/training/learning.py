"""Learning from demonstrations: a mixture over local coordinates, and their ranges."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from torch import Tensor

from tpgmm_torch.checks.report import Report
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.checks.training import EpisodeSummary, check, summarize
from tpgmm_torch.data.arrays import Array, as_tensor
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.holds import Hold, check_holds
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.mixture.covariance_shrinkage import shrink
from tpgmm_torch.mixture.processes import ALONE, Processes
from tpgmm_torch.mixture.row_file import ColumnMoments
from tpgmm_torch.motion.command_gaps import CommandGaps, episode_gaps
from tpgmm_torch.motion.demonstrated_peaks import joint_peaks, typical_peaks
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.base import of_joints
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training import mixture_settings
from tpgmm_torch.training.outlying_demonstrations import outlying_rows, unlike_the_others
from tpgmm_torch.training.shares import Share
from tpgmm_torch.training.training_rows import TrainingRows, read_rows

#: Parameters of the estimator that are the mixture's too.
SHARED = (
    "n_components", "covariance_type", "tol", "max_iter", "n_init", "init_params",
    "random_state", "dtype", "device",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Learned:
    """Mixture of local coordinates, and ranges of the demonstrations it was learned from.

    Parameters
    ----------
    mixture : BlockGaussianMixture
        Of the local data of all operators side by side.
    operators : tuple of Operator
        With the mean orientations of the demonstrations.
    kinematics : Kinematics
        In the precision and on the device of the model.
    time : Tensor of shape (T,)
        Time grid of a typical demonstration [s].
    holds : tuple of Hold
        In the time of the skill.
    n_demonstrations : int or None
        How many were learned from; None if that is not known.
    peaks : tuple of two Tensor of shape (n_joints,), or None
        Accelerations [rad/s^2] and jerks [rad/s^3] of the demonstrations.
    summary : TrainingSummary or None
        Ranges of start postures and frames.
    gaps : CommandGaps or None
        What servos need beyond postures; None where no demonstration has commands.
    """

    mixture: BlockGaussianMixture
    operators: tuple[Operator, ...]
    kinematics: Kinematics
    time: Tensor
    holds: tuple[Hold, ...] = ()
    n_demonstrations: int | None = None
    peaks: tuple[Tensor, Tensor] | None = None
    summary: TrainingSummary | None = None
    gaps: CommandGaps | None = None


def learn(
    X: Iterable[Demonstration] | Iterable[Sequence[Demonstration]],
    settings: Mapping[str, Any],
    *,
    interval: tuple[float, float] | None = None,
    processes: Processes = ALONE,
) -> Learned:
    """Read demonstrations once, warn of what is implausible, and learn a mixture by EM.

    Parameters
    ----------
    X : iterable of Demonstration, or of sequence of Demonstration
        In one list, or in batches of a set that is larger than memory.
    settings : mapping of str to object
        Parameters of :class:`~tpgmm_torch.TaskParameterizedGMM`, all of them.
    interval : tuple of float, optional
        Learn from this part of the time only, begin and end [s].
    processes : Processes
        Among which the demonstrations are spread.

    Raises
    ------
    DataError, ShapeError, UnknownNameError, PlausibilityError
        If demonstrations do not fit together, or with the robot and the operators, or cannot
        be what they are taken for.
    """
    operators = mixture_settings.check_operators(settings["operators"])
    share, robot = Share(X, processes), settings["robot"]
    where = settings["dtype"], settings["device"]
    kinematics = mixture_settings.kinematics_for(share.first, operators, robot, *where)
    if settings["fusion"] is not None:
        settings["fusion"].check(of_joints(operators), kinematics)
    read: list[tuple[EpisodeSummary, Array, Array | None]] = []

    def watch(one: Demonstration) -> None:
        ordered = one.reorder(kinematics.joint_names)
        peaks, gaps = joint_peaks(ordered), episode_gaps(ordered)
        read.extend((summary, peaks, gaps) for summary in summarize([one], kinematics))

    shared = settings["responsibilities"]
    rows = read_rows(share, operators, kinematics, responsibilities=shared, watch=watch)
    rows = rows if interval is None else rows.within(*interval)
    episodes, peaks, gaps = zip(*chain.from_iterable(processes.gather(read)), strict=True)
    _report(rows, episodes, kinematics, settings)
    moments = ColumnMoments.of(rows.rows, processes)
    shape = {name: settings[name] for name in ("reg_covar", "covariance_type")}
    mixture = BlockGaussianMixture(
        **_of_mixture(settings, rows.operators, kinematics),
        group_size=rows.group_size,
        reg_covar=mixture_settings.regularization(moments, rows.operators, kinematics, **shape),
    ).fit(rows.rows, processes=processes)
    _shrink(mixture, rows, kinematics, settings)
    shown = rows.operators, kinematics, rows.time, rows.holds, rows.n_demonstrations
    summary = TrainingSummary.of(episodes, kinematics)
    learned_gaps = CommandGaps.learn(gaps, rows.time)
    return Learned(mixture, *shown, typical_peaks(peaks), summary, learned_gaps)


def from_parameters(
    weights: Any,
    means: Sequence[Any],
    covariances: Sequence[Any],
    time: Any,
    settings: Mapping[str, Any],
    *,
    holds: Sequence[Hold] = (),
    **others: Any,
) -> Learned:
    """Make a mixture of given parameters, which are kept as they are.

    Parameters
    ----------
    weights, means, covariances, time : array-like, or sequences of array-like
        Of shapes (K,), (K, 1 + D_j), (K, 1 + D_j, 1 + D_j) and (T,).
    settings : mapping of str to object
        Parameters of :class:`~tpgmm_torch.TaskParameterizedGMM`, all of them.
    holds : sequence of Hold
        In the time of the skill.
    **others
        ``n_demonstrations``, ``peaks``, ``summary`` and ``gaps`` of :class:`Learned`.

    Raises
    ------
    DataError, ShapeError
        If they are no mixture, or do not fit the operators.
    """
    weights, time = as_tensor(weights, "weights"), as_tensor(time, "time")
    means = [as_tensor(mean, "a mean") for mean in means]
    covariances = [as_tensor(covariance, "a covariance") for covariance in covariances]
    operators = mixture_settings.check_operators(settings["operators"])
    robot = settings["robot"]
    if robot is None:
        raise DataError("the model has no robot: give it a Robot, Poses or a JointSpace")
    if settings["fusion"] is not None:
        settings["fusion"].check(of_joints(operators), robot)
    mixture = BlockGaussianMixture.from_parameters(
        weights, means, covariances, **_of_mixture(settings, operators, robot)
    )
    # it checked them; what it keeps went through their factors, and was rounded
    mixture.weights_, mixture.means_, mixture.covariances_ = weights, means, covariances
    held = check_holds(holds, [hold.frame for hold in holds], robot.links)
    kinematics = robot.to(time.dtype, settings["device"])
    return Learned(mixture, operators, kinematics, time, held, **others)


def _of_mixture(
    settings: Mapping[str, Any], operators: Sequence[Operator], kinematics: Kinematics
) -> dict[str, Any]:
    """Collect parameters of the mixture of the local data of all operators."""
    blocks = mixture_settings.block_widths(operators, kinematics)
    return {name: settings[name] for name in SHARED} | {"blocks": blocks}


def _shrink(
    mixture: BlockGaussianMixture,
    rows: TrainingRows,
    kinematics: Kinematics,
    settings: Mapping[str, Any],
) -> None:
    """Move full or tied covariances, given time, towards their diagonals."""
    intensity = settings["covariance_shrinkage"]
    if settings["covariance_type"] not in ("full", "tied") or intensity == 0:
        return
    shrunk = []
    for operator, covariance in zip(rows.operators, mixture.covariances_, strict=True):
        units = (None, *operator.units(kinematics)) if intensity == "auto" else ()
        found = shrink(covariance.double(), intensity, rows.n_demonstrations, units, given=1)
        shrunk.append(found.to(covariance))
    mixture.covariances_ = shrunk


def _report(
    rows: TrainingRows,
    episodes: Sequence[EpisodeSummary],
    kinematics: Kinematics,
    settings: Mapping[str, Any],
) -> None:
    """Warn once of what is implausible in the demonstrations; refuse what is impossible."""
    full = settings["covariance_type"] in ("full", "tied")
    correlated = full and settings["covariance_shrinkage"] == 0
    findings = list(
        check(episodes, kinematics, rows.operators, rows.holds, correlated=correlated)
    )
    if outlying := outlying_rows(rows, kinematics):
        findings.append(unlike_the_others(outlying, rows.n_demonstrations))
    report = Report.of(findings, f"{len(episodes)} demonstrations")
    if rows.processes.rank == 0 or report.errors():
        report.act()

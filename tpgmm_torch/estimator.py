"""The estimator: learn a skill from demonstrations, reproduce it in new situations."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, clone
from sklearn.utils import check_random_state
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.checks.report import PLAUSIBILITY, Finding, Report
from tpgmm_torch.checks.situations import check_situations
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.checks.training import EpisodeSummary, check, summarize, unit_findings
from tpgmm_torch.constraints import Interval, Options, check_parameters
from tpgmm_torch.control.clocks import Clock
from tpgmm_torch.control.controller import Controller
from tpgmm_torch.control.rollout import rollout
from tpgmm_torch.data.arrays import as_array, as_tensor
from tpgmm_torch.data.demonstrations import Demonstration, Situation, check_demonstrations
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.holds import Hold, check_holds
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.exceptions import (
    DataError,
    ModelFileError,
    NotFittedError,
    ShapeError,
    UnknownNameError,
)
from tpgmm_torch.impedance.stiffness import Impedance
from tpgmm_torch.large_data.checkpoints import Checkpoint
from tpgmm_torch.large_data.processes import ALONE, Processes, column_moments
from tpgmm_torch.large_data.row_batches import StoredRows
from tpgmm_torch.large_data.row_file import RowFile
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture, fit_subsets
from tpgmm_torch.motion.demonstrated_peaks import DemonstratedPeaks, demonstrated_peaks
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.operators import Canonical, Operator, Stack
from tpgmm_torch.operators.base import carried_objects, frame_names
from tpgmm_torch.operators.stack import leaves
from tpgmm_torch.persistence import MODEL, MODES, decode, encode
from tpgmm_torch.regression.conditionals import Conditionals, TimeMarginals
from tpgmm_torch.regression.conditioning import Conditioning
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.prior import PRIOR_STD, given_widths, prior_widths
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.regression.via_points import ViaPoint
from tpgmm_torch.robots.joint_space import JointSpace
from tpgmm_torch.robots.kinematics import Kinematics, RobotState
from tpgmm_torch.sensing.pose_filter import OneEuro
from tpgmm_torch.sensing.trust import Trust
from tpgmm_torch.skills.via_points import ViaPoints
from tpgmm_torch.structure.component_selection import ComponentSelection
from tpgmm_torch.structure.operator_selection import (
    OperatorSelection,
    arranged,
    candidate_operators,
)
from tpgmm_torch.structure.operator_weights import held_out_weights, weighted
from tpgmm_torch.structure.parts import (
    Part,
    chained,
    check_cuts,
    components_of_parts,
    matters,
    part_of,
    stretches,
    united,
)
from tpgmm_torch.structure.segmentation import Segmentation
from tpgmm_torch.training.hold_detection import holds_for
from tpgmm_torch.training.kept_rows import KeptRows
from tpgmm_torch.training.local_data import local_data
from tpgmm_torch.training.mean_orientations import with_mean_orientations
from tpgmm_torch.training.mixture_settings import (
    block_widths,
    check_operators,
    column_units,
    fused_samples,
    kinematics_for,
    regularization,
)
from tpgmm_torch.training.outlying_demonstrations import (
    Outlying,
    left_out,
    outlying_demonstrations,
    outlying_rows,
)
from tpgmm_torch.training.training_rows import (
    LearningRows,
    check_shares,
    checked_batches,
    gather_rows,
    on_grid,
    rows_in_memory,
    split_batches,
)

__all__ = ["TaskParameterizedGMM"]

#: Parameters that the estimator and its mixture share.
MIXTURE_PARAMETERS = (
    "n_components", "covariance_type", "reg_covar", "covariance_shrinkage", "tol", "max_iter",
    "n_init", "init_params", "random_state", "warm_start", "verbose", "dtype", "device",
)  # fmt: skip


class TaskParameterizedGMM(BaseEstimator):  # type: ignore[misc]
    """Task-parameterised Gaussian mixture over joint space and task space.

    One sample is one demonstration: ``X`` is a list of :class:`Demonstration`, so that
    scikit-learn's cross-validation works unchanged.

    Parameters
    ----------
    n_components : int, "auto" or ComponentSelection, default=10
        K, the number of Gaussians. "auto" finds it by the likelihood of demonstrations that
        are left out, :class:`~tpgmm_torch.structure.component_selection.ComponentSelection`,
        of at least three.
    operators : sequence of Operator, "auto" or OperatorSelection, optional
        Candidate projection operators, one subspace each; the default is ``[Canonical()]``.
        "auto" finds those that matter, :class:`OperatorSelection`, in at least three
        demonstrations; one of your own has candidates and thresholds of your own. With parts,
        each has those that matter in it; they may be given, too, as one sequence per part.
    robot : Kinematics, optional
        A :class:`Robot`, :class:`Poses` for recorded poses without a robot, or your own;
        not needed by ``Canonical()`` alone.
    priorities : sequence of int, optional
        One per operator. Those of a higher number are fulfilled as if those of lower ones were
        not there, which act in what is left of the joints (the null space), damped; those of
        one number compromise as their covariances say, as all do by default.
    operator_weights : {"equal", "held-out"}, default="equal"
        How much the Gaussians of operators count in the product (2): all alike, as in the
        paper, or by weights from 0 to 1 for each component, with which demonstrations that are
        left out, of at least three, are most likely
        (:func:`~tpgmm_torch.structure.operator_weights.held_out_weights`). Frames that do not
        matter do little harm then. ``covariances_`` given time are divided by the weights.
    parts : "auto", Segmentation, sequence of float or str, or None, default=None
        Where the skill has parts that are learned one by one, each with operators and
        components of its own: found (:class:`Segmentation`), or where they end, as instants in
        the time of the skill [s] or events of the demonstrations. With a number of components
        each part has its share of them. Demonstrations should be in step there, see
        :meth:`Segmentation.transform`.
    covariance_type : {"full", "diag", "tied", "spherical"}, default="full"
        Shape of the local covariances.
    reg_covar : float, default=1e-5
        Added to the diagonal of the covariances, relative to the variance of each coordinate.
        A smaller value is more exact where demonstrations agree, a larger one smoother where
        operators contradict each other.
    covariance_shrinkage : "auto" or float, default="auto"
        How far the full or tied covariances given time go towards their diagonals after EM,
        from 0 to 1; slopes over time stay as they are. N demonstrations leave N - 1 directions
        in which they differ, and what seems exact across these is chance. "auto" follows from
        N and the number of coordinates, for each component and operator, and falls as 1 / N
        (``oracle_approximating_intensity``); it also moderates the variances of coordinates of
        one unit by each other (``moderated_variances``), of which few demonstrations say
        little, and lets joints give way to hands by what is left unknown of them, (N + 1) /
        (N - 1) times their covariance (``predictive_scale``). 0 is the paper's.
    tol : float, default=1e-3
        EM stops when the mean log-likelihood gains less.
    max_iter : int, default=100
        Largest number of EM iterations.
    n_init : int, default=1
        Number of starts; the most likely result is kept.
    init_params : {"time", "kmeans", "random"}, default="time"
        How EM starts; "time" cuts the time axis into equal bins.
    responsibilities : {"auto", "instant", "point"}, default="auto"
        What one responsibility is for. "point": every point of every demonstration, as in
        the paper. "instant": all demonstrations at one instant together, which keeps
        components from splitting a phase of the skill among few demonstrations and thereby
        from a confidence that nothing supports. "auto": "instant" where the demonstrations
        share one time grid, as after alignment, else "point".
    fusion : {"information", "covariance"}, default="information"
        Form of the product of Gaussians; "covariance" is eqs (1), (2) as printed.
    activation : {"time", "product"}, default="time"
        Where the mixing weights come from: the components' time marginal taken
        once, or that of the product, as in eq. (2).
    epsilon : float, default=1e-4
        Added to the diagonal of every projected covariance by ``fusion="covariance"`` [rad^2].
    prior_std : float, mapping of str to float, or array-like of shape (n_joints,), default=10.0
        Standard deviation of the prior around q_{t-1} where no operator determines every
        joint: for all joints [rad], for those that are lengths in units of the root mean square
        of the learned positions; or joint by joint, each in its own unit.
    negligible : float, default=1e-9
        With ``activation="time"``, shares of the largest weight below this do not count.
    blend : float, default=1.0
        Seconds over which ``predict`` fades out the difference between the start posture and
        the model's first reference (minimum jerk); 0 follows the model at once.
    keep_limits : bool, default=True
        References stay within the robot's limits of position and, in ``predict``, of speed:
        where the fused Gaussian goes beyond one, the joint stands there and the others take
        over as the Gaussian says.
    holds : "auto", sequence of Hold or None, default="auto"
        From when to when a link holds an object. "auto" finds it in demonstrations whose
        frames were recorded over time
        (``find_holds``); what was recorded once, or
        never moves, is never held. While an object is held, its frame as a place is where it
        was last free, for learning and for reproducing alike.
    robust : bool, default=True
        Whether to leave out demonstrations that are unlike the others where these agree, up
        to a third of five or more, with a warning that names them
        (``outlying_demonstrations``). Of demonstrations in batches, the local data of all
        are in memory for that, thinned out to four instants per second if they are many.
    plausibility : {"warn", "error", "ignore"}, default="warn"
        What is done about recordings and situations that are unlikely to be what they are
        taken for (units, order, clock, places far from those shown): one
        :class:`~tpgmm_torch.exceptions.PlausibilityWarning` for each call, an error, or
        nothing. What cannot be is an error unless ignored.
    random_state : int, RandomState instance or None, default=None
    warm_start : bool, default=False
        Start EM from the previous solution.
    dtype : {"float64", "float32"}, default="float64"
    device : str, default="cpu"
        Where tensors live, as torch spells it.
    verbose : int, default=0

    Attributes
    ----------
    weights_ : Tensor of shape (K,)
        Mixing coefficients pi_i.
    means_ : list of Tensor of shape (K, 1 + D_j)
        Local means mu_i^(j), time first, one tensor per operator.
    covariances_ : list of Tensor of shape (K, 1 + D_j, 1 + D_j)
        Local covariances Sigma_i^(j).
    n_components_ : int
    component_selection_ : ComponentSelection, tuple of ComponentSelection, or None
        How likely what was left out is with each number, one per part; None where it was given.
    operators_ : tuple of Operator
        Of all parts.
    operator_selection_ : OperatorSelection, tuple of OperatorSelection, or None
        Which were found, and why, one per part; None where they were given, and for a model
        that was loaded.
    parts_ : tuple of Part
        One after the other; none where there is one.
    segmentation_ : Segmentation or None
        Why there are parts; None where they were given, and for a model that was loaded.
    operator_weights_ : Tensor of shape (K, J) or None
        How much each operator counts; None where all are equal. :meth:`partial_fit` keeps
        them.
    kinematics_ : Kinematics
    holds_ : tuple of Hold
        In the time of the skill.
    joint_names_ : tuple of str
        The joints that were learned, in the order of all results.
    frame_names_ : tuple of str
        Frames that a situation must have; those at which a link was at the start of every
        demonstration (``--frame start=l_hand@start``) follow from its start posture where
        they are not given.
    time_ : Tensor of shape (T,)
        Time grid of a typical demonstration, the default of ``predict`` [s].
    acceleration_, jerk_ : Tensor of shape (n_joints,) or None
        Peaks of the demonstrations [rad/s^2], [rad/s^3]; None where they are not known, as in
        models that were saved by earlier versions.
    n_iter_ : int
    converged_ : bool
    lower_bound_ : float
        Mean log-likelihood per time step at the end of EM, before covariances are shrunk.
    mixture_ : BlockGaussianMixture
        Of the local data of all operators side by side.
    demonstration_weights_ : Tensor of shape (M,) or None
        1 for each demonstration that was learned from, 0 for each that was left out; the
        mixing coefficients are ``weights_``. Counted process by process, where there are
        several. None for a model that was loaded or made from parameters.
    via_points_ : tuple of ViaPoint
        Those that the skill passes through, see :meth:`with_via_points`.
    via_fade_ : float
        For how long before and after them it is another [s].
    summary_ : TrainingSummary or None
        What the demonstrations showed: ranges of start postures and frames. None for a model
        that was made from parameters.

    References
    ----------
    Silvério, Calinon, Rozo, Caldwell: Bimanual Skill Learning with Pose and Joint Space
    Constraints, Humanoids 2018: Algorithm 1.

    Examples
    --------
    >>> import numpy as np
    >>> from tpgmm_torch import Demonstration, Situation, TaskParameterizedGMM
    >>> time = np.linspace(0, 1, 50)
    >>> demonstrations = [
    ...     Demonstration(time, np.sin(3 * time)[:, None] + offset) for offset in (-0.1, 0, 0.1)
    ... ]
    >>> model = TaskParameterizedGMM(n_components=4, blend=0).fit(demonstrations)
    >>> [trajectory] = model.predict([Situation(joints=[0.0])])
    >>> bool(abs(trajectory.joints[:, 0].numpy() - np.sin(3 * time)).max() < 0.05)
    True
    """

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012
        "n_components": [
            Interval(Integral, 1, None, closed="left"),
            Options("auto"),
            ComponentSelection,
        ],
        "operators": [Options("auto"), OperatorSelection, "array-like", None],
        "robot": [Kinematics, None],
        "priorities": ["array-like", None],
        "operator_weights": [Options("equal", "held-out")],
        "parts": [Options("auto"), Segmentation, "array-like", None],
        "covariance_type": [Options("full", "diag", "tied", "spherical")],
        "reg_covar": [Interval(Real, 0, None, closed="left")],
        "covariance_shrinkage": [Interval(Real, 0, 1, closed="both"), Options("auto")],
        "tol": [Interval(Real, 0, None, closed="left")],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "n_init": [Interval(Integral, 1, None, closed="left")],
        "init_params": [Options("time", "kmeans", "random")],
        "responsibilities": [Options("auto", "instant", "point")],
        "fusion": [Options("information", "covariance")],
        "activation": [Options("time", "product")],
        "epsilon": [Interval(Real, 0, None, closed="left")],
        "prior_std": [Interval(Real, 0, None, closed="neither"), dict, "array-like"],
        "negligible": [Interval(Real, 0, 1, closed="left")],
        "blend": [Interval(Real, 0, None, closed="left")],
        "keep_limits": ["boolean"],
        "holds": [Options("auto"), "array-like", None],
        "robust": ["boolean"],
        "plausibility": [Options(*PLAUSIBILITY)],
        "random_state": ["random_state"],
        "warm_start": ["boolean"],
        "dtype": [Options("float64", "float32")],
        "device": [str],
        "verbose": ["verbose"],
    }

    weights_: Tensor
    means_: list[Tensor]
    covariances_: list[Tensor]
    time_: Tensor
    holds_: tuple[Hold, ...]
    via_fade_: float
    summary_: TrainingSummary | None
    demonstration_weights_: Tensor | None
    operator_selection_: OperatorSelection | tuple[OperatorSelection, ...] | None
    operator_weights_: Tensor | None
    component_selection_: ComponentSelection | tuple[ComponentSelection, ...] | None
    parts_: tuple[Part, ...]
    segmentation_: Segmentation | None
    acceleration_: Tensor | None
    jerk_: Tensor | None
    via_points_: tuple[ViaPoint, ...]
    #: What :meth:`partial_fit` goes on with.
    _kept: KeptRows | None

    #: Whether no tick of :meth:`step` was looked at since the model was fitted.
    _untried = True

    def __init__(
        self,
        n_components: int | str | ComponentSelection = 10,
        operators: Sequence[Any] | str | OperatorSelection | None = None,
        robot: Kinematics | None = None,
        *,
        priorities: Sequence[int] | None = None,
        operator_weights: str = "equal",
        parts: str | Segmentation | Sequence[float | str] | None = None,
        covariance_type: str = "full",
        reg_covar: float = 1e-5,
        covariance_shrinkage: float | str = "auto",
        tol: float = 1e-3,
        max_iter: int = 100,
        n_init: int = 1,
        init_params: str = "time",
        responsibilities: str = "auto",
        fusion: str = "information",
        activation: str = "time",
        epsilon: float = 1e-4,
        prior_std: float | Mapping[str, float] | Sequence[float] = PRIOR_STD,
        negligible: float = 1e-9,
        blend: float = 1.0,
        keep_limits: bool = True,
        holds: str | Sequence[Hold] | None = "auto",
        robust: bool = True,
        plausibility: str = "warn",
        random_state: int | np.random.RandomState | None = None,
        warm_start: bool = False,
        dtype: str = "float64",
        device: str = "cpu",
        verbose: int = 0,
    ) -> None:
        self.n_components = n_components
        self.operators = operators
        self.robot = robot
        self.priorities = priorities
        self.operator_weights = operator_weights
        self.parts = parts
        self.covariance_type = covariance_type
        self.reg_covar = reg_covar
        self.covariance_shrinkage = covariance_shrinkage
        self.tol = tol
        self.max_iter = max_iter
        self.n_init = n_init
        self.init_params = init_params
        self.responsibilities = responsibilities
        self.fusion = fusion
        self.activation = activation
        self.epsilon = epsilon
        self.prior_std = prior_std
        self.negligible = negligible
        self.blend = blend
        self.keep_limits = keep_limits
        self.holds = holds
        self.robust = robust
        self.plausibility = plausibility
        self.random_state = random_state
        self.warm_start = warm_start
        self.dtype = dtype
        self.device = device
        self.verbose = verbose

    @property
    def joint_names_(self) -> tuple[str, ...]:
        """The joints that were learned, in the order of all results."""
        return tuple(self.kinematics_.joint_names)

    @property
    def selects(self) -> bool:
        """Whether :meth:`fit` finds parts, operators, weights or the number of components."""
        found = isinstance(self.operators, str | OperatorSelection) or self.parts is not None
        found = found or self.operator_weights != "equal"
        return found or not isinstance(self.n_components, Integral)

    def check_parameters(self) -> None:
        """Check types and ranges of the parameters, as :meth:`fit` does before it begins.

        Raises
        ------
        InvalidParameterError
            If one is not allowed.
        """
        check_parameters(self)

    def fit(
        self,
        X: Iterable[Demonstration] | Iterable[Sequence[Demonstration]],
        y: object = None,
        *,
        checkpoint: Checkpoint | None = None,
        processes: Processes = ALONE,
    ) -> Self:
        """Learn the local models by expectation-maximisation (Algorithm 1, model training).

        Parameters
        ----------
        X : sequence of Demonstration, or iterable of such sequences
            With the same joints and frames; aligned in time, if durations differ. Batches,
            for example :class:`tpgmm_datasets.EpisodeBatches`, are read once, one ahead; only
            their local data are kept, in a temporary file.
        y : ignored
            Here for scikit-learn.
        checkpoint : Checkpoint, optional
            Where to keep the state of EM, and to go on from if there is one.
        processes : Processes, optional
            Those that learn together: what
            :func:`~tpgmm_torch.large_data.processes.joined_processes` gives;
            X is then the share of this one, and each has the whole model.

        Returns
        -------
        self

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If demonstrations do not fit together, or with the operators and the robot.
        PlausibilityError
            If they cannot be what they are taken for, see ``plausibility``.
        ModelFileError
            If the checkpoint is damaged, or of other data or settings.
        DistributedError
            If another of the processes died.
        """
        check_parameters(self)
        demonstrations, batches = split_batches(X)
        if batches is None and processes.count == 1:
            known = check_demonstrations(demonstrations)
            segmentation, cuts = self._cuts(known)
            if cuts and (checkpoint is not None or self.warm_start):
                raise DataError(
                    "parts are learned one after the other: there is no one state of EM for "
                    "a checkpoint or warm_start to go on from; partial_fit goes on with them"
                )
            given, of_parts, selections = self._operators(known, cuts)
            operators = given
            kinematics = self._kinematics_for(known, operators)
            # which of them are unlike the others is seen about their mean, too
            based = with_mean_orientations(operators, known, kinematics)
            weights, shown, found = self._examined(known, based, kinematics)
            known = [each for each, weight in zip(known, weights, strict=True) if weight > 0]
            holds = (
                holds_for(self.holds, known, operators, kinematics) if found is None else found
            )
            operators = with_mean_orientations(operators, known, kinematics, holds)
            gathered = rows_in_memory(
                known,
                operators,
                kinematics,
                responsibilities=self.responsibilities,
                holds=holds,
            )
            begin, end = float(gathered.time[0]), float(gathered.time[-1])
            pairs = list(zip(leaves(given), leaves(operators), strict=True))
            parts = [
                Part(
                    first, last, reason,
                    tuple(done for one, done in pairs if one in own or not one.links()), 0,
                )
                for (first, reason), (last, _), own in zip(
                    [(begin, "the beginning"), *cuts], [*cuts, (end, "the end")], of_parts,
                    strict=True,
                )
            ]  # fmt: skip
            if cuts:
                components = self._learn_parts(
                    known, gathered, operators, kinematics, holds, parts
                )
            else:
                components = self._components(known, gathered, operators, kinematics, holds)
                number = None if components is None else components.n_components_
                self._learn(gathered, operators, kinematics, checkpoint, holds, number)
            if self.operator_weights == "held-out":
                self._weigh(self._held_out(known, given, kinematics, holds))
            self.summary_, self.demonstration_weights_ = shown, weights
            self.segmentation_, self.component_selection_ = segmentation, components
            self.operator_selection_ = selections
            self._kept = KeptRows.of(
                gathered, list(map(len, known)), weights.nonzero()[:, 0].tolist()
            )
            peaks = demonstrated_peaks(known, kinematics.joint_names)
            return self._set_peaks(*peaks)
        if self.selects:
            raise DataError(
                'operator_weights="held-out", parts, operators="auto" and n_components="auto" '
                "compare all demonstrations with each other, which those in batches or in "
                "several processes are not: fit a model to some of them, and give its "
                "operators_ and n_components_"
            )
        operators = check_operators(self.operators)
        walk = checked_batches([demonstrations] if batches is None else batches)
        head = next(walk, None)
        check_shares(head, processes)
        assert head is not None
        kinematics = self._kinematics_for(head, operators)
        # the first batch of all says it for those that have not been read yet
        holds = processes.gather(holds_for(self.holds, head, operators, kinematics))[0]
        based = with_mean_orientations(operators, head, kinematics, holds)
        operators = processes.gather(based)[0]
        seen = DemonstratedPeaks(kinematics.joint_names)
        episodes: list[EpisodeSummary] = []
        outlying: list[Outlying] = []

        def remember(batches: Iterable[Sequence[Demonstration]]) -> Iterator[Any]:
            for batch in batches:
                episodes.extend(summarize(batch, kinematics))
                yield batch

        def leave_out(data: Tensor, time: Tensor) -> set[int]:
            outlying.extend(outlying_rows(data, time, operators, kinematics))
            return {one.episode for one in outlying}

        with RowFile() as file:
            gathered = gather_rows(
                remember(seen.watch(chain([head], walk))),
                operators, kinematics, file, processes,
                responsibilities=self.responsibilities, holds=holds,
                leave_out=leave_out if self.robust else None,
            )  # fmt: skip
            everyone = list(chain.from_iterable(processes.gather(episodes)))
            examined = self._examine(
                everyone, outlying, operators, kinematics, holds, processes.rank
            )
            self._learn(gathered, operators, kinematics, checkpoint, holds)
            self.summary_, self.demonstration_weights_ = examined
        return self._set_peaks(*seen.result(processes))

    def partial_fit(
        self,
        X: Iterable[Demonstration] = (),
        y: object = None,
        *,
        forget: int | Sequence[int] = 0,
    ) -> Self:
        """Go on learning, with more demonstrations or with fewer.

        EM goes on from where it was, with the local data of the demonstrations of before,
        which the model keeps, and of those: the result is what ``fit`` of all of them gives
        with ``warm_start=True, robust=False`` and the holds of now, to rounding, unless as
        many are forgotten as are new. With new ones, and more coordinates than demonstrations
        before, EM begins from the shrunken covariances, from which they are not infinitely far:
        then the skill may change elsewhere, too. With one component it is that of any fit. No
        demonstration is left out for being unlike the others: corrections are.

        Parameters
        ----------
        X : iterable of Demonstration
            In the time of the skill, that of ``time_``; of segments of it, only what they show
            counts. :func:`tpgmm_torch.corrections.in_skill_time` brings others there.
        y : ignored
            Here for scikit-learn.
        forget : int or sequence of int, default=0
            How many of the oldest demonstrations not to learn from any longer, or which, as
            they are counted in ``demonstration_weights_``.

        Returns
        -------
        self

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If demonstrations are of another robot, or not in the time of the skill, if none is
            left, or if those of before were not kept: they were read in batches, or not saved
            with the model, ``save(path, demonstrations=True)``.
        PlausibilityError
            If they cannot be what they are taken for.
        """
        self._check_fitted()
        kept, weights = self._kept, self.demonstration_weights_
        if kept is None or weights is None or self.summary_ is None:
            raise DataError(
                "the model does not have the demonstrations that it was learned from: fit it "
                "in one process, without batches, and save it with demonstrations=True "
                "(tpgmm fit --keep-demonstrations)"
            )
        operators, kinematics = self.operators_, self.kinematics_
        shown = list(X)
        added = check_demonstrations(shown) if shown else []
        peaks = None
        if self.acceleration_ is not None and self.jerk_ is not None:
            peaks = self.acceleration_, self.jerk_
        seen, via, weights = self.summary_, (self.via_points_, self.via_fade_), weights.clone()
        begun, counted = len(weights), self.operator_weights_
        if added:
            for operator in operators:
                operator.check(kinematics, added[0].frames)
            episodes = summarize(added, kinematics)
            Report.of(unit_findings(episodes, kinematics), "the demonstrations").act(
                self.plausibility
            )
            seen = replace(seen, n_demonstrations=seen.n_demonstrations + len(episodes))
            placed = [
                on_grid(d, self.time_, kinematics) if kept.n_instants else (d, 0) for d in added
            ]
            added = [one for one, _ in placed]
            expected = self.regression().expected
            rows = local_data(added, operators, kinematics, expected, self.holds_)
            arrays = [row.cpu().numpy() for row in rows]
            kept = kept.and_also(arrays, [first for _, first in placed], begun)
            weights = torch.cat((weights, weights.new_ones(len(added))))
            if peaks is not None and min(map(len, added)) > 3:
                more = demonstrated_peaks(added, kinematics.joint_names)
                like = peaks[0]
                peaks = (
                    torch.maximum(peaks[0], more[0].to(like)),
                    torch.maximum(peaks[1], more[1].to(like)),
                )
        forgotten = self._forgotten(forget, weights)
        weights[forgotten] = 0.0
        kept = kept.without(forgotten)
        self._learn_again(kept, unseen=bool(added))
        if counted is not None:
            self._weigh(counted)
        self.summary_, self.demonstration_weights_, self._kept = seen, weights, kept
        self.via_points_, self.via_fade_ = via
        operators = (*operators, *(point.operator for point in self.via_points_))
        self.frame_names_ = frame_names(operators, kinematics)
        return self if peaks is None else self._set_peaks(*peaks)

    @staticmethod
    def _forgotten(forget: int | Sequence[int], weights: Tensor) -> list[int]:
        """The numbers of demonstrations that are not to be learned from any longer."""
        there = weights.nonzero()[:, 0].tolist()
        if isinstance(forget, int):
            if not 0 <= forget < len(there):
                raise DataError(f"forget is from 0 to {len(there) - 1} here, got {forget}")
            return list(there[:forget])
        if strangers := sorted(set(forget) - set(there)):
            raise DataError(
                f"there are no demonstrations {strangers} to forget; learned from are {there}"
            )
        return list(forget)

    def _learn_again(self, kept: KeptRows, unseen: bool) -> None:
        """EM from where it was, on rows that were kept, of which some may be new to it."""
        operators, kinematics, parts = self.operators_, self.kinematics_, self.parts_
        widths = block_widths(operators, kinematics)
        turns = [bool(operator.rotation_vector_starts(kinematics)) for operator in operators]
        table, members, group_size = kept.table(widths, turns, self.time_)
        whole = column_moments(StoredRows(table[members]))
        belongs = part_of(parts, table[:, 0])
        mixtures, counts, first = [], [], 0
        for number in range(max(len(parts), 1)):
            k = parts[number].n_components if parts else self.n_components_
            own = belongs == number
            shares = float(members[own].sum() * len(kept.rows) / own.sum())
            mixture = self.unfitted_mixture(
                whole, 1, operators, kinematics, shares, k,
                go_on=slice(first, first + k), whole=whole if parts else None, unseen=unseen,
            )  # fmt: skip
            fit_subsets([mixture], table[own], members[own][None], group_size)
            mixtures.append(mixture)
            counts.append(int(members[own].sum()))
            first += k
        mixture = mixtures[0]
        if parts:
            variances = self._variances(whole, operators, kinematics)
            mixture = chained(mixtures, parts, counts, operators, kinematics, variances)
        self.set_mixture(mixture, operators, kinematics, self.time_, self.holds_)
        self.parts_ = parts

    def predict(
        self, X: Situation | Sequence[Situation], *, candidates: bool = True
    ) -> list[Trajectory]:
        """Reproduce the skill: closed kinematic loop, q_{t-1} is the last reference.

        Times beyond the skill's beginning or end, the first and last of ``time_``, are held:
        nothing is extrapolated.

        Parameters
        ----------
        X : sequence of Situation or Demonstration
            Situations of equal time grids run as one batch. A demonstration stands for the
            situation that it was made in, :meth:`Situation.of`: its start and its frames, but
            not its time.
        candidates : bool, default=True
            Whether to return each operator's own estimate too.

        Returns
        -------
        list of Trajectory

        Raises
        ------
        DataError, ShapeError, UnknownNameError, NotFittedError
            If a situation does not fit the model.
        """
        self._check_fitted()
        if not isinstance(X, Situation | Demonstration | Iterable):
            raise DataError(f"predict takes a list of Situation, got {type(X).__name__}")
        given = [X] if isinstance(X, Situation | Demonstration) else list(X)
        situations = [self._situation(item) for item in given]
        bounds = self.motion_bounds() if self.keep_limits and self._limited else None
        if situations:
            firsts = [_first(situation) for situation in situations]
            check_situations(
                torch.stack([situation.joints for situation in situations]),
                {
                    name: Frame.stack([first[name] for first in firsts])
                    for name, frame in firsts[0].items()
                },
                torch.stack([one.time[[0, -1]] for one in situations if one.time is not None]),
                self.kinematics_,
                self.time_,
                self.summary_,
            ).act(self.plausibility)
        skill: Any = self._running()
        trajectories = rollout(
            skill, situations, bounds=bounds, blend=self.blend, candidates=candidates
        )
        if self.via_points_:
            self._missed(skill.conditioning, situations, trajectories).act(self.plausibility)
        if self.summary_ is None:
            return trajectories
        summary = self.summary_
        return [
            replace(one, novelty=float(summary.novelty(situation.joints, _first(situation))))
            for one, situation in zip(trajectories, situations, strict=True)
        ]

    def step(
        self,
        time: float | Tensor,
        state: RobotState | Any,
        frames: Mapping[str, Frame] | None = None,
        *,
        candidates: bool = False,
    ) -> Estimate:
        """One control tick for a batch of robots: the model's raw map.

        It has no memory, and does at any time what the mixture says: beyond the skill's end
        that is an extrapolation, and nothing but the limits of position bounds a step from
        where the robot is. :meth:`controller` is what runs a skill.

        Parameters
        ----------
        time : float or Tensor of the batch shape
            Now [s].
        state : RobotState, array-like of shape (..., n_joints), or mapping of str to array-like
            The last reference q_{t-1}, or what was measured; joints may go by name.
        frames : mapping of str to Frame
            Object poses now, of shapes that broadcast with the batch.
        candidates : bool, default=False
            Whether to return each operator's own estimate too.

        Returns
        -------
        Estimate

        Examples
        --------
        >>> from tpgmm_torch import TaskParameterizedGMM
        >>> time = torch.linspace(0, 1, 50, dtype=torch.float64)
        >>> shown = [Demonstration(time, (time * end)[:, None]) for end in (0.9, 1.0, 1.1)]
        >>> model = TaskParameterizedGMM(n_components=2).fit(shown)
        >>> estimate = model.step(0.5, [0.4])
        >>> round(float(estimate.joints), 2)
        0.5
        """
        self._check_fitted()
        if self.via_points_:
            raise DataError(
                "a step has no memory, and cannot tell how far via-points have moved the "
                "robot: use controller()"
            )
        kinematics, regression = self.kinematics_, self.regression()
        like = kinematics.lower
        known = {name: frame.to(like) for name, frame in (frames or {}).items()}
        now = as_tensor(time, "time").to(like)
        if self._untried:  # wrong units are there from the first tick on: others cost nothing
            self._untried = False
            joints = state.joints if isinstance(state, RobotState) else state
            self._examine_tick(now, joints, known)
        limits = (like, kinematics.upper) if self.keep_limits else None
        if not candidates and not isinstance(state, RobotState):
            joints = state if isinstance(state, Tensor) else kinematics.joint_tensor(state)
            return regression.estimate(now, joints, known, limits)
        if not isinstance(state, RobotState):
            state = kinematics.state(state)
        return regression.step(now, state, known, candidates, limits)

    def controller(
        self,
        joints: Any,
        frames: Mapping[str, Frame] | None = None,
        *,
        clock: Clock | str = "localizing",
        trust: Trust | None = Trust(),  # noqa: B008  (frozen)
        smoothing: OneEuro | None = OneEuro(),  # noqa: B008  (frozen)
        bounds: MotionBounds | Mapping[str, Any] | None = None,
        feedback: str = "reference",
        impedance: Impedance | None = None,
    ) -> Controller:
        """The skill, to be run tick by tick.

        Parameters
        ----------
        joints : array-like of shape (..., n_joints)
            Start postures.
        frames : mapping of str to Frame, optional
            Object poses, of shapes that broadcast with the batch; a step may be given others.
        clock : Clock or str, default="localizing"
            How time goes on; text is for :func:`parse_clock`. Without measured joints, every
            clock runs evenly.
        trust : Trust, optional
            When to believe what the steps are told; None believes everything.
        smoothing : OneEuro, optional
            What takes the noise from poses that steps are told; None leaves them as they are.
        bounds : MotionBounds or mapping, optional
            Of position, speed, acceleration and jerk, or those that are tighter than
            :meth:`motion_bounds` has them; with ``keep_limits=False`` there are none.
        feedback : {"reference", "measured"}
            What q_{t-1} is.
        impedance : Impedance, optional
            What stiffness and damping are made with; by default ``Impedance(robot)``.

        Returns
        -------
        Controller
            Its ``step(dt)`` finds the next command.

        Raises
        ------
        ShapeError, DataError, NotFittedError, UnknownNameError
            If the postures do not fit the robot, frames are missing, or bounds contradict
            each other. Nothing moves.
        """
        self._check_fitted()
        frames = self._completed(joints, frames or {})
        for operator in self.operators_:
            operator.check(self.kinematics_, frames)
        known: Any = bounds
        if not self.keep_limits:
            known = None
        elif bounds is None:
            known = "robot"
        self._examine_tick(self.time_[0], joints, frames)
        return Controller(
            self._running(),
            joints,
            frames,
            clock=clock,
            blend=self.blend,
            bounds=known,
            trust=trust,
            smoothing=smoothing,
            feedback=feedback,
            impedance=impedance,
        )

    def with_via_points(self, points: Iterable[ViaPoint | str], fade: float = 1.0) -> Self:
        """The model, conditioned on via-points: nothing is learned anew.

        :meth:`predict`, :meth:`controller` and :meth:`sample` pass through them; further than
        ``fade`` from their times the skill is what it was. See
        :mod:`tpgmm_torch.regression.conditioning`.

        Parameters
        ----------
        points : iterable of ViaPoint or str
            All that count; those that the model had are replaced, and none are left by ``[]``.
            Text is for :meth:`ViaPoint.parse`. Frames that the model does not know have to be
            in the situations then.
        fade : float, default=1.0
            For how long before and after a via-point the skill is another [s].

        Returns
        -------
        TaskParameterizedGMM
            Another one, which shares what was learned.

        Raises
        ------
        DataError, ShapeError, UnknownNameError, NotFittedError
            If a via-point is not of this robot, or not within the time of the skill.

        Examples
        --------
        >>> time = np.linspace(0, 2, 50)
        >>> shown = [Demonstration(time, (time * end)[:, None]) for end in (0.9, 1.0, 1.1)]
        >>> model = TaskParameterizedGMM(n_components=2, blend=0).fit(shown)
        >>> other = model.with_via_points([ViaPoint(1.0, "canonical", [1.3])], fade=0.5)
        >>> [trajectory] = other.predict([Situation(joints=[0.0], time=[0.0, 1.0, 2.0])])
        >>> [round(q, 2) for q in trajectory.joints[:, 0].tolist()]
        [0.0, 1.3, 2.0]
        """
        self._check_fitted()
        given = [ViaPoint.parse(p) if isinstance(p, str) else p for p in points]
        begin, end = float(self.time_[0]), float(self.time_[-1])
        for point in given:
            if not isinstance(point, ViaPoint):
                raise DataError(f"via-points are ViaPoint objects, got {type(point).__name__}")
            if not begin <= point.time <= end:
                raise DataError(
                    f"the via-point {point} is at {point.time:g} s, but the skill lasts from "
                    f"{begin:g} to {end:g} s"
                )
            references = point.operator.references()
            point.operator.check(self.kinematics_, references)
            if strangers := set(point.operator.links()) - set(self.kinematics_.links):
                name, links = strangers.pop(), self.kinematics_.links
                raise UnknownNameError("link", name, "the robot", links)
        Conditioning.of(self.regression(), given, fade)
        other = copy.copy(self)
        other.via_points_, other.via_fade_ = tuple(given), float(fade)
        operators = [*self.operators_, *(point.operator for point in given)]
        other.frame_names_ = frame_names(operators, self.kinematics_)
        return other

    def _missed(
        self,
        via: Conditioning,
        situations: Sequence[Situation],
        trajectories: Sequence[Trajectory],
    ) -> Report:
        """Which trajectories do not pass through the via-points."""
        findings = [
            Finding(
                "via-points",
                f"situation {n}: {point} is missed by {miss:.3g} m or rad",
                "Can the robot reach it, in so short a time? A longer fade asks for less "
                "speed, and keep_limits=False for what no robot has to follow",
                episodes=(n,),
                value=miss,
            )
            for n, (there, done) in enumerate(zip(situations, trajectories, strict=True))
            for point, miss in via.missed(done.time, done.joints, there.frames)
            if not self.holds_  # a frame that is held is not where the situation has it
        ]
        return Report.of(findings, f"{len(situations)} situations with via-points")

    def _running(self) -> Any:
        """The skill that is run, with via-points if there are some."""
        if not self.via_points_:
            return self.regression()
        return ViaPoints(self.regression(), self.via_points_, self.via_fade_)

    def sample(
        self,
        situation: Situation,
        n_samples: int = 1,
        random_state: int | np.random.RandomState | None = None,
    ) -> list[Trajectory]:
        """Draw joint trajectories around the reproduction.

        Each trajectory keeps one standard normal draw z over time, ``q_t = q_hat_t + L_t z``
        with ``L_t L_t^T`` the covariance at t: at every instant its law is the reproduction's,
        and in between it is as smooth as the model.

        Parameters
        ----------
        situation : Situation
        n_samples : int, default=1
        random_state : int, RandomState instance or None

        Returns
        -------
        list of Trajectory

        Raises
        ------
        DataError
            If ``n_samples`` is no positive integer, and as :meth:`predict` does.
        """
        if not isinstance(n_samples, Integral) or n_samples < 1:
            raise DataError(f"n_samples must be an integer of at least 1, got {n_samples!r}")
        [mean] = self.predict([situation], candidates=False)
        draws = check_random_state(random_state).standard_normal(
            (n_samples, mean.joints.shape[-1])
        )
        factor = gaussians.cholesky(mean.covariance, "the covariance of the reproduction")
        return [
            Trajectory(
                mean.time,
                self.kinematics_.retract(mean.joints + factor @ torch.from_numpy(z).to(factor)),
                mean.covariance,
                (),
                mean.joint_names,
                mean.novelty,
            )
            for z in draws
        ]

    def score(self, X: Sequence[Demonstration], y: object = None) -> float:
        """Mean log-likelihood per time step of (new) demonstrations; higher is better.

        The density is that of time and of all operators' local coordinates,
        ``sum_i pi_i N(t | i) prod_j p(X_t^(j) | t, i)``. N demonstrations tell means and
        covariances up to so much only: p is the predictive density of one more, Student's t
        with N - 1 degrees of freedom, which is wider than the normal law and becomes it with
        N. With ``covariance_shrinkage=0``, as in the paper, and where the model does not know
        its demonstrations, p is the normal law. Time counts once, however many
        operators there are, so that under the normal law it makes no difference whether
        independent coordinates come in one operator or in several. Models that look at
        *other* coordinates describe other data, in other units, and are not comparable: use
        :class:`tpgmm_torch.metrics.PoseScorer` for those.

        Unlike ``lower_bound_``, :meth:`bic` and :meth:`aic`, which are EM's and count time
        once for each operator.
        """
        lengths = [len(demonstration) for demonstration in check_demonstrations(X)]
        return float(np.average(self.score_samples(X), weights=lengths))

    def score_samples(self, X: Sequence[Demonstration]) -> NDArray[np.float64]:
        """Mean log-likelihood per time step of each demonstration, (n,); see :meth:`score`."""
        return np.array([float(density.mean()) for _, _, density in self._densities(X)])

    def surprise(self, X: Sequence[Demonstration]) -> list[Tensor]:
        """How much less likely demonstrations are than what is expected, instant by instant.

        Parameters
        ----------
        X : sequence of Demonstration
            Or motions of which it is asked whether they are the skill.

        Returns
        -------
        list of Tensor of shape (T,)
            Difference of the log-densities of :meth:`score` [nats].
        """
        regression, count = self.regression(), len(self.operators_)
        return [
            regression.log_density(
                time, [regression.expected(j, time) for j in range(count)], n
            )
            - density
            for time, n, density in self._densities(X)
        ]

    def _densities(
        self, X: Sequence[Demonstration]
    ) -> Iterator[tuple[Tensor, float | None, Tensor]]:
        """Times (T,), number of samples and log-densities (T,) of each demonstration."""
        rows, regression = self._rows(X), self.regression()
        n_samples = None
        if self.summary_ is not None and self.covariance_shrinkage != 0:
            n_samples = self.summary_.n_demonstrations
        widths = block_widths(self.operators_, self.kinematics_)
        for row in rows:
            blocks = torch.from_numpy(row).to(self.means_[0]).split(list(widths), 1)
            time, local = blocks[0][:, 0], [block[:, 1:] for block in blocks]
            yield time, n_samples, regression.log_density(time, local, n_samples)

    def bic(self, X: Sequence[Demonstration]) -> float:
        """Bayesian information criterion on demonstrations; lower is better."""
        rows = np.concatenate(self._rows(X))
        return float(self.mixture_.bic(rows))

    def aic(self, X: Sequence[Demonstration]) -> float:
        """Akaike information criterion on demonstrations; lower is better."""
        rows = np.concatenate(self._rows(X))
        return float(self.mixture_.aic(rows))

    def regression(self) -> Regression:
        """The fitted mixture conditioned on time, prepared once: what every tick asks."""
        self._check_fitted()
        shown = None if self.summary_ is None else self.summary_.n_demonstrations
        n_samples = fused_samples(self.covariance_shrinkage, shown)
        limited = self.keep_limits and self._limited
        key = (
            n_samples,
            limited,
            tuple(self.holds_),
            self.fusion,
            self.activation,
            self.epsilon,
            self.negligible,
            repr(self.priorities),
            self.prior_std if isinstance(self.prior_std, Real) else repr(self.prior_std),
        )
        prepared = getattr(self, "_prepared", None)
        if prepared is None or prepared[0] != key or prepared[1] is not self.means_:
            conditionals = [
                Conditionals.of(mean, covariance)
                for mean, covariance in zip(self.means_, self.covariances_, strict=True)
            ]
            log_weights = self.weights_.log()
            fitted = self.kinematics_, self.operators_, conditionals, log_weights
            mixture = self.weights_, self.means_, self.covariances_
            regression = Regression(
                *fitted,
                fusion=self.fusion,
                activation=self.activation,
                epsilon=self.epsilon,
                prior_std=prior_widths(
                    self.prior_std, self.kinematics_, self.operators_, *mixture
                ),
                negligible=self.negligible,
                priorities=self._checked_priorities(
                    self.operators_, self.kinematics_, self.parts_
                ),
                n_samples=n_samples,
                begin=float(self.time_[0]),
                end=float(self.time_[-1]),
                holds=tuple(self.holds_),
                motion_bounds=self.motion_bounds() if limited else None,
                peaks=None
                if self.jerk_ is None
                else (as_tensor(self.acceleration_, "peaks"), self.jerk_),
                summary=self.summary_,
            )
            self._prepared = prepared = (key, self.means_, regression)
        return prepared[2]

    def unfitted_mixture(
        self,
        moments: ColumnMoments,
        group_size: int,
        operators: Sequence[Operator],
        kinematics: Kinematics,
        n_demonstrations: float,
        n_components: int | None = None,
        *,
        go_on: slice | None = None,
        whole: ColumnMoments | None = None,
        unseen: bool = False,
    ) -> BlockGaussianMixture:
        """The mixture that :meth:`fit` learns from rows of local data.

        Parameters
        ----------
        moments : ColumnMoments
            Of the rows, which set the scale of the regularisation.
        group_size : int
            So many consecutive rows share one responsibility.
        operators : sequence of Operator
        kinematics : Kinematics
            What they act on.
        n_demonstrations : float
            That the rows are of; segments are shares of one.
        n_components : int, optional
            By default that of the model.
        go_on : slice, optional
            With which components EM is to begin where it ended, as it does with
            ``warm_start``.
        whole : ColumnMoments, optional
            Of the rows of all parts, where these are those of one.
        unseen : bool, default=False
            Whether EM has not seen some of the rows; it has not, if there are more
            demonstrations than before.
        """
        settings = self._shared_settings(operators, kinematics, n_components)
        settings |= {"group_size": group_size, "n_demonstrations": n_demonstrations}
        known = moments if whole is None else whole
        settings |= self._regularized(known, operators, kinematics, whole is not None)
        if (go_on is not None or self.warm_start) and hasattr(self, "mixture_"):
            before, chosen = self.mixture_, go_on or slice(None)
            weights = before.weights_[chosen]
            settings["weights_init"] = weights if whole is None else weights / weights.sum()
            settings["means_init"] = [mean[chosen] for mean in before.means_]
            # of fewer demonstrations than coordinates they are flat: one more lies infinitely
            # far from all of them, and chance would decide which components keep their data
            shown = before.n_demonstrations or 0.0
            unseen = unseen or n_demonstrations > shown
            flat = shown <= sum(mean.shape[-1] for mean in before.means_)
            covariances = (
                before.covariances_ if unseen and flat else before.unshrunk_covariances
            )
            settings["covariances_init"] = [c[chosen] for c in covariances]
        return BlockGaussianMixture(**settings)

    def _regularized(
        self,
        moments: ColumnMoments,
        operators: Sequence[Operator],
        kinematics: Kinematics,
        absolute: bool,
    ) -> dict[str, Any]:
        """The mixture's settings of regularisation, relative to the variances of these rows.

        ``absolute``, in the units of the data: what is learned from a part of them is held to
        the same.
        """
        amounts = regularization(
            moments,
            operators,
            kinematics,
            reg_covar=self.reg_covar,
            covariance_type=self.covariance_type,
        )
        if not absolute:
            return {"reg_covar": amounts}
        variances = torch.cat(self._variances(moments, operators, kinematics))
        return {"reg_covar": amounts * variances.numpy(), "regularization": "absolute"}

    def _variances(
        self, moments: ColumnMoments, operators: Sequence[Operator], kinematics: Kinematics
    ) -> list[Tensor]:
        """Of the columns of each operator's block, in which the mixture is learned."""
        isotropic = self.covariance_type == "spherical"
        widths = block_widths(operators, kinematics)
        return [x.square() for x in moments.standardization(widths, isotropic=isotropic).scales]

    def set_mixture(
        self,
        mixture: BlockGaussianMixture,
        operators: tuple[Operator, ...],
        kinematics: Kinematics,
        time: Tensor,
        holds: Sequence[Hold] = (),
    ) -> Self:
        """Become the fitted model of a mixture of local data.

        Parameters
        ----------
        mixture : BlockGaussianMixture
            Fitted, with one block for each operator.
        operators : tuple of Operator
        kinematics : Kinematics
            What they act on.
        time : Tensor of shape (T,)
            The time grid of a typical demonstration [s].
        holds : sequence of Hold, default=()
            Of objects by links, as ``holds_``.

        Returns
        -------
        self

        Raises
        ------
        DataError
            If operators refer to objects that may be carried, and ``fusion="covariance"``; if
            they are in tangent space, and ``activation="product"``; if ``priorities`` are not
            one per operator, or there is another fusion or activation than the default's.
        """
        carried = carried_objects(operators, kinematics)
        if carried and self.fusion == "covariance":
            raise DataError(
                f"operators refer to {list(carried)} as things that the robot may carry. Of "
                "joints that do not move these they say nothing, which fusion='covariance' "
                "would take for a wish to stand still: use fusion='information'"
            )
        tangent = [o for o in operators if o.rotation_vector_starts(kinematics)]
        if tangent and self.activation == "product":
            raise DataError(
                f"activation='product' asks how operators move with time, and the base of "
                f"{tangent} moves along: use activation='time' or geometry='quaternion'"
            )
        self._checked_priorities(operators, kinematics)
        self.mixture_, self.operators_, self.kinematics_ = mixture, operators, kinematics
        self.frame_names_, self.time_ = frame_names(operators, kinematics), time
        self.acceleration_ = self.jerk_ = None
        self.holds_ = tuple(holds)
        self.weights_, self.means_ = mixture.weights_, mixture.means_
        self.covariances_ = mixture.covariances_
        # a mixture of given parameters comes from no EM
        self.n_iter_ = getattr(mixture, "n_iter_", 0)
        self.converged_ = getattr(mixture, "converged_", False)
        self.lower_bound_ = getattr(mixture, "lower_bound_", math.nan)
        self.n_components_ = len(self.weights_)
        self.summary_ = self.demonstration_weights_ = self._kept = None
        self.operator_selection_ = self.component_selection_ = self.operator_weights_ = None
        self.parts_, self.segmentation_ = (), None
        self.via_points_, self.via_fade_ = (), 1.0
        self._untried = True
        return self

    @classmethod
    def from_parameters(
        cls,
        weights: Any,
        means: Sequence[Any],
        covariances: Sequence[Any],
        time: Any,
        *,
        operators: Sequence[Operator] | None = None,
        robot: Kinematics,
        **settings: Any,
    ) -> Self:
        """A fitted model of known parameters, which are kept as they are.

        Parameters
        ----------
        weights, means, covariances, time : array-like, or sequences of array-like
            As in the attributes of that name.
        operators : sequence of Operator, optional
        robot : Kinematics
            What the operators act on; a
            :class:`~tpgmm_torch.robots.joint_space.JointSpace` where they need no links.
        **settings
            Further parameters of the constructor; there is nothing that ``holds="auto"``
            could be found in.

        Returns
        -------
        TaskParameterizedGMM
            EM has nothing to report: ``n_iter_`` is 0, ``converged_`` False, ``lower_bound_``
            NaN.

        Raises
        ------
        DataError, ShapeError
            If they are no mixture, or do not fit the operators.
        """
        weights, time = as_tensor(weights, "weights"), as_tensor(time, "time")
        means = [as_tensor(mean, "a mean") for mean in means]
        covariances = [as_tensor(covariance, "a covariance") for covariance in covariances]
        settings = {"n_components": len(weights)} | settings
        model = cls(operators=operators, robot=robot, **settings)
        check_parameters(model)
        if not isinstance(robot, Kinematics):
            raise DataError("the model has no robot: give it a Robot, Poses or a JointSpace")
        checked = check_operators(operators)
        mixture = BlockGaussianMixture.from_parameters(
            weights, means, covariances, **model._shared_settings(checked, robot, len(weights))
        )
        # it checked them; what it keeps went through their factors, and was rounded
        mixture.weights_ = weights
        mixture.means_, mixture.covariances_ = list(means), list(covariances)
        given = model.holds if not isinstance(model.holds, str) else None
        holds = check_holds(given or (), frame_names(checked, robot), robot.links)
        kinematics = robot.to(time.dtype, model.device)
        return model.set_mixture(mixture, checked, kinematics, time, holds)

    def save(self, path: str | Path, *, demonstrations: bool = False) -> None:
        """Write the fitted model to a directory (config.json, model.safetensors), atomically.

        A ``random_state`` that is not an int is not kept: it has no meaning for a fitted model.

        Parameters
        ----------
        path : str or Path
        demonstrations : bool, default=False
            Whether to keep what :meth:`partial_fit` needs, the demonstrations' local data:
            8 bytes for each time step and coordinate.

        Raises
        ------
        NotFittedError
        ModelFileError
            If something is there that is no model, or an operator or robot cannot be described.
        """
        self._check_fitted()
        parameters = {
            name: value.tolist() if isinstance(value, np.generic | np.ndarray) else value
            for name, value in self.get_params(deep=False).items()
            if name not in ("operators", "robot")
        }
        if not isinstance(parameters["random_state"], int):
            parameters["random_state"] = None
        parameters["n_components"] = self.n_components_
        if isinstance(self.parts, Segmentation):
            parameters["parts"] = "auto"
        if not isinstance(parameters["holds"], str | None):
            parameters["holds"] = [hold.to_list() for hold in parameters["holds"]]
        config: dict[str, Any] = {
            "parameters": parameters,
            "operators": [encode(operator) for operator in self.operators_],
            "kinematics": encode(self.kinematics_),
            "frames": list(frame_names(self.operators_, self.kinematics_)),
            "holds": [hold.to_list() for hold in self.holds_],
            "n_iter": self.n_iter_,
            "converged": bool(self.converged_),
            "lower_bound": None if math.isnan(self.lower_bound_) else float(self.lower_bound_),
            "summary": None if self.summary_ is None else self.summary_.config(),
        }
        if self.operator_weights_ is not None:
            config["operator_weights"] = self.operator_weights_.tolist()
        if self.parts_:
            config["parts"] = [
                [p.begin, p.end, p.reason, list(map(encode, p.operators)), p.n_components]
                for p in self.parts_
            ]
        if self.via_points_:
            config["via_points"] = [
                [one.time, encode(one.operator), one.value, one.tolerance]
                for one in self.via_points_
            ]
            config["via_fade"] = self.via_fade_
        if self.acceleration_ is not None and self.jerk_ is not None:
            config["peaks"] = [self.acceleration_.tolist(), self.jerk_.tolist()]
        tensors = {"weights": self.weights_, "time": self.time_}
        for j, (mean, covariance) in enumerate(
            zip(self.means_, self.covariances_, strict=True)
        ):
            tensors |= {f"means.{j}": mean, f"covariances.{j}": covariance}
        if demonstrations:
            if self._kept is None or self.demonstration_weights_ is None:
                raise DataError("the model does not have its demonstrations: fit it again")
            config["kept"] = [self._kept.first, self._kept.numbers, self._kept.n_instants]
            tensors["demonstration_weights"] = self.demonstration_weights_
            for j, covariance in enumerate(self.mixture_.unshrunk_covariances):
                tensors[f"unshrunk.{j}"] = covariance
            for m, rows in enumerate(self._kept.rows):
                tensors[f"rows.{m}"] = torch.from_numpy(np.ascontiguousarray(rows))
        MODEL.write(path, config, tensors)

    @classmethod
    def load(
        cls, path: str | Path, custom: Sequence[type] = (), device: str | None = None
    ) -> Self:
        """Read a model that :meth:`save` wrote; nothing in it is executed.

        Parameters
        ----------
        path : str or Path
        custom : sequence of type
            User-defined operator and robot classes that the model uses.
        device : str, optional
            Where tensors shall live; the default is where they lived when it was saved.

        Raises
        ------
        ModelFileError
            If it is truncated, tampered with, of another version, or does not fit together,
            or its device is not there.
        """
        if (Path(path) / MODES).is_dir():
            raise ModelFileError(
                f"{path} holds a model of several ways: read it by "
                "MultimodalTaskParameterizedGMM.load, or one of its modes alone, "
                f"{Path(path) / 'mode_0'}"
            )
        config, tensors = MODEL.read(path)
        try:
            operators = [decode(item, custom) for item in config["operators"]]
            kinematics = decode(config["kinematics"], custom)
            for operator in operators:
                operator.check(kinematics, config["frames"])
            kept = config.get("kept")
            more = 0 if kept is None else 1 + len(operators) + len(kept[0])
            if len(tensors) != 2 + 2 * len(operators) + more or not operators:
                raise ModelFileError(
                    f"{path} does not fit together: {len(operators)} operators, but the "
                    f"tensors {sorted(tensors)}"
                )
            settings = config["parameters"]
            settings["device"] = device or settings["device"]
            settings.setdefault("covariance_shrinkage", 0.0)  # models of before know none,
            holds = settings.pop("holds", "auto")  # nor holds
            given = holds if isinstance(holds, str | None) else list(map(Hold.from_list, holds))
            here = _moved(tensors, settings["device"], path)
            means, covariances = (
                [here[f"{kind}.{j}"] for j in range(len(operators))]
                for kind in ("means", "covariances")
            )
            model = cls.from_parameters(
                here["weights"],
                means,
                covariances,
                here["time"],
                operators=operators,
                robot=kinematics,
                holds=list(map(Hold.from_list, config.get("holds", []))),
                **settings,
            )
            model.holds = given
            model.robot = None if isinstance(kinematics, JointSpace) else kinematics
            model.n_iter_, model.converged_ = config["n_iter"], config["converged"]
            model.parts_ = tuple(
                Part(begin, end, reason, tuple(decode(one, custom) for one in own), number)
                for begin, end, reason, own, number in config.get("parts", ())
            )
            known = config["lower_bound"] is not None
            model.lower_bound_ = config["lower_bound"] if known else math.nan
            if "peaks" in config:
                acceleration, jerk = (as_tensor(x, "peaks") for x in config["peaks"])
                model._set_peaks(acceleration, jerk)
            if config.get("operator_weights") is not None:
                counted = as_tensor(config["operator_weights"], "operator_weights")
                model.operator_weights_ = counted.to(model.weights_)
            if config.get("summary") is not None:
                model.summary_ = TrainingSummary.from_config(
                    config["summary"], model.kinematics_
                )
            if kept is not None:
                first, numbers, n_instants = kept
                rows = tuple(tensors[f"rows.{m}"].numpy() for m in range(len(first)))
                model._kept = KeptRows(rows, tuple(first), tuple(numbers), n_instants)
                model.demonstration_weights_ = tensors["demonstration_weights"]
                unshrunk = [here[f"unshrunk.{j}"] for j in range(len(operators))]
                model.mixture_.unshrunk_covariances = unshrunk
            if via := config.get("via_points"):
                model = model.with_via_points(
                    [
                        ViaPoint(time, decode(one, custom), _via_value(value), tolerance)
                        for time, one, value, tolerance in via
                    ],
                    config["via_fade"],
                )
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
            if isinstance(error, ModelFileError):
                raise
            raise ModelFileError(f"{path} does not fit together: {error}") from error
        return model

    def motion_bounds(self, **given: Any) -> MotionBounds:
        """Bounds on speed, acceleration and jerk of the model's robot.

        Parameters
        ----------
        **given : float, array-like of shape (n_joints,) or mapping of str to float
            The user's, see :meth:`MotionBounds.of`. What neither the robot nor the user
            bounds follows from the demonstrations.

        Raises
        ------
        DataError, ShapeError, UnknownNameError, NotFittedError
            If bounds contradict each other, or there is no model.
        """
        self._check_fitted()
        peaks = None
        if self.acceleration_ is not None and self.jerk_ is not None:
            peaks = self.acceleration_, self.jerk_
        return MotionBounds.of(self.kinematics_, peaks, **given)

    @property
    def _limited(self) -> bool:
        """What has no limit of speed is no robot that could be asked too much."""
        return bool(self.kinematics_.velocity.isfinite().any())

    def _set_peaks(self, acceleration: Tensor, jerk: Tensor) -> Self:
        like = self.kinematics_.lower
        for peaks in (acceleration, jerk):
            if peaks.shape != like.shape or not bool((peaks >= 0).all()):
                raise DataError(f"peaks of {len(like)} joints are no negative numbers: {peaks}")
        self.acceleration_, self.jerk_ = acceleration.to(like), jerk.to(like)
        return self

    def _learn(
        self,
        learning: LearningRows,
        operators: tuple[Operator, ...],
        kinematics: Kinematics,
        checkpoint: Checkpoint | None,
        holds: Sequence[Hold],
        n_components: int | None = None,
    ) -> Self:
        """Fit the mixture to rows, and take over what it learned."""
        moments = column_moments(learning.rows, learning.processes)
        group_size, count = learning.group_size, learning.n_demonstrations
        mixture = self.unfitted_mixture(
            moments, group_size, operators, kinematics, count, n_components
        )
        mixture.fit_rows(
            learning.rows,
            moments=moments,
            checkpoint=checkpoint,
            processes=learning.processes,
        )
        return self.set_mixture(mixture, operators, kinematics, learning.time, holds)

    def _checked_priorities(
        self, operators: Sequence[Operator], kinematics: Kinematics, parts: Sequence[Part] = ()
    ) -> list[int] | None:
        """One per operator; they ask for the default fusion and activation.

        What is fulfilled strictly is so at all times, and so it has to matter in all ``parts``.
        """
        if self.priorities is None:
            return None
        given = list(self.priorities)
        if len(given) != len(operators) or not all(isinstance(p, Integral) for p in given):
            raise DataError(
                f"priorities are whole numbers, one for each of the {len(operators)} operators "
                f"{list(operators)}; got {given}"
            )
        if self.fusion != "information" or self.activation != "time":
            raise DataError(
                "priorities need fusion='information' and activation='time', which have no "
                f"regulariser that they would drown in; got {self.fusion!r}, "
                f"{self.activation!r}"
            )
        strict = [one for one, p in zip(operators, given, strict=True) if p > min(given)]
        for number, part in enumerate(parts, start=1):
            for operator in strict:
                if not matters(part, operator, kinematics).all():
                    raise DataError(
                        f"what has priority is fulfilled strictly at all times, but not all of "
                        f"{operator} matters in part {number}, from {part.begin:.4g} to "
                        f"{part.end:.4g} s: name it in every part, or give it the priority "
                        f"{min(given)}"
                    )
        return list(map(int, given))

    def _held_out(
        self,
        demonstrations: Sequence[Demonstration],
        given: Sequence[Operator],
        kinematics: Kinematics,
        holds: Sequence[Hold],
    ) -> Tensor:
        """Weights (K, J) of the ``given`` operators, found in what is shown of each part.

        Where an operator does not matter it says next to nothing already: its weight is one.
        """
        parts = self.parts_ or (Part(0, 0, "", leaves(self.operators_), self.n_components_),)
        shown, found, first = stretches(demonstrations, parts, kinematics.lower), [], 0
        for part, stretch in zip(parts, shown, strict=True):
            own = slice(first, first + part.n_components)
            first += part.n_components
            mattering: dict[int, Operator] = {}
            for j, pair in enumerate(zip(given, self.operators_, strict=True)):
                members = list(zip(*map(leaves, ([one] for one in pair)), strict=True))
                kept = [one for one, done in members if done in part.operators]
                if kept:
                    whole = len(kept) == len(members)
                    mattering[j] = pair[0] if whole else Stack(*kept) if kept[1:] else kept[0]
            time, variance = self.means_[0][own, 0], self.covariances_[0][own, 0, 0]
            marginals = TimeMarginals.of(self.weights_[own].log(), time, variance)
            weights = held_out_weights(
                stretch, list(mattering.values()), kinematics, marginals, holds
            )
            rows = weights.new_ones(len(weights), len(given))
            rows[:, list(mattering)] = weights
            found.append(rows)
        return torch.cat(found)

    def _weigh(self, weights: Tensor) -> None:
        """Let operators count for weights (K, J) only."""
        pairs = zip(self.covariances_, weights.to(self.weights_).unbind(-1), strict=True)
        self.covariances_ = [weighted(covariances, one) for covariances, one in pairs]
        self.mixture_.covariances_, self.operator_weights_ = self.covariances_, weights

    def _components(
        self,
        demonstrations: Sequence[Demonstration],
        learning: LearningRows,
        operators: tuple[Operator, ...],
        kinematics: Kinematics,
        holds: Sequence[Hold],
        whole: ColumnMoments | None = None,
    ) -> ComponentSelection | None:
        """Find the number of components, where none is given."""
        if isinstance(self.n_components, Integral):
            return None
        own = isinstance(self.n_components, ComponentSelection)
        selection = clone(self.n_components) if own else ComponentSelection()
        fold = clone(self).set_params(warm_start=False)

        def make(
            number: int, moments: ColumnMoments, size: int, n: int
        ) -> BlockGaussianMixture:
            return fold.unfitted_mixture(
                moments, size, operators, kinematics, n, number, whole=whole
            )

        def condition(mixture: BlockGaussianMixture) -> Regression:
            fold.set_mixture(mixture, operators, kinematics, learning.time, holds)
            return fold.regression()

        return selection.choose(demonstrations, learning, make, condition, holds)

    def _learn_parts(
        self,
        demonstrations: Sequence[Demonstration],
        learning: LearningRows,
        operators: tuple[Operator, ...],
        kinematics: Kinematics,
        holds: Sequence[Hold],
        parts: Sequence[Part],
    ) -> tuple[ComponentSelection, ...] | None:
        """Fit a mixture to the rows of each part, and chain them."""
        self._checked_priorities(operators, kinematics, parts)
        [rows] = learning.rows
        whole, time = ColumnMoments.of(rows), as_array(learning.time)
        belongs, instants = part_of(parts, rows[:, 0]), part_of(parts, time)
        selections: list[ComponentSelection | None] = []
        numbers = [0] * len(parts)
        lasting = np.bincount(instants, minlength=len(parts)).tolist()
        if isinstance(self.n_components, Integral):
            numbers = components_of_parts(int(self.n_components), lasting)
        mixtures, learned = [], []
        shown = stretches(demonstrations, parts, kinematics.lower)
        for number, part in enumerate(parts):
            own = rows[belongs == number]
            stretch = replace(
                learning,
                rows=StoredRows(own),
                time=learning.time[torch.from_numpy(instants == number)],
            )
            found = self._components(
                shown[number], stretch, operators, kinematics, holds, whole
            )
            selections.append(found)
            k = numbers[number] if found is None else found.n_components_
            learned.append(replace(part, n_components=k))
            moments = ColumnMoments.of(own)
            mixture = self.unfitted_mixture(
                moments, learning.group_size, operators, kinematics,
                learning.n_demonstrations, k, whole=whole,
            )  # fmt: skip
            mixtures.append(mixture.fit_rows(stretch.rows, moments=moments))
        variances = self._variances(whole, operators, kinematics)
        counts = np.bincount(belongs, minlength=len(parts)).tolist()
        mixture = chained(mixtures, learned, counts, operators, kinematics, variances)
        self.set_mixture(mixture, operators, kinematics, learning.time, holds)
        self.parts_ = tuple(learned)
        return None if selections[0] is None else tuple(filter(None, selections))

    def _cuts(
        self, demonstrations: Sequence[Demonstration]
    ) -> tuple[Segmentation | None, list[tuple[float, str]]]:
        """When parts end, but for the last, and why."""
        if self.parts is None:
            return None, []
        if not isinstance(self.parts, str | Segmentation):
            times = check_cuts(self.parts, demonstrations)
            return None, [(time, "given") for time in times]
        own = isinstance(self.parts, Segmentation)
        segmentation = clone(self.parts) if own else Segmentation()
        if segmentation.robot is None:
            segmentation.set_params(robot=self.robot)
        segmentation.fit(demonstrations)
        times = np.median(segmentation.boundaries_, axis=0).tolist()
        segmentation.out_of_step(demonstrations).act(self.plausibility)
        return segmentation, list(zip(times, segmentation.reasons_, strict=True))

    def _operators(
        self, demonstrations: Sequence[Demonstration], cuts: Sequence[tuple[float, str]]
    ) -> tuple[tuple[Operator, ...], list[tuple[Operator, ...]], Any]:
        """All operators, those that matter in each part, of stacks their members; and why."""
        given, n_parts = self.operators, len(cuts) + 1
        if not isinstance(given, str | OperatorSelection):
            entries = [Canonical()] if given is None else list(given)
            lists = [own for own in entries if isinstance(own, list | tuple)]
            if not lists:
                operators = check_operators(given)
                return operators, [leaves(operators)] * n_parts, None
            if not len(lists) == len(entries) == n_parts:
                raise DataError(
                    f"operators has {len(entries)} entries, {len(lists)} of them sequences: "
                    f"with {n_parts} parts give operators, or {n_parts} sequences of operators"
                )
            of_parts = [leaves(check_operators(own)) for own in lists]
            return united(lists), of_parts, None
        selections = []
        parts = [Part(time, time, "", (), 0) for time in (0.0, *(time for time, _ in cuts))]
        settings = {
            name: getattr(self, name) for name in ("holds", "robust", "dtype", "device")
        }
        if cuts:  # what is held is seen in the whole skill
            given = given if isinstance(given, OperatorSelection) else OperatorSelection()
            robot = given.robot or self.robot
            candidates = given.candidates or candidate_operators(robot, demonstrations[0])
            candidates = check_operators(candidates)
            kinematics = kinematics_for(
                demonstrations, candidates, robot, self.dtype, self.device
            )
            settings["holds"] = holds_for(self.holds, demonstrations, candidates, kinematics)
        for shown in stretches(demonstrations, parts):
            selection = OperatorSelection() if isinstance(given, str) else clone(given)
            selection.set_params(**settings)
            if selection.robot is None:
                selection.set_params(robot=self.robot)
            selections.append(selection.fit(shown))
        if not cuts:
            [selection] = selections
            return selection.operators_, [leaves(selection.operators_)], selection
        of_parts = [leaves(selection.operators_) for selection in selections]
        every = dict.fromkeys(leaf for own in of_parts for leaf in own)
        return arranged(list(every)), of_parts, tuple(selections)

    def _examined(
        self,
        demonstrations: Sequence[Demonstration],
        operators: Sequence[Operator],
        kinematics: Kinematics,
    ) -> tuple[Tensor, TrainingSummary, tuple[Hold, ...] | None]:
        """Act on what is implausible; weights (M,) of demonstrations, and what these showed.

        And what is held in them, if that was looked for and none is left out.
        """
        episodes = summarize(demonstrations, kinematics)
        report = check(episodes, kinematics)
        weights, holds = torch.ones(len(demonstrations), dtype=torch.float64), None
        if not report.errors() or self.plausibility == "ignore":
            holds = holds_for(self.holds, demonstrations, operators, kinematics)
            correlated = self._correlated
            report = check(episodes, kinematics, operators, holds, correlated=correlated)
            outlying = self.robust and outlying_demonstrations(
                demonstrations, operators, kinematics, holds
            )
            if outlying:
                report = Report.of([*report, left_out(outlying, len(weights))], report.subject)
                weights[[one.episode for one in outlying]], holds = 0.0, None
        report.act(self.plausibility)
        kept = [each for each, weight in zip(episodes, weights, strict=True) if weight > 0]
        return weights, TrainingSummary.of(kept, kinematics), holds

    def _examine(
        self,
        episodes: Sequence[EpisodeSummary],
        outlying: Sequence[Outlying],
        operators: Sequence[Operator],
        kinematics: Kinematics,
        holds: Sequence[Hold],
        rank: int,
    ) -> tuple[TrainingSummary, Tensor]:
        """The same of demonstrations in batches: what they showed, and their weights (M,)."""
        correlated = self._correlated
        report = check(episodes, kinematics, operators, holds, correlated=correlated)
        weights = torch.ones(len(episodes), dtype=torch.float64)
        if outlying:
            report = Report.of([*report, left_out(outlying, len(weights))], report.subject)
            weights[[one.episode for one in outlying]] = 0.0
        if rank == 0 or report.errors() or self.plausibility == "error":
            report.act(self.plausibility)
        kept = [each for each, weight in zip(episodes, weights, strict=True) if weight > 0]
        return TrainingSummary.of(kept, kinematics), weights

    @property
    def _correlated(self) -> bool:
        """Whether correlations are learned without shrinkage."""
        return self.covariance_type in ("full", "tied") and self.covariance_shrinkage == 0

    def _examine_tick(self, now: Tensor, joints: Any, frames: Mapping[str, Frame]) -> None:
        """Act on what is implausible about a control tick, on behalf of who asks for it."""
        joints = self.kinematics_.joint_tensor(joints)
        known = {name: frame for name, frame in frames.items() if name in self.frame_names_}
        check_situations(joints, known, now, self.kinematics_, self.time_, self.summary_).act(
            self.plausibility
        )

    def _kinematics_for(
        self, demonstrations: Sequence[Demonstration], operators: Sequence[Operator]
    ) -> Kinematics:
        found = kinematics_for(demonstrations, operators, self.robot, self.dtype, self.device)
        given_widths(self.prior_std, found.joint_names)  # refused now, not after learning
        return found

    def _shared_settings(
        self,
        operators: Sequence[Operator],
        kinematics: Kinematics,
        n_components: int | None = None,
    ) -> dict[str, Any]:
        """What the mixture has of the estimator's parameters, and its blocks."""
        settings = {name: getattr(self, name) for name in MIXTURE_PARAMETERS}
        if n_components is not None:
            settings["n_components"] = n_components
        return settings | {
            "blocks": block_widths(operators, kinematics),
            "column_units": column_units(operators, kinematics),
            "timed_blocks": True,
        }

    def _situation(self, given: Situation | Demonstration) -> Situation:
        names, like = self.kinematics_.joint_names, self.time_
        if isinstance(given, Demonstration):
            given = Situation.of(given)
        if not isinstance(given, Situation):
            raise DataError(f"predict takes Situation objects, got {type(given).__name__}")
        given = given.reordered(names)
        if len(given.joints) != len(names):
            raise ShapeError(
                f"the start posture has {len(given.joints)} joints, the model has "
                f"{len(names)}: {names}"
            )
        complete = self._completed(given.joints, given.frames)
        for operator in self.operators_:
            operator.check(self.kinematics_, complete)
        time = self.time_ if given.time is None else given.time.to(like)
        present = {**complete, **given.frames_at(time)}
        frames = {name: present[name].to(like) for name in self.frame_names_}
        return Situation(given.joints.to(like), frames, time)

    def _completed(self, joints: Any, frames: Mapping[str, Frame]) -> dict[str, Frame]:
        """Frames, and those that are not given but are where a link is in a start posture.

        Raises
        ------
        UnknownNameError
            If one that the model needs is missing all the same.
        """
        complete = dict(frames)
        if self.summary_ is not None:
            start = self.kinematics_.joint_tensor(joints)
            complete |= self.summary_.start_frames(start, self.kinematics_, frames)
        for name in self.frame_names_:
            if name not in complete:
                where = "the situation, which has to tell it (the event of one is yet to be)"
                raise UnknownNameError("frame", name, where, complete)
        return complete

    def _rows(self, X: Sequence[Demonstration]) -> list[NDArray[np.float64]]:
        self._check_fitted()
        demonstrations = check_demonstrations(X)
        for operator in self.operators_:
            operator.check(self.kinematics_, demonstrations[0].frames)
        expected = self.regression().expected
        rows = local_data(
            demonstrations, self.operators_, self.kinematics_, expected, self.holds_
        )
        return [row.cpu().numpy() for row in rows]

    def _check_fitted(self) -> None:
        if not hasattr(self, "weights_"):
            raise NotFittedError(
                "this TaskParameterizedGMM is not fitted yet: call fit(demonstrations), or "
                "TaskParameterizedGMM.load(path)"
            )

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False  # X is a list of demonstrations
        return tags


def _first(situation: Situation) -> dict[str, Frame]:
    """The frames of a situation where the skill begins."""
    return {
        n: frame[0] if frame.batch_shape else frame for n, frame in situation.frames.items()
    }


def _via_value(value: Sequence[Any]) -> Any:
    """What JSON made a list of: numbers, or pairs of joints and numbers."""
    return dict(value) if value and isinstance(value[0], Sequence) else value


def _moved(tensors: Mapping[str, Tensor], device: str, path: str | Path) -> dict[str, Tensor]:
    """The tensors of a file on a device, which may be one of another machine."""
    try:
        return {name: tensor.to(device) for name, tensor in tensors.items()}
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).partition("\n")[0]
        raise ModelFileError(
            f"{path} is a model on the device {device!r}, which is not there ({reason}): "
            'load it onto another, TaskParameterizedGMM.load(path, device="cpu")'
        ) from error

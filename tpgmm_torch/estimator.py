"""Task-parameterised Gaussian mixture model: learned by EM, fused in joint space."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.constraints import DemonstrationEstimator, Interval, Options, check_parameters
from tpgmm_torch.data.demonstrations import Demonstration, Situation, check_demonstrations
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.mixture.processes import ALONE, Processes
from tpgmm_torch.motion.command_gaps import CommandGaps
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, Fusion, InformationFusion
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import Kinematics, RobotState
from tpgmm_torch.skills.reproduction import reproduce, sample
from tpgmm_torch.skills.situations import report_start, tick_inputs
from tpgmm_torch.training.learning import Learned, from_parameters, learn
from tpgmm_torch.training.local_data import local_data

__all__ = ["TaskParameterizedGMM"]


class TaskParameterizedGMM(DemonstrationEstimator):
    """Task-parameterised Gaussian mixture model over joint space and task space.

    One sample is one demonstration: ``X`` is a list of :class:`Demonstration`, so that
    scikit-learn's cross-validation works unchanged.

    Parameters
    ----------
    n_components : int, default=10
        K, the number of Gaussians; see :class:`SelectComponents`.
    operators : sequence of Operator, optional
        Candidate projection operators (Table I), one subspace each; the default is
        ``[Canonical()]``. See :class:`SelectOperators`.
    robot : Kinematics, optional
        A :class:`Robot`, :class:`Poses` for recorded poses without a robot, or your own;
        not needed by ``Canonical()`` alone.
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
        N and the number of coordinates, and falls as 1 / N
        (``shrinkage_intensity``); it also moderates the variances of coordinates of
        one unit by each other (``moderated_variances``), and lets joints give way to hands by
        what is left unknown of them (``predictive_scale``). 0 is the paper's.
    responsibilities : {"auto", "instant", "point"}, default="auto"
        What one responsibility is for. "point": every point of every demonstration, as in
        the paper. "instant": all demonstrations at one instant together, which keeps
        components from splitting a phase of the skill among few demonstrations and thereby
        from a confidence that nothing supports. "auto": "instant" where the demonstrations
        share one time grid, as after alignment, else "point".
    fusion : InformationFusion or CovarianceFusion, optional
        Form of the product of Gaussians (2), and its settings; the default is
        ``InformationFusion()``. ``CovarianceFusion()`` is eqs (1), (2) as printed.
    init_params : {"time", "kmeans", "random"}, default="time"
        How EM starts; "time" cuts the time axis into equal bins.
    n_init : int, default=1
        Number of starts; the most likely result is kept.
    max_iter : int, default=100
        Largest number of EM iterations.
    tol : float, default=1e-3
        EM stops when the mean log-likelihood gains less.
    random_state : int, RandomState instance or None, default=None
    dtype : {"float64", "float32"}, default="float64"
    device : str, default="cpu"
        Where tensors live, as torch spells it.

    Attributes
    ----------
    skill : Regression
        What runs: by :class:`Controller`, :func:`rollout`, or in :class:`ViaPoints`.
    weights_ : Tensor of shape (K,)
        Mixing coefficients pi_i.
    means_ : list of Tensor of shape (K, 1 + D_j)
        Local means mu_i^(j), time first, one tensor per operator.
    covariances_ : list of Tensor of shape (K, 1 + D_j, 1 + D_j)
        Local covariances Sigma_i^(j).
    mixture_ : BlockGaussianMixture
        Of the local data of all operators side by side.
    operators_ : tuple of Operator
    kinematics_ : Kinematics
    frame_names_ : tuple of str
        Frames that a situation must have; those at which a link was at the start of every
        demonstration follow from its start posture where they are not given.
    holds_ : tuple of Hold
        In the time of the skill.
    time_ : Tensor of shape (T,)
        Time grid of a typical demonstration, the default of ``predict`` [s].
    n_iter_ : int
    converged_ : bool
    lower_bound_ : float
        Mean log-likelihood per time step at the end of EM, before covariances are shrunk.
    n_demonstrations_ : int or None
        None where that is not known.
    summary_ : TrainingSummary or None
        Ranges of start postures and frames of the demonstrations, None where not known.

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
    >>> model = TaskParameterizedGMM(n_components=4).fit(demonstrations)
    >>> [trajectory] = model.predict([Situation(joints=[0.0])])
    >>> bool(abs(trajectory.joints[:, 0].numpy() - np.sin(3 * time)).max() < 0.05)
    True
    """

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012
        "n_components": [Interval(Integral, 1, None, closed="left")],
        "operators": ["array-like", None],
        "robot": [Kinematics, None],
        "covariance_type": [Options("full", "diag", "tied", "spherical")],
        "reg_covar": [Interval(Real, 0, None, closed="left")],
        "covariance_shrinkage": [Interval(Real, 0, 1, closed="both"), Options("auto")],
        "responsibilities": [Options("auto", "instant", "point")],
        "fusion": [InformationFusion, CovarianceFusion, None],
        "init_params": [Options("time", "kmeans", "random")],
        "n_init": [Interval(Integral, 1, None, closed="left")],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "tol": [Interval(Real, 0, None, closed="left")],
        "random_state": ["random_state"],
        "dtype": [Options("float64", "float32")],
        "device": [str],
    }

    #: Whether no tick of :meth:`step` was compared with the demonstrations yet.
    _untried = True

    def __init__(
        self,
        n_components: int = 10,
        operators: Sequence[Any] | None = None,
        robot: Kinematics | None = None,
        *,
        covariance_type: str = "full",
        reg_covar: float = 1e-5,
        covariance_shrinkage: float | str = "auto",
        responsibilities: str = "auto",
        fusion: Fusion | None = None,
        init_params: str = "time",
        n_init: int = 1,
        max_iter: int = 100,
        tol: float = 1e-3,
        random_state: int | np.random.RandomState | None = None,
        dtype: str = "float64",
        device: str = "cpu",
    ) -> None:
        self.n_components = n_components
        self.operators = operators
        self.robot = robot
        self.covariance_type = covariance_type
        self.reg_covar = reg_covar
        self.covariance_shrinkage = covariance_shrinkage
        self.responsibilities = responsibilities
        self.fusion = fusion
        self.init_params = init_params
        self.n_init = n_init
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state
        self.dtype = dtype
        self.device = device

    def fit(
        self,
        X: Iterable[Demonstration] | Iterable[Sequence[Demonstration]],
        y: object = None,
        *,
        interval: tuple[float, float] | None = None,
        processes: Processes = ALONE,
    ) -> Self:
        """Learn the local models by EM (Algorithm 1, model training).

        Demonstrations should be aligned in time; objects that move with a link belong to it if
        :func:`attach_holds` said so, and those unlike the others are left out by
        :func:`drop_outliers`: what is neither is reported by one
        :class:`~tpgmm_torch.exceptions.PlausibilityWarning`.

        Parameters
        ----------
        X : iterable of Demonstration, or of sequence of Demonstration
            In one list, or in batches of a set that is larger than memory, each read once;
            the first decides on holds and mean orientations.
        y : ignored
            Here for scikit-learn.
        interval : tuple of float, optional
            Learn from this part of the time only, begin and end [s].
        processes : Processes
            Among which the demonstrations are spread.

        Returns
        -------
        self

        Raises
        ------
        DataError, ShapeError, UnknownNameError, PlausibilityError
            If demonstrations do not fit together, or with the robot and the operators, or
            cannot be what they are taken for.
        """
        check_parameters(self)
        settings = self.get_params(deep=False)
        return self._set(learn(X, settings, interval=interval, processes=processes))

    def predict(
        self, X: Situation | Iterable[Situation], *, candidates: bool = True
    ) -> list[Trajectory]:
        """Reproduce the skill in new situations (Algorithm 1, movement synthesis).

        The references are the model's own, from q_{t-1} to q_t, and know no limits: see
        :func:`rollout` for those of the robot, for fading from the start posture, and for
        other skills.

        Parameters
        ----------
        X : sequence of Situation or Demonstration
        candidates : bool, default=True
            Whether trajectories hold each operator's own estimates too.

        Returns
        -------
        list of Trajectory

        Raises
        ------
        DataError, ShapeError, UnknownNameError, PlausibilityError, NotFittedError
            If a situation does not fit the model, or cannot be what it is taken for.
        """
        return reproduce(self.skill, X, candidates=candidates)

    def step(
        self,
        time: float | Tensor,
        state: RobotState | Any,
        frames: Frames | None = None,
        *,
        candidates: bool = False,
    ) -> Estimate:
        """One control tick for a batch of robots: the model's raw map, within the limits.

        It has no memory, and does at any time what the mixture says: beyond the skill's end
        that is an extrapolation, and nothing but the limits of position bounds a step from
        where the robot is. :class:`Controller` is what runs a skill.

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
        >>> import torch
        >>> from tpgmm_torch import Demonstration, TaskParameterizedGMM
        >>> time = torch.linspace(0, 1, 50, dtype=torch.float64)
        >>> shown = [Demonstration(time, (time * end)[:, None]) for end in (0.9, 1.0, 1.1)]
        >>> model = TaskParameterizedGMM(n_components=2).fit(shown)
        >>> estimate = model.step(0.5, [0.4])
        >>> round(float(estimate.joints), 2)
        0.5
        """
        skill = self.skill
        now, state, here = tick_inputs(skill, time, state, frames or {})
        if self._untried:  # wrong units are there from the first tick on: others cost nothing
            self._untried = False
            joints = state.joints if isinstance(state, RobotState) else state
            report_start(skill, joints, here, now)
        bounds = skill.kinematics.lower, skill.kinematics.upper
        return skill.estimate(now, state, here, bounds, candidates=candidates)

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
        return sample(self.skill, situation, n_samples, random_state)

    def score(self, X: Sequence[Demonstration], y: object = None) -> float:
        """Mean log-likelihood per time step of local coordinates and time; higher is better.

        Models of other operators are not comparable by it: they have other coordinates.
        """
        lengths = [len(demonstration) for demonstration in check_demonstrations(X)]
        return float(np.average(self.score_samples(X), weights=lengths))

    def score_samples(self, X: Sequence[Demonstration]) -> NDArray[np.float64]:
        """Mean log-likelihood per time step of each demonstration, (n,); see :meth:`score`."""
        skill, widths = self.skill, [mean.shape[1] for mean in self.means_]
        n_samples = None if self.covariance_shrinkage == 0 else self.n_demonstrations_
        densities = []
        for rows in self.rows(X):
            blocks = rows.split(widths, 1)
            local = [block[:, 1:] for block in blocks]
            density = skill.log_density(blocks[0][:, 0], local, n_samples)
            densities.append(float(density.mean()))
        return np.array(densities)

    def rows(self, X: Sequence[Demonstration]) -> list[Tensor]:
        """Time and local coordinates of demonstrations, as the mixture sees them.

        Returns
        -------
        list of Tensor of shape (T_m, sum_j (1 + D_j))
            ``mixture_.bic``, ``mixture_.predict`` and the like take them.
        """
        expected, demonstrations = self.skill.expect, check_demonstrations(X)
        for operator in self.operators_:
            operator.check(self.kinematics_, demonstrations[0].frames)
        known = self.operators_, self.kinematics_, expected, self.holds_
        return local_data(demonstrations, *known)

    @property
    def skill(self) -> Regression:
        """The mixture conditioned on time (eqs 1 to 3), which controllers run."""
        self._check_fitted("_skill")
        return self._skill

    @classmethod
    def from_parameters(
        cls,
        weights: Any,
        means: Sequence[Any],
        covariances: Sequence[Any],
        time: Any,
        *,
        holds: Sequence[Hold] = (),
        n_demonstrations: int | None = None,
        peaks: tuple[Tensor, Tensor] | None = None,
        summary: TrainingSummary | None = None,
        gaps: CommandGaps | None = None,
        **settings: Any,
    ) -> Self:
        """Return a fitted model of known parameters, which are kept as they are.

        Parameters
        ----------
        weights, means, covariances, time : array-like, or sequences of array-like
            As in the attributes of that name.
        holds : sequence of Hold
            In the time of the skill.
        n_demonstrations : int, optional
            That the model was learned from.
        peaks : tuple of two Tensor of shape (n_joints,), optional
            Accelerations [rad/s^2] and jerks [rad/s^3] of the demonstrations.
        summary : TrainingSummary, optional
            Of the demonstrations.
        gaps : CommandGaps, optional
            What servos need beyond postures.
        **settings
            Parameters of the constructor, ``robot`` among them:
            :class:`~tpgmm_torch.robots.kinematics.JointSpace` where operators need no links.

        Returns
        -------
        TaskParameterizedGMM

        Raises
        ------
        DataError, ShapeError
            If they are no mixture, or do not fit the operators.
        """
        model = cls(**{"n_components": len(weights)} | settings)
        check_parameters(model)
        mixture = weights, means, covariances
        learned = from_parameters(
            *mixture, time, model.get_params(deep=False),
            holds=holds, n_demonstrations=n_demonstrations, peaks=peaks, summary=summary,
            gaps=gaps,
        )  # fmt: skip
        return model._set(learned)

    def _set(self, learned: Learned) -> Self:
        """Keep what was learned, and condition it on time."""
        mixture = self.mixture_ = learned.mixture
        self.weights_, self.means_ = mixture.weights_, mixture.means_
        self.covariances_, self.time_ = mixture.covariances_, learned.time
        self.operators_, self.kinematics_ = learned.operators, learned.kinematics
        self.holds_, self.summary_ = learned.holds, learned.summary
        self.n_demonstrations_ = learned.n_demonstrations
        self.n_iter_ = getattr(mixture, "n_iter_", 0)  # given parameters come from no EM
        self.converged_ = getattr(mixture, "converged_", False)
        self.lower_bound_ = getattr(mixture, "lower_bound_", math.nan)
        self._untried = True
        own = self.fusion or InformationFusion()
        self._skill = Regression.of(learned, own, moderated=self.covariance_shrinkage == "auto")
        self.frame_names_ = self._skill.frame_names
        return self

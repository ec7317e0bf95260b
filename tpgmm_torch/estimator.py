"""The estimator: learn a skill from demonstrations, reproduce it in new situations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator
from sklearn.utils._param_validation import Interval, StrOptions

from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.large_data.processes import ALONE, Processes
from tpgmm_torch.large_data.row_file import SpooledRows
from tpgmm_torch.mixture.checkpoints import Checkpoint
from tpgmm_torch.operators import Operator
from tpgmm_torch.persistence import load_estimator, save_estimator
from tpgmm_torch.preparation import Preparation
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.training_rows import (
    DemonstrationBatches,
    LearningRows,
    check_like,
    gather_rows,
    rows_in_memory,
    split_batches,
)

__all__ = ["TaskParameterizedGMM"]


class TaskParameterizedGMM(Preparation, BaseEstimator):  # type: ignore[misc]
    """Task-parameterised Gaussian mixture over joint space and task space.

    One sample is one demonstration: ``X`` is a list of :class:`Demonstration`, so that
    scikit-learn's cross-validation works unchanged.

    Parameters
    ----------
    n_components : int, default=10
        K, the number of Gaussians.
    operators : sequence of Operator, optional
        Candidate projection operators, one subspace each; the default is ``[Canonical()]``.
    robot : Kinematics, optional
        A :class:`Robot`, :class:`Poses` for recorded poses without a robot, or your own;
        not needed by ``Canonical()`` alone.
    covariance_type : {"full", "diag", "tied", "spherical"}, default="full"
        Shape of the local covariances.
    reg_covar : float, default=1e-5
        Added to the diagonal of the covariances, relative to the variance of each coordinate.
        A smaller value is more exact where demonstrations agree, a larger one smoother where
        operators contradict each other.
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
    prior_std : float, default=10.0
        Standard deviation of the prior around q_{t-1} where no operator determines every
        joint [rad].
    negligible : float, default=1e-9
        With ``activation="time"``, shares of the largest weight below this do not count.
    blend : float, default=1.0
        Seconds over which ``predict`` fades out the difference between the start posture and
        the model's first reference (minimum jerk); 0 follows the model at once.
    keep_limits : bool, default=True
        References stay within the robot's limits of position and, in ``predict``, of speed:
        where the fused Gaussian goes beyond one, the joint stands there and the others take
        over as the Gaussian says.
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
    operators_ : tuple of Operator
    kinematics_ : Kinematics
    frame_names_ : tuple of str
        Frames that a situation must have.
    time_ : Tensor of shape (T,)
        Time grid of a typical demonstration, the default of ``predict`` [s].
    n_iter_ : int
    converged_ : bool
    lower_bound_ : float
        Mean log-likelihood per time step at the end of EM.

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
        "n_components": [Interval(Integral, 1, None, closed="left")],
        "operators": ["array-like", tuple, None],
        "robot": [Kinematics, None],
        "covariance_type": [StrOptions({"full", "diag", "tied", "spherical"})],
        "reg_covar": [Interval(Real, 0, None, closed="left")],
        "tol": [Interval(Real, 0, None, closed="left")],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "n_init": [Interval(Integral, 1, None, closed="left")],
        "init_params": [StrOptions({"time", "kmeans", "random"})],
        "responsibilities": [StrOptions({"auto", "instant", "point"})],
        "fusion": [StrOptions({"information", "covariance"})],
        "activation": [StrOptions({"time", "product"})],
        "epsilon": [Interval(Real, 0, None, closed="left")],
        "prior_std": [Interval(Real, 0, None, closed="neither")],
        "negligible": [Interval(Real, 0, 1, closed="left")],
        "blend": [Interval(Real, 0, None, closed="left")],
        "keep_limits": ["boolean"],
        "random_state": ["random_state"],
        "warm_start": ["boolean"],
        "dtype": [StrOptions({"float64", "float32"})],
        "device": [str],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        n_components: int = 10,
        operators: Sequence[Operator] | None = None,
        robot: Kinematics | None = None,
        *,
        covariance_type: str = "full",
        reg_covar: float = 1e-5,
        tol: float = 1e-3,
        max_iter: int = 100,
        n_init: int = 1,
        init_params: str = "time",
        responsibilities: str = "auto",
        fusion: str = "information",
        activation: str = "time",
        epsilon: float = 1e-4,
        prior_std: float = 10.0,
        negligible: float = 1e-9,
        blend: float = 1.0,
        keep_limits: bool = True,
        random_state: int | np.random.RandomState | None = None,
        warm_start: bool = False,
        dtype: str = "float64",
        device: str = "cpu",
        verbose: int = 0,
    ) -> None:
        self.n_components = n_components
        self.operators = operators
        self.robot = robot
        self.covariance_type = covariance_type
        self.reg_covar = reg_covar
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
        self.random_state = random_state
        self.warm_start = warm_start
        self.dtype = dtype
        self.device = device
        self.verbose = verbose

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
        ModelFileError
            If the checkpoint is damaged, or of other data or settings.
        DistributedError
            If another of the processes died.
        """
        self._validate_params()
        operators = self._checked_operators()
        demonstrations, batches = split_batches(X)
        if batches is None and processes.count == 1:
            known = check_demonstrations(demonstrations)
            kinematics = self._kinematics_for(known, operators)
            gathered = rows_in_memory(
                known, operators, kinematics, responsibilities=self.responsibilities
            )
            return self._learn(gathered, operators, kinematics, checkpoint)
        walk = iter(DemonstrationBatches([demonstrations] if batches is None else batches))
        head = next(walk, None)
        check_like(head, processes)
        assert head is not None
        kinematics = self._kinematics_for(head, operators)
        with SpooledRows() as spool:
            gathered = gather_rows(
                chain([head], walk), operators, kinematics, spool, processes,
                responsibilities=self.responsibilities,
            )  # fmt: skip
            return self._learn(gathered, operators, kinematics, checkpoint)

    def _learn(
        self,
        learning: LearningRows,
        operators: tuple[Operator, ...],
        kinematics: Kinematics,
        checkpoint: Checkpoint | None,
    ) -> Self:
        """Fit the mixture to rows, and take over what it learned."""
        moments = ColumnMoments.of_batches(learning.rows, learning.processes)
        mixture = self._mixture(moments, learning.group_size, operators, kinematics)
        mixture.fit_rows(
            learning.rows,
            moments=moments,
            checkpoint=checkpoint,
            processes=learning.processes,
        )
        return self._take(mixture, operators, kinematics, learning.time)

    def save(self, path: str | Path) -> None:
        """Write the fitted model to a directory (config.json, model.safetensors), atomically.

        A ``random_state`` that is not an int is not kept: it has no meaning for a fitted model.

        Raises
        ------
        NotFittedError, ModelFileError
        """
        self._check_fitted()
        save_estimator(self, path)

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
            If it is truncated, tampered with, of another version, or does not fit together.
        """
        model: Self = load_estimator(cls, path, custom, device)
        return model

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False  # X is a list of demonstrations
        return tags

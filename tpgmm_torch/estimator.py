"""The estimator: learn a skill from demonstrations, reproduce it in new situations."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.utils._param_validation import Interval, StrOptions

from tpgmm_torch.block_gaussians import Standardization
from tpgmm_torch.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.joint_space import JointSpace
from tpgmm_torch.kinematics import Kinematics
from tpgmm_torch.local_data import local_data
from tpgmm_torch.mixture import BlockGaussianMixture
from tpgmm_torch.operators import Canonical, Operator
from tpgmm_torch.operators.base import frame_names
from tpgmm_torch.persistence import load_estimator, save_estimator
from tpgmm_torch.reproduction import Reproduction

__all__ = ["TaskParameterizedGMM"]

MIXTURE_PARAMETERS = (
    "n_components", "covariance_type", "reg_covar", "tol", "max_iter", "n_init", "init_params",
    "random_state", "warm_start", "verbose", "dtype", "device",
)  # fmt: skip


class TaskParameterizedGMM(Reproduction, BaseEstimator):  # type: ignore[misc]
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
        Form of the product of Gaussians (DESIGN 4.2); "covariance" is eqs (1), (2) as printed.
    activation : {"time", "product"}, default="time"
        Where the mixing weights come from (DESIGN 4.3): the components' time marginal taken
        once, or that of the product, as in eq. (2).
    epsilon : float, default=1e-4
        Added to the diagonal of every projected covariance by ``fusion="covariance"`` [rad^2].
    prior_std : float, default=10.0
        Standard deviation of the prior around q_{t-1} where no operator determines every
        joint [rad].
    negligible : float, default=1e-9
        With ``activation="time"``, components of a smaller weight are left out of a step.
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

    mixture_: BlockGaussianMixture

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

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Learn the local models by expectation-maximisation (Algorithm 1, model training).

        Parameters
        ----------
        X : sequence of Demonstration
            With the same joints and frames; aligned in time, if durations differ.
        y : ignored
            Here for scikit-learn.

        Returns
        -------
        self

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If demonstrations do not fit together, or with the operators and the robot.
        """
        self._validate_params()
        demonstrations = check_demonstrations(X)
        operators = (Canonical(),) if self.operators is None else tuple(self.operators)
        if not operators:
            raise DataError("operators is empty: give at least one, for example [Canonical()]")
        for operator in operators:
            if not isinstance(operator, Operator):
                raise DataError(f"operators holds Operator objects, got {operator!r}")
        kinematics = self._kinematics(demonstrations, operators)
        for operator in operators:
            operator.check(kinematics, demonstrations[0].frames)
        rows = local_data(demonstrations, operators, kinematics)
        group_size = self._group_size(demonstrations)
        together = torch.cat(rows) if group_size == 1 else torch.stack(rows, 1).flatten(0, 1)
        points = together.cpu().numpy()
        settings = self._mixture_parameters(operators, kinematics)
        settings |= {
            "group_size": group_size,
            "reg_covar": self._regularization(points, operators, kinematics),
        }
        mixture = BlockGaussianMixture(**settings)
        if self.warm_start and hasattr(self, "mixture_"):
            mixture = self.mixture_.set_params(**settings)
        mixture.fit(points)
        self.mixture_, self.operators_, self.kinematics_ = mixture, operators, kinematics
        self.frame_names_ = frame_names(operators, kinematics)
        middle = sorted(demonstrations, key=lambda d: d.duration)[len(demonstrations) // 2]
        self.time_ = middle.time.to(rows[0])
        self.weights_, self.means_ = mixture.weights_, mixture.means_
        self.covariances_ = mixture.covariances_
        self.n_iter_, self.converged_ = mixture.n_iter_, mixture.converged_
        self.lower_bound_ = mixture.lower_bound_
        return self

    def score(self, X: Sequence[Demonstration], y: object = None) -> float:
        """Mean log-likelihood per time step of (new) demonstrations.

        It is the likelihood of the local data, so models with other operators are not
        comparable: use :func:`tpgmm_torch.metrics.reproduction_scorer` for those.
        """
        lengths = [len(demonstration) for demonstration in check_demonstrations(X)]
        return float(np.average(self.score_samples(X), weights=lengths))

    def score_samples(self, X: Sequence[Demonstration]) -> NDArray[np.float64]:
        """Mean log-likelihood per time step of each demonstration, shape (n,)."""
        return np.array([self.mixture_.score(row) for row in self._rows(X)])

    def bic(self, X: Sequence[Demonstration]) -> float:
        """Bayesian information criterion on demonstrations; lower is better."""
        rows = np.concatenate(self._rows(X))
        return float(self.mixture_.bic(rows))

    def aic(self, X: Sequence[Demonstration]) -> float:
        """Akaike information criterion on demonstrations; lower is better."""
        rows = np.concatenate(self._rows(X))
        return float(self.mixture_.aic(rows))

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

    def _kinematics(
        self, demonstrations: Sequence[Demonstration], operators: Sequence[Operator]
    ) -> Kinematics:
        dtype = getattr(torch, self.dtype)
        if self.robot is not None:
            return self.robot.to(dtype, self.device)
        needed = sorted({link for operator in operators for link in operator.links()})
        if needed:
            raise DataError(
                f"the operators need the pose of {needed}: pass robot=Robot.from_urdf(...), or "
                "robot=Poses(...) for recorded poses without a robot"
            )
        default = tuple(f"joint_{index}" for index in range(demonstrations[0].n_joints))
        names = next((d.joint_names for d in demonstrations if d.joint_names), default)
        return JointSpace(names, dtype, self.device)

    def _group_size(self, demonstrations: Sequence[Demonstration]) -> int:
        first = demonstrations[0].time
        aligned = all(torch.equal(item.time, first) for item in demonstrations)
        if self.responsibilities == "instant" and not aligned:
            raise DataError(
                "responsibilities='instant' needs demonstrations of one common time grid: "
                "align them (tpgmm_torch.alignment), or use 'auto' or 'point'"
            )
        return len(demonstrations) if aligned and self.responsibilities != "point" else 1

    def _regularization(
        self,
        points: NDArray[np.float64],
        operators: Sequence[Operator],
        kinematics: Kinematics,
    ) -> NDArray[np.float64]:
        """``reg_covar`` and the operators' tolerances, as shares of each column's variance."""
        widths = [1 + operator.dimension(kinematics) for operator in operators]
        isotropic = self.covariance_type == "spherical"
        scales = torch.cat(Standardization.of_data(points, widths, isotropic=isotropic).scales)
        tolerances = [(0.0, *operator.tolerances(kinematics)) for operator in operators]
        return self.reg_covar + (np.concatenate(tolerances) / scales.numpy()) ** 2

    def _mixture_parameters(
        self, operators: Sequence[Operator], kinematics: Kinematics
    ) -> dict[str, Any]:
        blocks = tuple(1 + operator.dimension(kinematics) for operator in operators)
        return {"blocks": blocks} | {name: getattr(self, name) for name in MIXTURE_PARAMETERS}

    def _rows(self, X: Sequence[Demonstration]) -> list[NDArray[np.float64]]:
        self._check_fitted()
        demonstrations = check_demonstrations(X)
        for operator in self.operators_:
            operator.check(self.kinematics_, demonstrations[0].frames)
        expected = self._regression().expected
        rows = local_data(demonstrations, self.operators_, self.kinematics_, expected)
        return [row.cpu().numpy() for row in rows]

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False  # X is a list of demonstrations
        return tags

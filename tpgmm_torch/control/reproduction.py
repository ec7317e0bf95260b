"""What a fitted model does: predict, step, sample."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral
from typing import Any, Self

import numpy as np
import torch
from sklearn.utils import check_random_state
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.control.compiled import CompiledRegression, check_compiler
from tpgmm_torch.control.rollout import Synthesis, rollout
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame, as_tensor
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.exceptions import DataError, NotFittedError, ShapeError
from tpgmm_torch.operators import Operator
from tpgmm_torch.regression.local_mixtures import LocalMixture
from tpgmm_torch.regression.regression import Estimate, Regression
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["Reproduction"]


class Reproduction:
    """The half of :class:`TaskParameterizedGMM` that needs only its fitted attributes."""

    fusion: str
    activation: str
    epsilon: float
    prior_std: float
    negligible: float
    blend: float
    keep_limits: bool
    weights_: Tensor
    means_: list[Tensor]
    covariances_: list[Tensor]
    operators_: tuple[Operator, ...]
    kinematics_: Kinematics
    frame_names_: tuple[str, ...]
    time_: Tensor
    #: What compiles; None until :meth:`compile` is called.
    _backend: str | None = None

    def predict(
        self, X: Situation | Sequence[Situation], *, candidates: bool = True
    ) -> list[Trajectory]:
        """Reproduce the skill: closed kinematic loop, q_{t-1} is the last reference.

        Parameters
        ----------
        X : sequence of Situation or Demonstration
            Situations of equal time grids run as one batch. A demonstration stands for the
            situation that it was made in.
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
        return rollout(self._regression(), situations, self.blend, self.keep_limits, candidates)

    def step(
        self,
        time: float | Tensor,
        state: RobotState | Any,
        frames: Mapping[str, Frame] | None = None,
        *,
        candidates: bool = False,
    ) -> Estimate:
        """One control tick for a batch of robots.

        Parameters
        ----------
        time : float or Tensor of the batch shape
            Now [s].
        state : RobotState, or array-like of shape (..., n_joints)
            The last reference q_{t-1}, or what was measured.
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
        kinematics, regression = self.kinematics_, self._regression()
        like = kinematics.lower
        known = {name: frame.to(like) for name, frame in (frames or {}).items()}
        now = as_tensor(time, "time").to(like)
        limits = (like, kinematics.upper) if self.keep_limits else None
        if not candidates and not isinstance(state, RobotState):
            return regression.tick(now, state, known, limits)
        if not isinstance(state, RobotState):
            state = kinematics.state(state)
        return regression.step(now, state, known, candidates, limits)

    def compile(self, backend: str = "inductor", n_robots: int = 1) -> Self:
        """Make :meth:`step`, :meth:`synthesis` and :meth:`predict` one compiled graph.

        Kinematics, operators and fusion of a tick run as one graph, compiled ahead of time by
        AOTInductor; what they give is the same. There is a graph for one robot and one for
        any number of robots. The one that is asked for is compiled at once, which takes about
        a minute: not while a robot waits. Ticks with candidates, with several times or that
        are differentiated run as before.

        Parameters
        ----------
        backend : str, default="inductor"
            AOTInductor, which needs a C++ compiler; others are those of ``torch.compile``.
        n_robots : int, default=1
            How many robots to compile for now, one or several; the other graph is compiled
            when it is first needed.

        Returns
        -------
        self

        Raises
        ------
        DependencyError
            If there is no C++ compiler.
        DataError
            If the model has operators or a robot of another kind than the graph serves.
        NotFittedError
            If the model is not fitted.
        """
        self._check_fitted()
        check_compiler(backend)
        previous, self._backend = self._backend, backend
        try:
            batch = () if n_robots == 1 else (n_robots,)
            like = self.time_
            start = like.new_zeros(*batch, self.kinematics_.n_joints)
            here = Frame(like.new_zeros(*batch, 3))
            self.step(float(like[0]), start, dict.fromkeys(self.frame_names_, here))
        except BaseException:
            self._backend = previous
            raise
        return self

    def synthesis(self, joints: Any) -> Synthesis:
        """The loop of :meth:`predict`, to be stepped by a controller.

        Parameters
        ----------
        joints : array-like of shape (..., n_joints)
            Start postures.

        Returns
        -------
        Synthesis
            Its ``step(time, frames)`` finds the next ``reference``.

        Raises
        ------
        ShapeError, DataError, NotFittedError
            If the postures do not fit the robot.
        """
        self._check_fitted()
        start = self.kinematics_.joint_tensor(joints)
        return Synthesis(self._regression(), start, self.blend, self.keep_limits)

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
            )
            for z in draws
        ]

    def _check_fitted(self) -> None:
        if not hasattr(self, "weights_"):
            raise NotFittedError(
                "this TaskParameterizedGMM is not fitted yet: call fit(demonstrations), or "
                "TaskParameterizedGMM.load(path)"
            )

    def _regression(self) -> Regression:
        """The fitted mixture in the form that reproduction needs, prepared once."""
        key = (
            self.fusion,
            self.activation,
            self.epsilon,
            self.prior_std,
            self.negligible,
        )
        backend = self._backend
        prepared = getattr(self, "_prepared", None)
        if prepared is None or prepared[0] != (key, backend) or prepared[1] is not self.means_:
            mixtures = [
                LocalMixture.of(mean, covariance)
                for mean, covariance in zip(self.means_, self.covariances_, strict=True)
            ]
            log_weights = self.weights_.log()
            make: Any = Regression
            if backend is not None:
                make = functools.partial(CompiledRegression, backend=backend)
            fitted = self.kinematics_, self.operators_, mixtures, log_weights
            regression = make(*fitted, *key)
            self._prepared = prepared = ((key, backend), self.means_, regression)
        return prepared[2]

    def _situation(self, given: Situation | Demonstration) -> Situation:
        names, like = self.kinematics_.joint_names, self.time_
        if isinstance(given, Demonstration):
            given = Situation.of(given.reordered(names))
        if not isinstance(given, Situation):
            raise DataError(f"predict takes Situation objects, got {type(given).__name__}")
        if len(given.joints) != len(names):
            raise ShapeError(
                f"the start posture has {len(given.joints)} joints, the model has "
                f"{len(names)}: {names}"
            )
        for operator in self.operators_:
            operator.check(self.kinematics_, given.frames)
        time = self.time_ if given.time is None else given.time.to(like)
        frames = {name: given.frames[name].to(like) for name in self.frame_names_}
        return Situation(given.joints.to(like), frames, time)

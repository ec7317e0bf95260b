"""A skill that is done in several ways: one model for each, chosen by the situation."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, clone
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.atomic import consistent, replacing
from tpgmm_torch.checks.situations import START
from tpgmm_torch.checks.summary import ALIKE
from tpgmm_torch.constraints import Interval, Options, check_parameters
from tpgmm_torch.control.clock_text import parse_clock
from tpgmm_torch.control.clocks import Clock
from tpgmm_torch.control.command import Command
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration, Situation, check_demonstrations
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, ModelFileError, NotFittedError, ShapeError
from tpgmm_torch.persistence import MODES
from tpgmm_torch.storage import Folder
from tpgmm_torch.structure.mode_selection import ModeSelection
from tpgmm_torch.structure.operator_selection import OperatorSelection
from tpgmm_torch.training.mixture_settings import check_operators

__all__ = ["ModeChoice", "MultimodalController", "MultimodalTaskParameterizedGMM"]

FILES = Folder("modes", 1)
#: A skill is tried out at so many instants to see whether it can be done.
TRIED = 40
#: While a skill runs, modes are compared every so many seconds,
LOOK = 0.1
#: and one that is so many times likelier is gone over to.
CLEARLY = 20.0


@dataclass(frozen=True)
class ModeChoice:
    """Which mode suits a situation, and why.

    Parameters
    ----------
    mode : int
    probabilities : array of shape (n_modes,)
        ``p_k ~ weight_k exp(-novelty_k^2 / 2 - misfit_k)``.
    novelty : array of shape (n_modes,)
        Of the situation to each mode; 1 is that of its least usual demonstration
        (:class:`~tpgmm_torch.checks.TrainingSummary`).
    misfit : array of shape (n_modes,)
        By how much less likely the mode's reproduction is, in its worst moment, than any of
        its demonstrations ever was [nats]: large where the arm does not reach, or stands at
        its limits.
    """

    mode: int
    probabilities: Array
    novelty: Array
    misfit: Array

    @classmethod
    def of(cls, weights: Array, novelty: Array, misfit: Array) -> Self:
        """The likeliest mode, given prior weights."""
        score = np.log(weights) - novelty**2 / 2 - misfit
        shares = np.exp(score - score.max())
        return cls(int(score.argmax()), shares / shares.sum(), novelty, misfit)

    def __str__(self) -> str:
        others = ", ".join(
            f"mode {k}: p = {p:.2g}, novelty {n:.2g}, misfit {m:.2g}"
            for k, (p, n, m) in enumerate(
                zip(self.probabilities, self.novelty, self.misfit, strict=True)
            )
        )
        return f"mode {self.mode} ({others})"


class MultimodalTaskParameterizedGMM(BaseEstimator):  # type: ignore[misc]
    """A model for each way in which a skill is done.

    The mean of passing an obstacle on the left and on the right goes through it. So
    demonstrations are divided by the ways that they show, each way is a model of its own, and
    a new situation is reproduced in the way that suits it: the likeliest, given how often it
    was shown, how like the situation is to those it was shown in, and whether the robot can
    do it there.

    Parameters
    ----------
    model : TaskParameterizedGMM, optional
        Its parameters are those of each mode.
    modes : "auto", int or ModeSelection, default="auto"
        How many; "auto" finds it, :class:`ModeSelection`.

    Attributes
    ----------
    models_ : list of TaskParameterizedGMM
        One per mode.
    n_modes_ : int
    labels_ : array of int, of shape (N,)
        The mode of each demonstration.
    weights_ : array of shape (n_modes,)
        Shares of the demonstrations.
    limits_ : array of shape (n_modes,)
        What the least likely moment of a mode's demonstrations is less likely than what is
        expected there [nats], :meth:`TaskParameterizedGMM.surprise`.
    mode_selection_ : ModeSelection or None
        How the modes were found; None for a model that was loaded.

    Examples
    --------
    >>> rng, time = np.random.default_rng(0), np.linspace(0, 1, 50)
    >>> shown = [
    ...     Demonstration(time, (side * np.sin(3 * time) + 0.02 * rng.normal())[:, None])
    ...     for side in (1, -1, 1, 1, -1, -1)
    ... ]
    >>> model = MultimodalTaskParameterizedGMM(TaskParameterizedGMM(4)).fit(shown)
    >>> [trajectory] = model.predict([Situation([0.0])])
    >>> model.n_modes_, bool(trajectory.joints.abs().max() > 0.9)
    (2, True)
    """

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012
        "model": [TaskParameterizedGMM, None],
        "modes": [
            Options("auto"),
            Interval(Integral, 1, None, closed="left"),
            ModeSelection,
        ],
    }

    models_: list[TaskParameterizedGMM]
    labels_: NDArray[np.intp]
    weights_: Array
    limits_: Array
    mode_selection_: ModeSelection | None

    def __init__(
        self,
        model: TaskParameterizedGMM | None = None,
        modes: int | str | ModeSelection = "auto",
    ) -> None:
        self.model = model
        self.modes = modes

    @property
    def n_modes_(self) -> int:
        """How many ways there are."""
        return len(self.models_)

    @property
    def joint_names_(self) -> tuple[str, ...]:
        """Of the robot, in the order of the joint vectors."""
        self._check_fitted()
        return self.models_[0].joint_names_

    @property
    def frame_names_(self) -> tuple[str, ...]:
        """Objects that a situation has to tell the poses of, for any of the ways."""
        self._check_fitted()
        names = (name for model in self.models_ for name in model.frame_names_)
        return tuple(dict.fromkeys(names))

    def fit(self, X: Sequence[Demonstration], y: object = None) -> Self:
        """Divide demonstrations by mode, and learn from those of each.

        Parameters
        ----------
        X : sequence of Demonstration
            Aligned in time, in memory.
        y : ignored
            Here for scikit-learn.

        Returns
        -------
        self

        Raises
        ------
        DataError, ShapeError, UnknownNameError, PlausibilityError
            As :meth:`TaskParameterizedGMM.fit` and :meth:`ModeSelection.fit` do.
        """
        check_parameters(self)
        known = check_demonstrations(X)
        model = TaskParameterizedGMM() if self.model is None else self.model
        selection = self._selection(model).fit(known)
        models, limits = [], []
        for mode in range(selection.n_modes_):
            members = [known[i] for i in np.flatnonzero(selection.labels_ == mode)]
            fitted = clone(model).fit(members)
            models.append(fitted)
            learned = fitted.demonstration_weights_
            assert learned is not None  # demonstrations in memory, in one process
            kept = [one for one, weight in zip(members, learned, strict=True) if weight > 0]
            limits.append(max(float(each.max()) for each in fitted.surprise(kept)))
        self.models_, self.labels_, self.limits_ = models, selection.labels_, np.array(limits)
        self.weights_ = np.bincount(selection.labels_) / len(known)
        self.mode_selection_ = selection
        return self

    @classmethod
    def from_models(
        cls,
        models: Sequence[TaskParameterizedGMM],
        weights: Any,
        limits: Any,
        labels: Any,
    ) -> Self:
        """A fitted model of known ways, which are kept as they are.

        Parameters
        ----------
        models : sequence of TaskParameterizedGMM
            Fitted, of one robot.
        weights, limits, labels : array-like
            As in the attributes of that name.

        Raises
        ------
        DataError
            If they do not fit together.
        """
        models, labels = list(models), np.array(labels, dtype=np.intp)
        weights, limits = (np.array(values, dtype=np.float64) for values in (weights, limits))
        if not models or not len(models) == len(weights) == len(limits):
            raise DataError(
                f"{len(models)} models with {len(weights)} weights and {len(limits)} limits: "
                "there is one of each for every way"
            )
        if not (bool((weights > 0).all()) and np.isfinite([*weights, *limits]).all()):
            raise DataError(
                f"weights and limits are finite, weights positive: got {weights} and {limits}"
            )
        if labels.ndim != 1 or not set(labels.tolist()) <= set(range(len(models))):
            raise DataError(f"labels {labels.tolist()} are no numbers of {len(models)} ways")
        [first, *others] = models
        if any(other.joint_names_ != first.joint_names_ for other in others):
            raise DataError("the ways are of different robots")
        multimodal = cls(clone(first), len(models))
        multimodal.models_, multimodal.mode_selection_ = models, None
        multimodal.weights_, multimodal.limits_, multimodal.labels_ = weights, limits, labels
        return multimodal

    def choose(self, X: Situation | Sequence[Situation]) -> list[ModeChoice]:
        """The mode for each situation, and why.

        Each mode is tried out on a coarse grid of time, within the robot's limits.

        Parameters
        ----------
        X : sequence of Situation or Demonstration
            As for :meth:`predict`.

        Raises
        ------
        DataError, ShapeError, UnknownNameError, NotFittedError
            If a situation does not fit the model.
        """
        self._check_fitted()
        given = [X] if isinstance(X, Situation | Demonstration) else list(X)
        situations = [Situation.of(x) if isinstance(x, Demonstration) else x for x in given]
        misfit = np.array([self._misfits(k, situations) for k in range(self.n_modes_)])
        novelty = np.array(
            [[_novelty(model, one) for one in situations] for model in self.models_]
        )
        return [
            ModeChoice.of(self.weights_, novelty[:, n], misfit[:, n])
            for n in range(len(situations))
        ]

    def predict(
        self,
        X: Situation | Sequence[Situation],
        *,
        candidates: bool = True,
        choices: Sequence[ModeChoice] | None = None,
    ) -> list[Trajectory]:
        """Reproduce the skill, in each situation by the mode that suits it.

        Parameters
        ----------
        X : sequence of Situation or Demonstration
        candidates : bool, default=True
            As for :meth:`TaskParameterizedGMM.predict`.
        choices : sequence of ModeChoice, optional
            One per situation, as :meth:`choose` returned them for these, so that they are not
            found a second time; by default they are found.

        Raises
        ------
        DataError, ShapeError, UnknownNameError, NotFittedError
            If a situation does not fit the model, or ``choices`` do not fit both.
        """
        self._check_fitted()
        given = [X] if isinstance(X, Situation | Demonstration) else list(X)
        if choices is not None:
            self._check_choices(choices, len(given))
        if self.n_modes_ == 1:
            return self.models_[0].predict(X, candidates=candidates)
        if choices is None:
            choices = self.choose(given)
        modes = np.array([choice.mode for choice in choices])
        found: dict[int, Trajectory] = {}
        for mode in np.unique(modes):
            members = np.flatnonzero(modes == mode)
            those = [given[i] for i in members]
            done = self.models_[mode].predict(those, candidates=candidates)
            found.update(zip(members.tolist(), done, strict=True))
        return [found[i] for i in range(len(given))]

    def controller(
        self,
        joints: Any,
        frames: Mapping[str, Frame] | None = None,
        *,
        clock: Clock | str = "localizing",
        **settings: Any,
    ) -> MultimodalController | MultimodalControllers:
        """The skill, to be run tick by tick, in the mode that suits now.

        Parameters
        ----------
        joints : array-like of shape (..., n_joints)
            The start posture. Of a batch, each robot goes its own way.
        frames : mapping of str to Frame, optional
            Object poses, of shapes that broadcast with the batch; a step may be given others.
        clock : Clock or str, default="localizing"
        **settings
            Further ones of :meth:`TaskParameterizedGMM.controller`.

        Raises
        ------
        ShapeError, DataError, NotFittedError, UnknownNameError
            As there.
        """
        self._check_fitted()
        clock = parse_clock(clock)
        starts = self.models_[0].kinematics_.joint_tensor(joints)
        kind = MultimodalControllers if starts.ndim > 1 else MultimodalController
        return kind(self, starts, frames or {}, clock, settings)

    def score(self, X: Sequence[Demonstration], y: object = None) -> float:
        """Mean log-likelihood per time step of demonstrations; higher is better."""
        lengths = [len(demonstration) for demonstration in check_demonstrations(X)]
        return float(np.average(self.score_samples(X), weights=lengths))

    def score_samples(self, X: Sequence[Demonstration]) -> NDArray[np.float64]:
        """Mean log-likelihood per time step of each demonstration, (n,).

        Of a mixture of whole demonstrations: ``log sum_k weight_k p(X | mode k)``.
        """
        self._check_fitted()
        if self.n_modes_ == 1:
            return self.models_[0].score_samples(X)
        lengths = np.array([len(demonstration) for demonstration in X])
        whole = lengths * np.array([model.score_samples(X) for model in self.models_])
        total = np.logaddexp.reduce(whole + np.log(self.weights_)[:, None], axis=0)
        return np.asarray(total / lengths)

    def save(self, path: str | Path) -> None:
        """Write the fitted model to a directory, atomically.

        Each mode is a model of its own in it, ``mode_0``, ``mode_1``, ..., that
        :meth:`TaskParameterizedGMM.load` reads.

        Parameters
        ----------
        path : str or Path

        Raises
        ------
        NotFittedError
        ModelFileError
            If something is there that is no such model.
        """
        self._check_fitted()
        path = Path(path)
        numbers = {
            "weights": torch.from_numpy(self.weights_),
            "limits": torch.from_numpy(self.limits_),
            "labels": torch.from_numpy(self.labels_),
        }
        with replacing(path) as new:
            if path.exists() and not (path / MODES).is_dir():
                raise ModelFileError(
                    f"{path} exists and is no saved model of several ways; choose another "
                    "directory"
                )
            new.mkdir()
            FILES.write(new / MODES, {"n_modes": self.n_modes_}, numbers)
            for k, model in enumerate(self.models_):
                model.save(new / f"mode_{k}")

    @classmethod
    def load(
        cls, path: str | Path, custom: Sequence[type] = (), device: str | None = None
    ) -> Self:
        """Read a model that :meth:`save` wrote; nothing in it is executed.

        Parameters
        ----------
        path : str or Path
        custom, device
            As for :meth:`TaskParameterizedGMM.load`.

        Raises
        ------
        ModelFileError
            If it is damaged, or does not fit together.
        """
        path = Path(path)
        return consistent(path, lambda: cls._read(path, custom, device))

    @classmethod
    def _read(cls, path: Path, custom: Sequence[type], device: str | None) -> Self:
        config, numbers = FILES.read(path / MODES)
        count = config.get("n_modes")
        fits = isinstance(count, int) and numbers.keys() == {"weights", "limits", "labels"}
        if not fits or not len(numbers["weights"]) == len(numbers["limits"]) == count:
            raise ModelFileError(f"{path / MODES} does not fit together")
        models = [
            TaskParameterizedGMM.load(path / f"mode_{k}", custom, device) for k in range(count)
        ]
        known = (numbers[name].numpy() for name in ("weights", "limits", "labels"))
        try:
            return cls.from_models(models, *known)
        except DataError as error:
            raise ModelFileError(f"{path} does not fit together: {error}") from error

    def _check_choices(self, choices: Sequence[ModeChoice], n_situations: int) -> None:
        if len(choices) != n_situations:
            raise DataError(
                f"got {len(choices)} choices for {n_situations} situations: give what "
                "choose(situations) returned for them"
            )
        unknown = sorted({one.mode for one in choices} - set(range(self.n_modes_)))
        if unknown:
            raise DataError(
                f"choices name the modes {unknown}, but there are {self.n_modes_}, counted "
                "from 0: give what choose(situations) of this model returned"
            )

    def _selection(self, model: TaskParameterizedGMM) -> ModeSelection:
        """What finds the modes, in the coordinates that the model looks at."""
        own = isinstance(self.modes, ModeSelection)
        selection = clone(self.modes) if own else ModeSelection(n_modes=self.modes)
        shared = {name: getattr(model, name) for name in ("holds", "dtype", "device")}
        selection.set_params(**shared)
        if selection.robot is None:
            selection.set_params(robot=model.robot)
        found = isinstance(model.operators, str | OperatorSelection)  # yet to be, in each mode
        if selection.operators is None and not found:
            selection.set_params(operators=check_operators(model.operators))
        return selection

    def _misfits(
        self, mode: int, situations: Sequence[Situation], begin: float = -math.inf
    ) -> list[float]:
        """By how much less likely than ever a mode's reproductions get, from a time on."""
        model = _silent(self.models_[mode])
        first, last = float(model.time_[0]), float(model.time_[-1])
        time = torch.linspace(max(begin, first), last, TRIED, dtype=model.time_.dtype)
        tried = [
            replace(one, time=time, frames_time=_recorded(one, model.time_))
            for one in situations
        ]
        with torch.inference_mode():
            motions = model.predict(tried, candidates=False)
        return [
            float(self._excess(mode, time, motion.joints, one.frames_at(time)).max())
            for one, motion in zip(tried, motions, strict=True)
        ]

    def _excess(
        self, mode: int, time: Tensor, joints: Tensor, frames: Mapping[str, Frame]
    ) -> Array:
        """By how much less likely than any demonstration each moment of a motion is, (T,)."""
        model = self.models_[mode]
        complete = model._completed(joints[0], frames)
        motion = Demonstration(time, joints, complete, model.kinematics_.joint_names)
        return np.maximum(np.asarray(model.surprise([motion])[0]) - self.limits_[mode], 0.0)

    def _check_fitted(self) -> None:
        if not hasattr(self, "models_"):
            raise NotFittedError(
                "this MultimodalTaskParameterizedGMM is not fitted yet: call "
                "fit(demonstrations), or MultimodalTaskParameterizedGMM.load(path)"
            )

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False  # X is a list of demonstrations
        return tags


class MultimodalController:
    """One robot that runs a skill of several ways, in the one that suits now.

    A :class:`Controller` of one mode runs. Ten times a second modes are compared as they are
    at the start, and by how likely the present posture is in each at the present progress.
    While modes have not parted, that is the same, and the situation decides: another mode is
    gone over to as soon as it is 20 times likelier, because an object was moved to where the
    first one does not reach, for example. When they have parted, they cannot be changed but by
    who moves the robot over. References go on from where they are, within the bounds of
    motion, as :attr:`TaskParameterizedGMM.blend` says.

    Parameters
    ----------
    model : MultimodalTaskParameterizedGMM
        Whose :meth:`~MultimodalTaskParameterizedGMM.controller` makes it.
    joints : Tensor of shape (n_joints,)
        The start posture.
    frames : mapping of str to Frame
        Poses of the objects until others are told.
    clock : Clock
    settings : mapping
        Further ones of :meth:`TaskParameterizedGMM.controller`.
    choice : ModeChoice, optional
        For this situation; by default it is found.

    Attributes
    ----------
    mode : int
        That runs.
    choice : ModeChoice
        Why: the last comparison, the present posture included.
    controller : Controller
        Of the mode that runs, with everything that it tells.
    command : Command or None
        What the last step returned.
    """

    def __init__(
        self,
        model: MultimodalTaskParameterizedGMM,
        joints: Tensor,
        frames: Mapping[str, Frame],
        clock: Clock,
        settings: Mapping[str, Any],
        choice: ModeChoice | None = None,
    ) -> None:
        self._model, self._clock, self._settings = model, clock, dict(settings)
        self._start, self._since = joints, 0.0
        frames = {name: frame.to(joints) for name, frame in frames.items()}
        if choice is None:
            [choice] = model.choose(Situation(joints, frames))
        self.choice, self._misfit, self._midway = choice, choice.misfit, False
        if model.n_modes_ > 1:
            self._look_where_it_begins(joints, frames)
        self.mode = self.choice.mode
        self.controller = model.models_[self.mode].controller(
            joints, frames, clock=clock, **settings
        )
        self.command: Command | None = None
        self._seen = dict(self.controller.holding.frames)

    @property
    def reference(self) -> Tensor:
        """The last reference (n_joints,); the start posture before the first step."""
        return self.controller.reference

    @property
    def time(self) -> Tensor:
        """Progress in the mode that runs [s]."""
        return self.controller.time

    @property
    def finished(self) -> bool:
        """Whether the robot is at the end."""
        return self.controller.finished

    def step(
        self,
        dt: float | Tensor,
        joints: Any = None,
        frames: Mapping[str, Any] | None = None,
        *,
        holds: Mapping[str, str | None] | None = None,
        ages: Mapping[str, float] | None = None,
    ) -> Command:
        """Find the next reference, in another mode if that suits better now.

        Parameters
        ----------
        dt : float
            Seconds since the last step.
        joints : array-like of shape (n_joints,), optional
            Where the robot stands.
        frames : mapping of str to Frame, optional
            Poses of the objects from now on.
        holds, ages
            As for :meth:`Controller.step`.
        """
        self.command = self.controller.step(dt, joints, frames, holds=holds, ages=ages)
        passed = float(dt)
        self._since += passed if 0 < passed < math.inf else 0.0
        if self._model.n_modes_ > 1 and self._since >= LOOK and not self.finished:
            self._since = 0.0
            self._compare()
        return self.command

    def copy(self) -> Self:
        """As :meth:`Controller.copy`."""
        other = copy.copy(self)
        other.controller = self.controller.copy()
        return other

    def ahead(self) -> Self:
        """As :meth:`Controller.ahead`; where nothing is moved, the mode stays."""
        other = copy.copy(self)
        other.controller, other._since = self.controller.ahead(), -math.inf
        return other

    def resumed(
        self, moment: Self, passed: float, joints: Any, frames: Mapping[str, Any] | None = None
    ) -> Self:
        """As :meth:`Controller.resumed`."""
        other, controller = copy.copy(moment), self.controller
        other.controller = controller.resumed(moment.controller, passed, joints, frames)
        other._since = self._since + passed
        return other

    def _compare(self) -> None:
        """Go over to another mode from the next step on, if it is far likelier."""
        model, places = self._model, dict(self.controller.holding.frames)
        here, measured = self.reference, self.controller.measured
        if measured is not None:
            here = torch.where(measured.isnan(), here, measured)
        times = [self._progress(k) for k in range(model.n_modes_)]
        if _moved(self._seen, places):
            self._seen = places
            self._try_out(here, places, times)
        # where the mode itself sends the robot is nothing against it
        asked, allowed = self.controller.command, np.zeros(model.n_modes_)
        if asked is not None and bool(asked.estimate.joints.isfinite().all()):
            joints, at = asked.estimate.joints[None], here.new_tensor([times[self.mode]])
            allowed[self.mode] = model._excess(self.mode, at, joints, places)[0]
        self._weigh(here, places, times, allowed)
        chances = self.choice.probabilities
        if chances[self.choice.mode] > CLEARLY * chances[self.mode]:
            self._switch(self.choice.mode, times[self.choice.mode], places)

    def _look_where_it_begins(self, joints: Tensor, frames: Mapping[str, Frame]) -> None:
        """Choose by where the robot stands too, if the clock finds it in the middle."""
        times = []
        for model in self._model.models_:
            first, last = float(model.time_[0]), float(model.time_[-1])
            places = model._completed(joints, frames)
            begun = self._clock.start(model.regression(), joints, places, first, last)
            times.append(float(begun.time))
            self._midway |= times[-1] > first + START * (last - first)
        if self._midway:
            self._try_out(joints, frames, times)
            self._weigh(joints, frames, times)

    def _try_out(
        self, here: Tensor, frames: Mapping[str, Frame], times: Sequence[float]
    ) -> None:
        """Whether each mode can be done from its time on."""
        now = Situation(here, frames)
        misfits = [self._model._misfits(k, [now], at) for k, at in enumerate(times)]
        self._misfit = np.concatenate(misfits)

    def _weigh(
        self,
        here: Tensor,
        frames: Mapping[str, Frame],
        times: Sequence[float],
        allowed: Array | float = 0.0,
    ) -> None:
        """Compare modes, in each of which the robot is ``here`` at a time, or was to be lately.

        So much less likely than any demonstration as ``allowed`` it may be. What the bounds of
        motion let fall behind is on its way, and as likely as the moment before.
        """
        model, begun = self._model, Situation(self._start, frames)
        twice = here.expand(2, -1)
        there = [
            model._excess(k, here.new_tensor([at - LOOK, at]), twice, frames).min()
            for k, at in enumerate(times)
        ]
        novelty = np.array([_novelty(one, begun, self._midway) for one in model.models_])
        # the posture is a moment of the motion that was tried out
        misfit = np.maximum(self._misfit, np.array(there) - allowed)
        self.choice = ModeChoice.of(model.weights_, novelty, misfit)

    def _switch(self, mode: int, time: float, frames: Mapping[str, Frame]) -> None:
        """From the next step on the robot goes another way."""
        skill = _silent(self._model.models_[mode])
        regression, end = skill.regression(), float(skill.time_[-1])
        progress = self._clock.start(regression, self.reference, frames, time, end)
        self.controller, self.mode = self.controller.switched(regression, progress), mode

    def _progress(self, mode: int) -> float:
        """The present progress, as the time of a mode [s]."""
        now, grid = self._model.models_[self.mode].time_, self._model.models_[mode].time_
        share = (float(self.time) - float(now[0])) / float(now[-1] - now[0])
        return float(grid[0]) + share * float(grid[-1] - grid[0])


class MultimodalControllers:
    """A batch of robots that run a skill of several ways, each of them in its own.

    Parameters
    ----------
    model, frames, clock, settings
        As for :class:`MultimodalController`.
    joints : Tensor of shape (..., n_joints)
        The start postures.

    Attributes
    ----------
    controllers : list of MultimodalController
        One for each robot.
    command : Command or None
        What the last step returned.
    """

    def __init__(
        self,
        model: MultimodalTaskParameterizedGMM,
        joints: Tensor,
        frames: Mapping[str, Frame],
        clock: Clock,
        settings: Mapping[str, Any],
    ) -> None:
        self._parts = _Parts(joints.shape[:-1])
        self.command: Command | None = None
        starts = joints.reshape(-1, joints.shape[-1])
        pairs = list(zip(starts, self._parts.of_frames(frames), strict=True))
        choices = model.choose([Situation(*pair) for pair in pairs])
        self.controllers = [
            MultimodalController(model, *pair, clock, settings, choice)
            for pair, choice in zip(pairs, choices, strict=True)
        ]

    @property
    def modes(self) -> NDArray[np.intp]:
        """In which each robot goes (...)."""
        modes = np.array([one.mode for one in self.controllers], dtype=np.intp)
        return modes.reshape(self._parts.batch)

    @property
    def reference(self) -> Tensor:
        """The last references (..., n_joints); the start postures before the first step."""
        return self._parts.joined([one.reference for one in self.controllers])

    @property
    def time(self) -> Tensor:
        """Progress of each robot in its mode (...) [s]."""
        return self._parts.joined([one.time for one in self.controllers])

    @property
    def finished(self) -> bool:
        """Whether all robots are at the end."""
        return all(one.finished for one in self.controllers)

    def step(
        self,
        dt: float | Tensor,
        joints: Any = None,
        frames: Mapping[str, Any] | None = None,
        *,
        holds: Mapping[str, str | None] | None = None,
        ages: Mapping[str, float] | None = None,
    ) -> Command:
        """As :meth:`Controller.step`."""
        parts = self._parts
        stand, places = parts.of_joints(joints), parts.of_frames(frames)
        seconds = torch.as_tensor(dt, dtype=torch.float64).expand(parts.batch).flatten()
        commands = [
            one.step(passed, at, place, holds=holds, ages=ages)
            for one, passed, at, place in zip(
                self.controllers, seconds.tolist(), stand, places, strict=True
            )
        ]
        self.command = Command.stack(commands, parts.batch)
        return self.command

    def copy(self) -> Self:
        """As :meth:`Controller.copy`."""
        return self._like([one.copy() for one in self.controllers])

    def ahead(self) -> Self:
        """As :meth:`Controller.ahead`."""
        return self._like([one.ahead() for one in self.controllers])

    def resumed(
        self, moment: Self, passed: float, joints: Any, frames: Mapping[str, Any] | None = None
    ) -> Self:
        """As :meth:`Controller.resumed`."""
        told = self._parts.of_joints(joints), self._parts.of_frames(frames)
        pairs = zip(self.controllers, moment.controllers, *told, strict=True)
        return moment._like([one.resumed(then, passed, *here) for one, then, *here in pairs])

    def _like(self, controllers: list[MultimodalController]) -> Self:
        other = copy.copy(self)
        other.controllers = controllers
        return other


class _Parts:
    """What is told of a batch of robots, divided among them."""

    def __init__(self, batch: Sequence[int]) -> None:
        self.batch, self._robots = tuple(batch), list(np.ndindex(*batch))

    def joined(self, values: Sequence[Tensor]) -> Tensor:
        """Values (...) of each robot as those of the batch."""
        return torch.stack([*values]).reshape(*self.batch, *values[0].shape)

    def of_joints(self, joints: Any) -> list[Tensor | None]:
        """Of each robot (n_joints,); None if nothing was measured.

        Raises
        ------
        ShapeError
            If there are more or fewer robots.
        """
        if joints is None:
            return [None] * len(self._robots)
        tensor = torch.as_tensor(joints)
        if tensor.shape[:-1] != self.batch:
            raise ShapeError(
                f"the skill began with robots of shape {self.batch}, now there are joints of "
                f"shape {tuple(tensor.shape)}: begin it anew for other robots"
            )
        return [tensor[robot] for robot in self._robots]

    def of_frames(self, frames: Mapping[str, Any] | None) -> list[Any]:
        """Of each robot: a mapping of str to its pose, or None."""
        if frames is None:
            return [None] * len(self._robots)
        poses = {name: self._of_frame(name, frame) for name, frame in frames.items()}
        return [
            {name: each[number] for name, each in poses.items()}
            for number in range(len(self._robots))
        ]

    def _of_frame(self, name: str, frame: Any) -> list[Any]:
        try:
            if frame is None:
                return [None] * len(self._robots)
            if not isinstance(frame, Frame):
                poses = torch.as_tensor(frame)
                return list(poses.expand(*self.batch, poses.shape[-1]).flatten(0, -2))
            whole = frame.expand(self.batch)
            return [whole[robot] for robot in self._robots]
        except RuntimeError as error:
            raise ShapeError(
                f"the skill began with robots of shape {self.batch}, frame {name!r} now has "
                f"another: {error}"
            ) from error


def _silent(model: TaskParameterizedGMM) -> TaskParameterizedGMM:
    """The model without warnings: who asks for the mode that is chosen will have them."""
    model = copy.copy(model)
    model.plausibility = "ignore"
    return model


def _novelty(model: TaskParameterizedGMM, situation: Situation, midway: bool = False) -> float:
    """Of a situation to one mode, where it begins; 0 if it does not know what it was shown.

    Who begins in the middle of the skill stands where nobody starts, which says nothing.
    """
    if model.summary_ is None:
        return 0.0
    situation = situation.reordered(model.kinematics_.joint_names)
    complete = model._completed(situation.joints, situation.frames)
    first = {n: f[0] if f.batch_shape else f for n, f in complete.items()}
    joints = torch.full_like(situation.joints, torch.nan) if midway else situation.joints
    return float(model.summary_.novelty(joints, first))


def _recorded(situation: Situation, time: Tensor) -> Tensor | None:
    """When poses of a situation's frames were recorded, if some move."""
    if situation.frames_time is not None or not any(
        frame.batch_shape for frame in situation.frames.values()
    ):
        return situation.frames_time
    return time if situation.time is None else situation.time


def _moved(before: Mapping[str, Frame], now: Mapping[str, Frame]) -> bool:
    """Whether a frame is elsewhere, by more than situations that are the same differ."""
    if before.keys() != now.keys():
        return True
    for name, frame in now.items():
        old = before[name]
        far = (frame.position - old.position).norm(dim=-1).max()
        back = quaternions.conjugate(old.orientation)
        turned = (
            quaternions.log(quaternions.product(back, frame.orientation)).norm(dim=-1).max()
        )
        if far > ALIKE["place"] or turned > ALIKE["turn"]:
            return True
    return False

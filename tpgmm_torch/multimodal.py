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
from tpgmm_torch.constraints import Interval, Options, check_parameters
from tpgmm_torch.control.clocks import Clock, parse_clock
from tpgmm_torch.control.command import Command
from tpgmm_torch.data.affine import Affine
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration, Situation, check_demonstrations
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, ModelFileError, NotFittedError, ShapeError
from tpgmm_torch.novelty import ALIKE
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
        (:class:`~tpgmm_torch.novelty.Novelty`).
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
    ) -> MultimodalController:
        """The skill, to be run tick by tick, in the mode that suits now.

        Parameters
        ----------
        joints : array-like of shape (n_joints,)
            The start posture of one robot; others have a controller of their own.
        frames : mapping of str to Frame, optional
            Object poses; a step may be given others.
        clock : Clock or str, default="localizing"
        **settings
            Further ones of :meth:`TaskParameterizedGMM.controller`.

        Raises
        ------
        ShapeError, DataError, NotFittedError, UnknownNameError
            As there, and if there are several robots.
        """
        self._check_fitted()
        clock = parse_clock(clock)
        return MultimodalController(self, joints, frames or {}, clock, settings)

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
        [first, *others] = models
        if any(
            other.kinematics_.joint_names != first.kinematics_.joint_names for other in others
        ):
            raise ModelFileError(f"the modes in {path} are of different robots")
        multimodal = cls(clone(first), count)
        multimodal.models_, multimodal.mode_selection_ = models, None
        multimodal.weights_, multimodal.limits_, multimodal.labels_ = (
            numbers[name].numpy() for name in ("weights", "limits", "labels")
        )
        return multimodal

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
            self._excess(mode, time, motion.joints, one.frames_at(time))
            for one, motion in zip(tried, motions, strict=True)
        ]

    def _excess(
        self, mode: int, time: Tensor, joints: Tensor, frames: Mapping[str, Frame]
    ) -> float:
        """By how much less likely than any demonstration a motion is in its worst moment."""
        model = self.models_[mode]
        complete = model._completed(joints[0], frames)
        motion = Demonstration(time, joints, complete, model.kinematics_.joint_names)
        return max(float(model.surprise([motion])[0].max() - self.limits_[mode]), 0.0)

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
    joints : array-like of shape (n_joints,)
        The start posture.
    frames : mapping of str to Frame
        Poses of the objects until others are told.
    clock : Clock
    settings : mapping
        Further ones of :meth:`TaskParameterizedGMM.controller`.

    Attributes
    ----------
    mode : int
        That runs.
    choice : ModeChoice
        Why: the last comparison, the present posture included.
    controller : Controller
        Of the mode that runs, with everything that it tells.
    """

    def __init__(
        self,
        model: MultimodalTaskParameterizedGMM,
        joints: Any,
        frames: Mapping[str, Frame],
        clock: Clock,
        settings: Mapping[str, Any],
    ) -> None:
        start = model.models_[0].kinematics_.joint_tensor(joints)
        if start.ndim != 1:
            raise ShapeError(
                f"each robot goes its own way: a controller is for one start posture "
                f"(n_joints,), got {tuple(start.shape)}; make one for each"
            )
        self._model, self._clock, self._settings = model, clock, dict(settings)
        self._start, self._since = start, 0.0
        [self.choice] = model.choose(Situation(start, frames))
        self._misfit, self.mode = self.choice.misfit, self.choice.mode
        self.controller = model.models_[self.mode].controller(
            start, frames, clock=clock, **settings
        )
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
        dt: float,
        joints: Any = None,
        frames: Mapping[str, Any] | None = None,
        **more: Any,
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
        **more
            As for :meth:`Controller.step`.
        """
        command = self.controller.step(dt, joints, frames, **more)
        self._since += dt
        if self._model.n_modes_ > 1 and self._since >= LOOK and not self.finished:
            self._since = 0.0
            self._compare(joints)
        return command

    def _compare(self, joints: Any) -> None:
        """Go over to another mode from the next step on, if it is far likelier."""
        model, places = self._model, dict(self.controller.holding.frames)
        here = (
            self.reference
            if joints is None
            else model.models_[0].kinematics_.joint_tensor(joints)
        )
        here = torch.where(here.isnan(), self.reference, here)
        times = [self._progress(k) for k in range(model.n_modes_)]
        now = Situation(here, places)
        if _moved(self._seen, places):
            self._seen = places
            self._misfit = np.array(
                [model._misfits(k, [now], at)[0] for k, at in enumerate(times)]
            )
        there = [
            model._excess(k, here.new_tensor([at]), here[None], places)
            for k, at in enumerate(times)
        ]
        begun = Situation(self._start, places)
        novelty = np.array([_novelty(one, begun) for one in model.models_])
        self.choice = ModeChoice.of(model.weights_, novelty, self._misfit + np.array(there))
        chances = self.choice.probabilities
        if chances[self.choice.mode] > CLEARLY * chances[self.mode]:
            self._switch(self.choice.mode, times[self.choice.mode], places)

    def _switch(self, mode: int, time: float, frames: Mapping[str, Frame]) -> None:
        """From the next step on the robot goes another way."""
        skill = _silent(self._model.models_[mode])
        other = skill.controller(self._start, frames, clock=self._clock, **self._settings)
        regression, end = skill.regression(), float(skill.time_[-1])
        progress = self._clock.start(regression, time, end, self.reference, frames)
        self.controller, self.mode = self.controller.switched(other, progress), mode

    def _progress(self, mode: int) -> float:
        """The present progress, as the time of a mode [s]."""
        now, grid = self._model.models_[self.mode].time_, self._model.models_[mode].time_
        share = (float(self.time) - float(now[0])) / float(now[-1] - now[0])
        return float(grid[0]) + share * float(grid[-1] - grid[0])


def _silent(model: TaskParameterizedGMM) -> TaskParameterizedGMM:
    """The model without warnings: who asks for the mode that is chosen will have them."""
    model = copy.copy(model)
    model.plausibility = "ignore"
    return model


def _novelty(model: TaskParameterizedGMM, situation: Situation) -> float:
    """Of a situation to one mode, where it begins; 0 if it does not know what it was shown."""
    if model.shown_ is None or model.shown_.novelty is None:
        return 0.0
    situation = situation.reordered(model.kinematics_.joint_names)
    complete = model._completed(situation.joints, situation.frames)
    first = {n: f[0] if f.batch_shape else f for n, f in complete.items()}
    return float(model.shown_.novelty.ratio(situation.joints, first))


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
        if isinstance(frame, Affine) or isinstance(old, Affine):  # which is no pose
            continue
        far = (frame.position - old.position).norm(dim=-1).max()
        back = quaternions.conjugate(old.orientation)
        turned = (
            quaternions.log(quaternions.product(back, frame.orientation)).norm(dim=-1).max()
        )
        if far > ALIKE["place"] or turned > ALIKE["turn"]:
            return True
    return False

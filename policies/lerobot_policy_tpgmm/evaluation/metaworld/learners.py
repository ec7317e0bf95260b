"""What learns a task of Meta-World from a few episodes, each with one setting for all tasks."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from lerobot_policy_tpgmm.environments.metaworld.demonstrations import Recorded
from lerobot_policy_tpgmm.environments.metaworld.hand import (
    FPS,
    FRAMES,
    JOINTS,
    metaworld_operators,
    metaworld_robot,
)
from lerobot_policy_tpgmm.evaluation.metaworld.nearness import Nearness
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.alignment import LinearTimeNormalization
from tpgmm_torch.alignment.text import parse_alignment

__all__ = ["LEARNERS", "Actor", "Perceptron", "TaskParameterized", "switches"]

Rows = NDArray[np.float64]
#: A change of the wanted opening by more than this, in a step, is a gripper that switches.
SWITCH = 0.2
#: An object is there if it is ever further than this from the origin [m].
ABSENT = 1e-6


class Actor(Protocol):
    """What acts in :class:`MetaworldStateEnv`, with actions of one ``control``."""

    control: str

    def begin(self, first: Rows) -> None:
        """Hear the first observations (B, 25) of the episodes to come, in their order."""

    def act(self, episode: int, step: int, observed: Rows) -> Rows:
        """The action (4,) after an observation (25,)."""


def switches(references: Rows) -> list[int]:
    """The steps at which the wanted opening, the last column of references, jumps."""
    jumps = np.abs(np.diff(references[:, -1])) > SWITCH
    return [int(i) + 1 for i in np.flatnonzero(jumps)]


def smoothed(references: Rows, width: int) -> Rows:
    """References whose positions are means over ``width`` steps; the last column stays."""
    places = np.pad(references[:, :-1], ((width // 2, width // 2), (0, 0)), mode="edge")
    means = sliding_window_view(places, width, axis=0).mean(axis=-1)
    return np.column_stack((means, references[:, -1]))


def with_switches(episodes: Sequence[Recorded], smoothing: int) -> list[Demonstration]:
    """Demonstrations with the switches of the gripper as events, if all have as many."""
    found = [switches(episode.references) for episode in episodes]
    demonstrations = [
        replace(one, references=smoothed(one.references, smoothing)).demonstration()
        for one in episodes
    ]
    if len({len(steps) for steps in found}) > 1:
        return demonstrations
    return [
        replace(one, events={f"switch {i + 1}": step / FPS for i, step in enumerate(steps)})
        for one, steps in zip(demonstrations, found, strict=True)
    ]


def present(episodes: Sequence[Recorded]) -> list[str]:
    """The frames that are somewhere: Meta-World puts objects that are not at the origin."""
    poses = np.stack([one.observed[0, len(JOINTS) :].reshape(-1, 7) for one in episodes])
    there = np.abs(poses[..., :3]).max((0, 2)) > ABSENT
    return [name for name, is_there in zip(FRAMES, there, strict=True) if is_there]


@dataclass(frozen=True)
class TaskParameterized:
    """TP-GMM behind LeRobot's interface.

    Parameters
    ----------
    smoothing : int
        References of the hand are moving means over so many steps, an odd number. The experts'
        gains make the hand's target swing by centimetres, ten times a second, out of step in
        different demonstrations: their mean would say nothing.
    steps_per_component : int
        How much of the skill one Gaussian is for, of at least ``fewest``.
    fewest : int
    alignment : str
        As :func:`~tpgmm_torch.alignment.text.parse_alignment` reads it; linear where it needs
        events and the grippers switch differently often.
    nearness : Nearness or None
        The prior on covariances.
    clock : str or None
        Of the policy that reads the hand at every step; None plays what it would do from the
        first observation on.
    options : dict
        Of the estimator.
    """

    smoothing: int = 9
    steps_per_component: int = 6
    fewest: int = 8
    alignment: str = "events+dtw"
    nearness: Nearness | None = field(default_factory=Nearness)
    clock: str | None = None
    options: dict[str, Any] = field(default_factory=dict)

    name = "tpgmm"

    def fit(self, episodes: Sequence[Recorded], seed: int) -> TaskParameterizedActor:
        """Learn from episodes; ``seed`` is that of EM."""
        robot = metaworld_robot()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # parts without motion stay on linear time
            demonstrations = self._aligned(with_switches(episodes, self.smoothing), robot)
            n_steps = len(demonstrations[0])
            model = TaskParameterizedGMM(
                max(self.fewest, n_steps // self.steps_per_component),
                metaworld_operators(present(episodes)),
                robot,
                **{
                    "blend": 0.0,
                    "holds": [],
                    "plausibility": "ignore",
                    "robust": False,
                    "random_state": seed,
                    **self.options,
                },
            ).fit(demonstrations)
        if self.nearness is not None:
            model = self.nearness.applied(model, len(episodes))
        frames = {
            name: list(range(7 * i, 7 * i + 7))
            for i, name in enumerate(FRAMES)
            if name in model.frame_names_
        }
        policy = TPGMMPolicy.from_estimator(
            model,
            fps=FPS,
            environment_names=[f"e{i}" for i in range(7 * len(FRAMES))],
            frames=frames,
            follow_frames=False,
            closed_loop=self.clock is not None,
            clock=self.clock or "even",
            smoothing=None,
            chunk_size=len(model.time_),
            largest_start_gap=None,
        )
        return TaskParameterizedActor(policy, self.clock is None)

    def _aligned(self, demonstrations: list[Demonstration], robot: Any) -> list[Demonstration]:
        if len(demonstrations) == 1:
            return demonstrations
        method = self.alignment
        if method.startswith("events") and not demonstrations[0].events:
            method = "dtw" if method.endswith("dtw") else "linear"
        try:
            alignment = parse_alignment(method, robot) or LinearTimeNormalization(robot=robot)
            return list(alignment.fit_transform(demonstrations))
        except ValueError:  # a switch at the very beginning or end is no anchor
            return list(LinearTimeNormalization(robot=robot).fit_transform(demonstrations))


class TaskParameterizedActor:
    """The policy of :class:`TaskParameterized`, and the observations that it is told.

    Parameters
    ----------
    policy : TPGMMPolicy
    chunked : bool
        Whether it says all actions of an episode from the first observation.
    """

    control = "reference"

    def __init__(self, policy: TPGMMPolicy, chunked: bool) -> None:
        self.policy, self.chunked = policy, chunked
        self._plan: Rows = np.empty((0, 0, len(JOINTS)))

    def begin(self, first: Rows) -> None:
        """Hear the first observations."""
        self.policy.reset()
        if self.chunked:
            self._plan = self.policy.predict_action_chunk(_batch(first)).numpy()

    def act(self, episode: int, step: int, observed: Rows) -> Rows:
        """The next reference."""
        if self.chunked:
            plan = self._plan[episode]
            return np.asarray(plan[min(step, len(plan) - 1)])
        if step == 0:
            self.policy.reset()
        return np.asarray(self.policy.select_action(_batch(observed[None]))[0])


def _batch(observed: Rows) -> dict[str, torch.Tensor]:
    values = torch.from_numpy(observed.astype(np.float32))
    return {OBS_STATE: values[:, : len(JOINTS)], OBS_ENV_STATE: values[:, len(JOINTS) :]}


@dataclass(frozen=True)
class Perceptron:
    """A multilayer perceptron from the present state to Meta-World's action.

    Parameters
    ----------
    hidden : tuple of int
        Units of the hidden layers.
    alpha : float
        Weight of the penalty on squared weights.
    updates : int
        Steps of gradient descent, whatever the number of demonstrations.
    relative : bool
        Whether it is told, too, where the hand is as seen from each object.
    """

    hidden: tuple[int, ...] = (256, 256)
    alpha: float = 1e-3
    updates: int = 3000
    relative: bool = True

    name = "perceptron"

    def fit(self, episodes: Sequence[Recorded], seed: int) -> PerceptronActor:
        """Learn from episodes; ``seed`` is that of the weights."""
        x = self.features(np.concatenate([episode.observed for episode in episodes]))
        y = np.concatenate([episode.actions for episode in episodes])
        batch = min(200, len(x))
        epochs = max(1, round(self.updates * batch / len(x)))
        network = MLPRegressor(
            hidden_layer_sizes=self.hidden, alpha=self.alpha, batch_size=batch, tol=0.0,
            max_iter=epochs, n_iter_no_change=epochs, random_state=seed,
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # the budget is what ends it
            pipeline = make_pipeline(StandardScaler(), network).fit(x, y)
        return PerceptronActor(self, pipeline)

    def features(self, observed: Rows) -> Rows:
        """Its inputs (T, n) from observations (T, 25)."""
        hand, poses = observed[:, : len(JOINTS)], observed[:, len(JOINTS) :]
        places = poses.reshape(len(observed), -1, 7)[..., :3]
        inputs = [hand, places.reshape(len(observed), -1)]
        if self.relative:
            inputs.append((places - hand[:, None, :3]).reshape(len(observed), -1))
        return np.concatenate(inputs, axis=1)


class PerceptronActor:
    """What a :class:`Perceptron` learned."""

    control = "displacement"

    def __init__(self, settings: Perceptron, pipeline: Any) -> None:
        self.settings, self.pipeline = settings, pipeline

    def begin(self, first: Rows) -> None:
        """Nothing: it looks at the present alone."""

    def act(self, episode: int, step: int, observed: Rows) -> Rows:
        """The next displacement and effort."""
        action = self.pipeline.predict(self.settings.features(observed[None]))[0]
        return np.clip(action, -1.0, 1.0)


#: By their names in files and on the command line.
LEARNERS: dict[str, TaskParameterized | Perceptron] = {
    learner.name: learner for learner in (TaskParameterized(), Perceptron())
}

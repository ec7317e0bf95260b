"""Learners of tasks of Meta-World from a few episodes, each with one setting for all tasks."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from numpy.typing import NDArray

from lerobot_env_bimanual.metaworld.demonstrations import Recorded
from lerobot_env_bimanual.metaworld.hand import (
    FPS,
    FRAMES,
    JOINTS,
    metaworld_operators,
    metaworld_robot,
)
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from lerobot_policy_tpgmm.settings import ControlConfig
from tpgmm_evaluation.metaworld.nearness import Nearness
from tpgmm_evaluation.metaworld.networks import NETWORKS, Network, Perceptron
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping, EventAlignment
from tpgmm_torch.skills.sequence import Sequence as SkillSequence
from tpgmm_torch.structure.fit_parts import fit_parts
from tpgmm_torch.training.hold_detection import with_holds

Rows = NDArray[np.float64]
#: A change of the wanted opening by more than this, in a step, is a gripper that switches.
SWITCH = 0.2
#: Switches that are nearer to each other, or to the beginning or end [steps], are no events:
#: what is between them is too little to learn from.
APART = 3
#: The opening is a force, which may change from all to nothing within a step: bounds of its
#: acceleration and jerk that leave room for that [1/s^2, 1/s^3].
ACCELERATION, JERK = 2.0 * FPS**2, 4.0 * FPS**3
#: Fingers need so long for nine tenths of their way, at whatever pace the hand moves [s]: the
#: median of experts' first switches, between 0.15 and 0.24 in each task of the tuned half.
CLOSING = 0.19
#: An object is there if it is ever further than this from the origin [m].
ABSENT = 1e-6


class Actor(Protocol):
    """Policy in :class:`MetaworldStateEnv`, with actions of one ``control``.

    ``outcome`` says why its training ended.
    """

    control: str
    outcome: str

    def begin(self, first: Rows) -> None:
        """Take the first observations (B, 25) of the episodes to come, in their order."""

    def act(self, episode: int, step: int, observed: Rows) -> Rows:
        """Return the action (4,) after an observation (25,)."""


def switches(references: Rows) -> list[int]:
    """Find the steps at which the wanted opening, the last column of references, jumps."""
    jumps = np.abs(np.diff(references[:, -1])) > SWITCH
    return [int(i) + 1 for i in np.flatnonzero(jumps)]


def apart(references: Rows) -> list[int]:
    """Find switches that are ``APART`` from the one before, the beginning and the end."""
    kept = [0]
    for step in switches(references):
        if step - kept[-1] >= APART and step + APART <= len(references):
            kept.append(step)
    return kept[1:]


def drop_slow(episodes: Sequence[Recorded], longest: float) -> list[Recorded]:
    """Drop episodes that take more than ``longest`` times the shortest of them.

    Experts try again where they missed, and that takes time. A mean over episodes in which
    the hand comes once and in which it comes twice comes neither once nor twice.
    """
    shortest = min(len(episode.references) for episode in episodes)
    return [shown for shown in episodes if len(shown.references) <= longest * shortest]


def slow_down(episodes: Sequence[Recorded], pace: float) -> list[Demonstration]:
    """Slow demonstrations down to ``pace`` of their speed; common switches are events.

    Fingers do not slow down with the hand. Their commands come later, so that they have
    closed where the experts' had. Switches count from the first: some experts take a
    second grip, and others do not need it.
    """
    later = round(CLOSING * (1 - pace) * FPS)
    episodes = [_delay_gripper(episode, later) for episode in episodes]
    demonstrations = [episode.demonstration() for episode in episodes]
    found = [apart(episode.references) for episode in episodes]
    return [
        replace(
            shown,
            time=shown.time / pace,
            events={
                f"switch {i + 1}": step / FPS / pace
                for i, step in enumerate(steps[: min(map(len, found))])
            },
        )
        for shown, steps in zip(demonstrations, found, strict=True)
    ]


def _delay_gripper(episode: Recorded, later: int) -> Recorded:
    """Delay the wanted opening by some steps."""
    references = episode.references.copy()
    steps = np.arange(len(references))
    references[:, -1] = references[np.maximum(steps - later, 0), -1]
    return replace(episode, references=references)


def present(episodes: Sequence[Recorded]) -> list[str]:
    """Find the frames that exist: Meta-World puts objects that do not at the origin."""
    poses = np.stack([shown.observed[0, len(JOINTS) :].reshape(-1, 7) for shown in episodes])
    there = np.abs(poses[..., :3]).max((0, 2)) > ABSENT
    return [name for name, is_there in zip(FRAMES, there, strict=True) if is_there]


@dataclass(frozen=True)
class TaskParameterized:
    """TP-GMM behind LeRobot's interface.

    Parameters
    ----------
    pace : float
        The speed of the reproduction, as a share of the demonstrations'. The experts move the
        target as fast as Meta-World lets them: at their own pace, what differs from them falls
        behind, and cuts the corners and the depth of a push.
    longest : float
        What takes more than this multiple of the shortest demonstration is not learned from.
    steps_per_component : int
        How much of the skill one Gaussian is for, of at least ``fewest``.
    fewest : int
        Gaussians at least.
    warping : dict
        Of :class:`~tpgmm_torch.alignment.DynamicTimeWarping`, between switches of the gripper:
        its defaults are for motions of several seconds, these last about one. The default
        compares where the target is, whose speed is always the same.
    nearness : Nearness or None
        The prior on covariances.
    clock : str or None
        Of the policy that reads the hand at every step; None plays what it would do from the
        first observation on.
    options : dict
        Of the estimator.
    """

    pace: float = 0.8
    longest: float = 1.4
    steps_per_component: int = 3
    fewest: int = 8
    warping: dict[str, Any] = field(
        default_factory=lambda: {
            "features": ["hand"],
            "penalty": 0.3,
            "smoothing": 0.04,
            "min_gain": None,
        }
    )
    nearness: Nearness | None = field(default_factory=Nearness)
    clock: str | None = None
    options: dict[str, Any] = field(default_factory=dict)

    name = "tpgmm"

    def fit(
        self, episodes: Sequence[Recorded], seed: int, validation: Sequence[Recorded] = ()
    ) -> TaskParameterizedActor:
        """Learn from episodes; ``seed`` is that of EM."""
        robot = metaworld_robot()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            learned = drop_slow(episodes, self.longest)
            demonstrations = self.align(slow_down(learned, self.pace), robot)
            n_steps = len(demonstrations[0])
            model = TaskParameterizedGMM(
                max(self.fewest, n_steps // self.steps_per_component),
                metaworld_operators(present(episodes)),
                robot,
                **{"random_state": seed, **self.options},
            )
            shown, cuts = with_holds(demonstrations, ()), list(demonstrations[0].events)
            # a gripper that closes is a step, which Gaussians across it would smear
            parts: Any = fit_parts(model, shown, cuts).skills
        if self.nearness is not None:
            parts = tuple(self.nearness.apply(part, len(learned)) for part in parts)
        skill = SkillSequence(parts, fade=1.5 / FPS / self.pace)  # parts are a step apart
        frames = {
            name: list(range(7 * i, 7 * i + 7))
            for i, name in enumerate(FRAMES)
            if name in skill.frame_names
        }
        policy = TPGMMPolicy.from_estimator(
            skill,
            fps=FPS,
            environment_names=[f"e{i}" for i in range(7 * len(FRAMES))],
            frames=frames,
            chunk_size=round(float(skill.time[-1] - skill.time[0]) * FPS) + 1,
            control=ControlConfig(
                blend=0.0,
                follow_frames=False,
                closed_loop=self.clock is not None,
                clock=self.clock or "even",
                smoothing=None,
                largest_start_gap=None,
                acceleration={JOINTS[-1]: ACCELERATION},
                jerk={JOINTS[-1]: JERK},
            ),
        )
        return TaskParameterizedActor(policy, self.clock is None)

    def align(self, demonstrations: list[Demonstration], robot: Any) -> list[Demonstration]:
        """Align demonstrations in time, between the switches that they have in common."""
        if len(demonstrations) == 1:
            return demonstrations
        warping = DynamicTimeWarping(robot=robot, **self.warping)
        if not demonstrations[0].events:
            return list(warping.fit_transform(demonstrations))
        events = EventAlignment(duration="median", within=warping, robot=robot)
        return list(events.fit_transform(demonstrations))


class TaskParameterizedActor:
    """The policy of :class:`TaskParameterized`, and the observations that it gets.

    Parameters
    ----------
    policy : TPGMMPolicy
        As learned from the demonstrations.
    chunked : bool
        Whether it says all actions of an episode from the first observation.
    """

    control = "reference"
    outcome = "learned by expectation-maximisation"

    def __init__(self, policy: TPGMMPolicy, chunked: bool) -> None:
        self.policy, self.chunked = policy, chunked
        self._plan: Rows = np.empty((0, 0, len(JOINTS)))

    def begin(self, first: Rows) -> None:
        """Take the first observations."""
        self.policy.reset()
        if self.chunked:
            self._plan = self.policy.predict_action_chunk(_batch(first)).numpy()

    def act(self, episode: int, step: int, observed: Rows) -> Rows:
        """Return the next reference."""
        if self.chunked:
            plan = self._plan[episode]
            return np.asarray(plan[min(step, len(plan) - 1)])
        if step == 0:
            self.policy.reset()
        return np.asarray(self.policy.select_action(_batch(observed[None]))[0])


def _batch(observed: Rows) -> dict[str, torch.Tensor]:
    values = torch.from_numpy(observed.astype(np.float32))
    return {OBS_STATE: values[:, : len(JOINTS)], OBS_ENV_STATE: values[:, len(JOINTS) :]}


Learner = TaskParameterized | Perceptron | Network
#: By their names in files and on the command line.
LEARNERS: dict[str, Learner] = {
    learner.name: learner for learner in (TaskParameterized(), Perceptron(), *NETWORKS)
}


def settings_of(learner: Learner) -> dict[str, Any]:
    """Return all settings of a learner, as JSON holds them."""
    text = json.dumps(asdict(learner), default=lambda kind: kind.__name__)
    return dict(json.loads(text))

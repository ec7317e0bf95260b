"""A perceptron, and ACT and Diffusion Policy of LeRobot, on states of Meta-World."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from lerobot_env_bimanual.metaworld.demonstrations import Recorded
from lerobot_env_bimanual.metaworld.hand import FPS, JOINTS
from tpgmm_evaluation.baselines import RECIPES, Recipe, Training, train
from tpgmm_evaluation.policies.episodes import Episodes, policy_stride

Rows = NDArray[np.float64]


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
        Whether inputs also say where the hand is as seen from each object.
    """

    hidden: tuple[int, ...] = (256, 256)
    alpha: float = 1e-3
    updates: int = 3000
    relative: bool = True

    name = "perceptron"

    def fit(
        self, episodes: Sequence[Recorded], seed: int, validation: Sequence[Recorded] = ()
    ) -> PerceptronActor:
        """Learn from episodes; ``seed`` is that of the weights."""
        observed = np.concatenate([episode.observed for episode in episodes])
        x = features(observed, relative=self.relative)
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


class PerceptronActor:
    """Policy that a :class:`Perceptron` learned."""

    control = "displacement"
    outcome = "its updates were done"

    def __init__(self, settings: Perceptron, pipeline: Any) -> None:
        self.settings, self.pipeline = settings, pipeline

    def begin(self, first: Rows) -> None:
        """Do nothing: it looks at the present alone."""

    def act(self, episode: int, step: int, observed: Rows) -> Rows:
        """Return the next displacement and effort."""
        x = features(observed[None], relative=self.settings.relative)
        action = self.pipeline.predict(x)[0]
        return np.clip(action, -1.0, 1.0)


def features(observed: Rows, *, relative: bool) -> Rows:
    """Compute inputs of a network (T, n) from observations (T, 25): the hand and the objects.

    With ``relative``, also the places of the objects as seen from the hand.
    """
    hand, poses = observed[:, : len(JOINTS)], observed[:, len(JOINTS) :]
    places = poses.reshape(len(observed), -1, 7)[..., :3]
    inputs = [hand, places.reshape(len(observed), -1)]
    if relative:
        inputs.append((places - hand[:, None, :3]).reshape(len(observed), -1))
    return np.concatenate(inputs, axis=1)


@dataclass(frozen=True)
class Network:
    """A policy of LeRobot that gradient descent trains until it stops improving.

    Parameters
    ----------
    name : str
        On the command line.
    recipe : Recipe
        How it is built and trained.
    control : {"reference", "displacement"}
        Its actions: where the hand's target shall be, or Meta-World's own.
    budget : float
        Seconds of the processor after which training ends in any case.
    """

    name: str
    recipe: Recipe
    control: str = "displacement"
    budget: float = 600.0

    def fit(
        self, episodes: Sequence[Recorded], seed: int, validation: Sequence[Recorded]
    ) -> NetworkActor:
        """Learn from episodes; ``seed`` is that of weights, batches and noise.

        Parameters
        ----------
        validation : sequence of Recorded
            Episodes that nothing is learned from: training ends when the error on them stops
            falling, and the weights with the least are kept.
        """
        training, held_out = (self._rows(some) for some in (episodes, validation))
        result = train(self.recipe, training, held_out, seed=seed, budget=self.budget)
        return NetworkActor(self, result)

    def observation(self, observed: Rows) -> tuple[torch.Tensor, torch.Tensor]:
        """Split observations (T, 25) into state (T, 4) and environment state (T, n)."""
        rows = torch.from_numpy(features(observed, relative=True)).float()
        return rows[:, : len(JOINTS)], rows[:, len(JOINTS) :]

    def _rows(self, episodes: Sequence[Recorded]) -> Episodes:
        parts = []
        for shown in episodes:
            actions = shown.references if self.control == "reference" else shown.actions
            parts.append((*self.observation(shown.observed), torch.from_numpy(actions)))
        return Episodes.join(FPS, parts)


class NetworkActor:
    """A trained :class:`Network`; an action holds until the policy's next step."""

    def __init__(self, settings: Network, training: Training) -> None:
        self.settings, self.training = settings, training
        self.control, self.outcome = settings.control, training.outcome
        self._stride = policy_stride(FPS, training.fps)
        self._action: Rows = np.empty(0)

    def begin(self, first: Rows) -> None:
        """Do nothing: it looks at the present."""

    @torch.inference_mode()
    def act(self, episode: int, step: int, observed: Rows) -> Rows:
        """Return the next action."""
        policy, (before, after) = self.training.policy, self.training.processors
        if step == 0:
            policy.reset()
        if step % self._stride == 0:
            state, environment = self.settings.observation(observed[None])
            seen = before({OBS_STATE: state, OBS_ENV_STATE: environment})
            self._action = after(policy.select_action(seen))[0].numpy()
        return self._action


def _recipe(kind: str, check_every: int, **options: Any) -> Recipe:
    """Make the recipe of the other benchmarks smaller, and at Meta-World's rate."""
    recipe = RECIPES[kind]
    options = {**recipe.options, **options}
    return replace(recipe, options=options, rate=FPS, check_every=check_every)


#: Chosen on tasks of the half that is for tuning.
NETWORKS = (
    Network("act", _recipe("act", 100, dim_model=64, dim_feedforward=256)),
    Network("diffusion", _recipe("diffusion", 200, down_dims=(32, 64))),
)

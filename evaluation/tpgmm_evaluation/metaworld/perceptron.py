"""A perceptron on states of Meta-World, and what networks are told of them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from lerobot_env_bimanual.metaworld.demonstrations import Recorded
from lerobot_env_bimanual.metaworld.hand import JOINTS

__all__ = ["Perceptron", "features"]

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
        Whether it is told, too, where the hand is as seen from each object.
    """

    hidden: tuple[int, ...] = (256, 256)
    alpha: float = 1e-3
    updates: int = 3000
    relative: bool = True

    name = "perceptron"

    def fit(self, episodes: Sequence[Recorded], seed: int) -> PerceptronActor:
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
    """What a :class:`Perceptron` learned."""

    control = "displacement"
    outcome = "its updates were done"

    def __init__(self, settings: Perceptron, pipeline: Any) -> None:
        self.settings, self.pipeline = settings, pipeline

    def begin(self, first: Rows) -> None:
        """Nothing: it looks at the present alone."""

    def act(self, episode: int, step: int, observed: Rows) -> Rows:
        """The next displacement and effort."""
        x = features(observed[None], relative=self.settings.relative)
        action = self.pipeline.predict(x)[0]
        return np.clip(action, -1.0, 1.0)


def features(observed: Rows, *, relative: bool) -> Rows:
    """What a network is told (T, n) of observations (T, 25): the hand, and where objects are.

    With ``relative``, also the places of the objects as seen from the hand.
    """
    hand, poses = observed[:, : len(JOINTS)], observed[:, len(JOINTS) :]
    places = poses.reshape(len(observed), -1, 7)[..., :3]
    inputs = [hand, places.reshape(len(observed), -1)]
    if relative:
        inputs.append((places - hand[:, None, :3]).reshape(len(observed), -1))
    return np.concatenate(inputs, axis=1)

"""ACT and Diffusion Policy, trained from memory until they stop improving."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.policies import ACTConfig, DiffusionConfig, PreTrainedPolicy
from lerobot.policies.factory import get_policy_class
from lerobot.processor import make_default_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from lerobot_policy_tpgmm.configuration_tpgmm import state_features
from tpgmm_evaluation.policies.elapsed_time import tell_time
from tpgmm_evaluation.policies.episodes import Episodes, Windows, policy_stride
from tpgmm_torch.exceptions import DataError

#: A column that varies less than this over the training set is constant: dividing by its
#: spread would blow up rounding errors [rad, m].
CONSTANT = 1e-4
#: Windows of the held-out episodes on which a policy is validated.
CHECKED = 256


@dataclass(frozen=True)
class Recipe:
    """How a baseline is built and trained.

    Parameters
    ----------
    config : type
        Configuration of the policy.
    options : mapping
        Its fields that differ from the defaults.
    normalization : str
        LeRobot's mode for states and actions.
    rate : int
        Steps per second of the policy.
    phase : bool
        Whether it is informed of the time; episodes should then run on a common clock.
    jitter : float
        Standard deviation of the noise that is added to states in training, in units of the
        normalised state: else the posture betrays which demonstration it is from.
    averaging : float
        Decay of the moving average of the weights that is evaluated and kept.
    check_every : int
        Training steps between two validations.
    patience : int
        Validations without an improvement by 1 % after which the learning rate falls to a
        third; it also does after 60 % and 84 % of the budget.
    falls : int
        How often it falls before training ends.
    """

    config: type[PreTrainedConfig]
    options: Mapping[str, Any]
    normalization: str
    rate: int = 10
    phase: bool = False
    batch_size: int = 32
    jitter: float = 0.0
    averaging: float = 0.995
    check_every: int = 200
    patience: int = 5
    falls: int = 2

    def describe(self) -> dict[str, Any]:
        """Return everything as plain values, for the record."""
        return {**asdict(self), "config": self.config.__name__, "options": dict(self.options)}


ACT = Recipe(
    ACTConfig,
    {
        "chunk_size": 16,
        "n_action_steps": 8,
        "dim_model": 128,
        "n_heads": 4,
        "dim_feedforward": 512,
        "n_encoder_layers": 2,
        "use_vae": False,  # the demonstrations are of one kind: there is no style to encode
        "dropout": 0.0,
        "optimizer_lr": 1e-3,
    },
    "MEAN_STD",
)
#: The network as LeRobot sizes it, with its style variable: forty million weights, of which
#: one processor trains two steps in a second. LeRobot's learning rate is for 100,000 of them.
ACT_LARGE = Recipe(
    ACTConfig,
    {"chunk_size": 16, "n_action_steps": 8, "optimizer_lr": 1e-4},
    "MEAN_STD",
    batch_size=8,
    check_every=100,
)
DIFFUSION = Recipe(
    DiffusionConfig,
    {
        "down_dims": (64, 128),
        "horizon": 16,
        "n_obs_steps": 2,
        "n_action_steps": 8,
        "noise_scheduler_type": "DDIM",
        "num_inference_steps": 10,
        "prediction_type": "sample",  # of the noise, millimetres take far longer to learn
        "optimizer_lr": 1e-3,
    },
    "MIN_MAX",
)
PLAIN = {"act": ACT, "act-large": ACT_LARGE, "diffusion": DIFFUSION}
RECIPES = {
    name: recipe
    for kind, plain in PLAIN.items()
    for name, recipe in ((kind, plain), (f"{kind}-phase", replace(plain, phase=True)))
}


@dataclass
class Training:
    """A trained baseline and how it came about.

    Parameters
    ----------
    policy : PreTrainedPolicy
        The one with the least validation error.
    processors : (PolicyProcessorPipeline, PolicyProcessorPipeline)
        Before and after it.
    fps : int
        Its rate.
    recipe : dict
        How it was trained, for the record.
    curve : list of dict
        At each validation: ``step``, ``seconds`` of the processor, ``train_loss`` (mean since
        the last), ``validation_loss`` (the same function on held-out episodes) and
        ``validation_error`` (mean distance between predicted and demonstrated joint references
        over the steps that are executed [rad]).
    outcome : str
        Why training ended.
    """

    policy: PreTrainedPolicy
    processors: tuple[Any, Any]
    fps: int
    recipe: dict[str, Any] = field(default_factory=dict)
    curve: list[dict[str, float]] = field(default_factory=list)
    outcome: str = ""


def train(
    recipe: Recipe,
    training: Episodes,
    validation: Episodes,
    *,
    seed: int,
    budget: float,
) -> Training:
    """Train a baseline until its validation error has stopped falling.

    Parameters
    ----------
    training, validation : Episodes
        Of one rate, a multiple of the recipe's.
    seed : int
        Of weights, batches and noise.
    budget : float
        Seconds of the processor after which training ends in any case.

    Raises
    ------
    DataError
        If the episodes' rate is no multiple of the recipe's, or training diverges.
    """
    torch.manual_seed(seed)
    stride = policy_stride(training.fps, recipe.rate)
    if recipe.phase:
        training, validation = (episodes.with_time() for episodes in (training, validation))
    config = _configure(recipe, training)
    policy = get_policy_class(config.type)(config)
    processors = make_default_pre_post_processors(config, _statistics(training))
    preprocessor, postprocessor = processors
    result = Training(policy, processors, recipe.rate, recipe.describe())
    deltas = config.observation_delta_indices, config.action_delta_indices
    windows, held_out = (
        Windows(_normalize(episodes, preprocessor), episodes.bounds, stride, *deltas)
        for episodes in (training, validation)
    )
    rows = torch.linspace(0, len(held_out) - 1, CHECKED).long()
    scale = _action_scale(postprocessor, config)
    _Learner(recipe, result, windows, held_out.at(rows), scale).run(budget)
    if recipe.phase:
        tell_time(preprocessor, recipe.rate)
    return result


class _Learner:
    """Gradient descent with an average of the weights and a learning rate that falls."""

    def __init__(
        self,
        recipe: Recipe,
        result: Training,
        windows: Windows,
        held_out: dict[str, Tensor],
        scale: Tensor,
    ) -> None:
        self.recipe, self.result, self.policy = recipe, result, result.policy
        self.windows, self.held_out, self.scale = windows, held_out, scale
        preset = self.policy.config.get_optimizer_preset()
        self.optimizer = preset.build(self.policy.get_optim_params())
        self.average = deepcopy(self.policy).eval()
        # collecting them takes a sixth of a small network's step
        self.weights = [*self.policy.parameters()]
        self.averages = [*self.average.parameters()]
        self.steps = 0

    def run(self, budget: float) -> None:
        """Train; in the end the policy has the best of the average weights."""
        began = time.process_time()
        best, best_weights, waited, falls = math.inf, None, 0, 0
        while not self.result.outcome:
            point = self._measure_block(began)
            error, seconds = point["validation_error"], point["seconds"]
            waited = 0 if error < 0.99 * best else waited + 1
            if error < best:
                best, best_weights = error, deepcopy(self.average.state_dict())
            # towards the end of the budget the rate falls by itself, for the last refinement
            late = seconds > budget * (1 - 0.4 ** (falls + 1))
            if waited == self.recipe.patience or (late and falls < self.recipe.falls):
                falls, waited = falls + 1, 0
                self._lower_rate()
            self.result.outcome = self._outcome(falls, seconds, budget)
        if best_weights is None:
            raise DataError(f"training diverged: the validation error is {error}")
        self.policy.load_state_dict(best_weights)
        self.policy.eval()

    def _measure_block(self, began: float) -> dict[str, float]:
        """Train until the next validation; add its point to the curve."""
        losses = [self._step() for _ in range(self.recipe.check_every)]
        loss, error = self._validate()
        point = {
            "step": self.steps,
            "seconds": time.process_time() - began,
            "train_loss": sum(losses) / len(losses),
            "validation_loss": loss,
            "validation_error": error,
        }
        self.result.curve.append(point)
        return point

    def _outcome(self, falls: int, seconds: float, budget: float) -> str:
        """Return why training ends; nothing while it goes on."""
        if falls > self.recipe.falls:
            return "the validation error stopped falling"
        return f"the budget of {budget / 60:g} min was used up" if seconds > budget else ""

    def _lower_rate(self) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] /= 3

    def _step(self) -> float:
        batch = self.windows.at(torch.randint(len(self.windows), (self.recipe.batch_size,)))
        noise = torch.randn_like(batch[OBS_STATE])
        batch[OBS_STATE] = batch[OBS_STATE] + self.recipe.jitter * noise
        self.policy.train()
        loss, _ = self.policy.forward(batch)
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.weights, 10.0)
        self.optimizer.step()
        self.steps += 1
        # a young average forgets quickly, so that the initial weights are soon gone
        decay = min(self.recipe.averaging, self.steps / (self.steps + 9))
        with torch.no_grad():
            for kept, new in zip(self.averages, self.weights, strict=True):
                kept.lerp_(new, 1 - decay)
        return float(loss.detach())

    @torch.no_grad()
    def _validate(self) -> tuple[float, float]:
        """Compute loss and error of the average weights, with the same noise every time."""
        policy, config, batch = self.average, self.policy.config, self.held_out
        with torch.random.fork_rng():
            torch.manual_seed(0)
            loss, _ = policy.forward(batch)
            policy.reset()
            seen = {key: batch[key] for key in (OBS_STATE, OBS_ENV_STATE)}
            predicted = policy.predict_action_chunk(seen)[:, : config.n_action_steps]
        first = config.n_obs_steps - 1  # Diffusion also predicts the past
        steps = slice(first, first + config.n_action_steps)
        valid = ~batch["action_is_pad"][:, steps]
        errors = (predicted - batch[ACTION][:, steps]).abs() * self.scale
        return float(loss), float(errors[valid].mean())


def _normalize(episodes: Episodes, preprocessor: Any) -> dict[str, Tensor]:
    """Pass all rows through the preprocessor at once."""
    rows = preprocessor(episodes.columns)
    return {name: rows[name] for name in episodes.columns}


def _configure(recipe: Recipe, training: Episodes) -> PreTrainedConfig:
    mode = NormalizationMode(recipe.normalization)
    return recipe.config(
        **state_features(*training.widths),
        normalization_mapping={"STATE": mode, "ENV": mode, "ACTION": mode},
        device="cpu",
        push_to_hub=False,
        **recipe.options,
    )


def _statistics(training: Episodes) -> dict[str, dict[str, Tensor]]:
    """Compute statistics with room at both ends, and without the spread of constants."""
    statistics = {}
    for key, values in training.columns.items():
        std, low, high = values.std(0), values.min(0).values, values.max(0).values
        constant = std < CONSTANT
        margin = torch.where(constant, 1.0, 0.1 * (high - low))
        statistics[key] = {
            "mean": values.mean(0),
            "std": torch.where(constant, 1.0, std),
            "min": low - margin,
            "max": high + margin,
        }
    return statistics


def _action_scale(postprocessor: Any, config: PreTrainedConfig) -> Tensor:
    """Compute the size of a unit of the normalised action [rad]."""
    zero = torch.zeros(1, *config.output_features[ACTION].shape)
    scale: Tensor = (postprocessor(zero + 1) - postprocessor(zero))[0]
    return scale

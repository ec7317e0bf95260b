"""Movement primitives of the library movement_primitives, led to key poses.

Both live in joint space, where the objects are not seen: the postures that they are led to are
those in which the links have the key poses of :mod:`key_poses`, by inverse kinematics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from torch import Tensor

from tpgmm_evaluation.policies.aligned import Aligned
from tpgmm_evaluation.policies.key_poses import Move
from tpgmm_evaluation.policies.planned import Observed
from tpgmm_evaluation.policies.situated import MovesConfig, MovesPolicy
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.exceptions import DependencyError

__all__ = ["DMPConfig", "DMPPolicy", "ProMPConfig", "ProMPPolicy"]


def _library() -> Any:
    try:
        import movement_primitives.dmp
        import movement_primitives.promp
    except ImportError as error:
        raise DependencyError(
            "ProMPs and DMPs need movement_primitives: pip install 'tpgmm_evaluation[compare]'"
        ) from error
    return movement_primitives


class _PrimitivePolicy(MovesPolicy):
    """Leads a primitive in joint space through postures at key poses."""

    config_class = MovesConfig
    name = "primitive"

    def postures(self, move: Move, seen: Observed) -> list[Tensor]:
        """At each key pose of a move, the posture near the mean one in which links have it."""
        targets = self.targets(move, seen)
        return [
            self.posture_at(step, {link: poses[i] for link, poses in targets.items()})
            for i, step in enumerate(move.steps)
        ]


@PreTrainedConfig.register_subclass("dmp")
@dataclass
class DMPConfig(MovesConfig):
    """Configuration of :class:`DMPPolicy`.

    Parameters
    ----------
    n_weights : int
        Of each joint and move.
    """

    n_weights: int = 20


class DMPPolicy(_PrimitivePolicy):
    """A dynamical movement primitive for each move, whose goal is the posture at its end.

    Parameters
    ----------
    config : DMPConfig
    **unused
        What else LeRobot passes.

    References
    ----------
    Ijspeert, Nakanishi, Hoffmann, Pastor, Schaal: Dynamical movement primitives, Neural
    Computation 25 (2013).
    """

    config_class = DMPConfig
    config: DMPConfig
    name = "dmp"
    weights: Tensor

    def __init__(self, config: DMPConfig, **unused: Any) -> None:
        super().__init__(config)
        shape = len(self.moves), self.robot.n_joints * config.n_weights
        self.register_buffer("weights", torch.zeros(shape, dtype=torch.float64))

    def _primitive(self, move: Move) -> Any:
        fps = self.config.fps
        return _library().dmp.DMP(
            self.robot.n_joints,
            execution_time=(move.arrive - move.begin) / fps,
            dt=1 / fps,
            n_weights_per_dim=self.config.n_weights,
        )

    def learn(self, aligned: Aligned) -> None:
        """Imitate the mean of each move."""
        for index, move in enumerate(self.moves):
            way = as_array(self.mean[move.begin : move.arrive + 1])
            primitive = self._primitive(move)
            primitive.imitate(np.arange(len(way)) / self.config.fps, way)
            self.weights[index] = torch.from_numpy(np.ravel(primitive.get_weights()))

    def references(self, seen: Observed) -> Tensor:
        """The move that begins now, and the posture at its end until the next."""
        move = self.move_at(seen.step)
        goal = self.postures(move, seen)[-1]
        goal[self.free] = self.mean[move.arrive, self.free]
        primitive = self._primitive(move)
        primitive.set_weights(as_array(self.weights[self.moves.index(move)]))
        primitive.configure(start_y=as_array(seen.joints), goal_y=as_array(goal))
        _, way = primitive.open_loop()
        rows = (np.arange(seen.step, move.end) - move.begin).clip(0, len(way) - 1)
        return torch.from_numpy(np.asarray(way)[rows])


@PreTrainedConfig.register_subclass("promp")
@dataclass
class ProMPConfig(MovesConfig):
    """Configuration of :class:`ProMPPolicy`.

    Parameters
    ----------
    n_weights : int
        Of each joint.
    regularization : float
        Added to the variance of each weight over the demonstrations [rad^2]: without it, few
        demonstrations allow no posture but theirs.
    length : float
        How far apart in time weights vary together by that [s]: less, and the skill returns to
        the mean between two postures that it is led through.
    precision : float
        Variance with which the skill passes through postures [rad^2].
    """

    n_weights: int = 40
    regularization: float = 1e-2
    length: float = 2.0
    precision: float = 1e-10


class ProMPPolicy(_PrimitivePolicy):
    """A probabilistic movement primitive, conditioned on where it is and on key poses.

    At the beginning of each move the distribution over all joints is conditioned on the
    present references, and on the postures at the move's key poses.

    Parameters
    ----------
    config : ProMPConfig
    **unused
        What else LeRobot passes.

    References
    ----------
    Paraschos, Daniel, Peters, Neumann: Probabilistic movement primitives, NeurIPS (2013).
    """

    config_class = ProMPConfig
    config: ProMPConfig
    name = "promp"
    weight_mean: Tensor
    weight_cov: Tensor

    def __init__(self, config: ProMPConfig, **unused: Any) -> None:
        super().__init__(config)
        n = self.robot.n_joints * config.n_weights
        self.register_buffer("weight_mean", torch.zeros(n, dtype=torch.float64))
        self.register_buffer("weight_cov", torch.zeros(n, n, dtype=torch.float64))

    def learn(self, aligned: Aligned) -> None:
        """Mean and covariance of the weights that reproduce each demonstration."""
        one = _library().promp.ProMP(1, self.config.n_weights)
        weights = np.array(
            [
                [one.weights(self._phase(), joint[:, None]) for joint in as_array(d.joints).T]
                for d in aligned.demonstrations
            ]
        ).reshape(len(aligned.demonstrations), -1)
        self.weight_mean[:] = torch.from_numpy(weights.mean(0))
        centred = weights - weights.mean(0)
        covariance = centred.T @ centred / max(1, len(weights) - 1)
        duration = self.config.n_steps / self.config.fps
        gaps = duration * np.subtract.outer(one.centers, one.centers) / self.config.length
        smooth = self.config.regularization * np.exp(-0.5 * gaps**2)
        covariance += np.kron(np.eye(self.robot.n_joints), smooth)
        self.weight_cov[:] = torch.from_numpy(covariance)

    def _phase(self) -> Array:
        """Of each time step, in [0, 1]; a new array, because the library writes into it."""
        phase: Array = np.linspace(0, 1, self.config.n_steps).astype(np.float64)
        return phase

    def references(self, seen: Observed) -> Tensor:
        """The conditioned mean, until the next move begins."""
        move, step = self.move_at(seen.step), seen.step
        n, width = self.robot.n_joints, self.config.n_weights
        primitive = (
            _library()
            .promp.ProMP(n, width)
            .from_weight_distribution(as_array(self.weight_mean), as_array(self.weight_cov))
        )
        postures = self.postures(move, seen)
        passed = [(step, seen.joints), *zip(move.steps, postures, strict=True)]
        if move.end < self.config.n_steps:  # and rests there, until the next move
            passed.append((move.end, postures[-1]))
        for at, posture in passed:
            wanted = as_array(posture).copy()
            if at != step:
                wanted[self.free] = as_array(self.mean[at, self.free])
            primitive = primitive.condition_position(
                wanted, self.config.precision * np.eye(n), at / (self.config.n_steps - 1)
            )
        one = _library().promp.ProMP(1, width)
        ways = [
            one.trajectory_from_weights(self._phase(), weights)[step : move.end, 0]
            for weights in primitive.weight_mean.reshape(n, width)
        ]
        return torch.from_numpy(np.stack(ways, axis=1))

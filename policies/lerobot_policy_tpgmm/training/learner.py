"""Learning inside LeRobot's training loop: collect an epoch, fit by EM, go on by gradient.

The first epoch of a run changes nothing: its frames are put together into demonstrations. These
are aligned and learned as :class:`tpgmm_torch.TaskParameterizedGMM` does; a policy that is
fitted already keeps its mixture. From then on every batch gives a loss whose gradient reaches
all parameters of the mixture.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, distributed

from lerobot_policy_tpgmm.training.clocks import Clock, alignment
from lerobot_policy_tpgmm.training.epoch_recorder import EpochRecorder, episode_ranges, located
from lerobot_policy_tpgmm.training.losses import (
    Samples,
    imitation_loss,
    likelihood_loss,
    local_points,
    regression,
)
from tpgmm_torch import Demonstration, Kinematics
from tpgmm_torch.alignment.base import Alignment
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.exceptions import DataError, NotFittedError
from tpgmm_torch.training.local_data import local_data
from tpgmm_torch.training.mixture_settings import regularization

if TYPE_CHECKING:
    from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy

__all__ = ["Learner"]

log = logging.getLogger(__name__)


class Learner:
    """What a policy does with batches.

    Parameters
    ----------
    policy : TPGMMPolicy
    dataset_meta : LeRobotDatasetMetadata
        Of the data set that the batches come from.
    """

    def __init__(self, policy: TPGMMPolicy, dataset_meta: Any) -> None:
        self._policy = policy
        self._fps = float(dataset_meta.fps)
        self._ranges = episode_ranges(dataset_meta)
        self._lengths = {number: len(frames) for number, frames in self._ranges.items()}
        self._recorder: EpochRecorder | None = EpochRecorder(self._ranges, self._fps)
        self._learned: set[int] = set()
        self._first: dict[int, dict[str, Tensor]] = {}
        self._clock: Clock | None = None
        self._regularization: list[Tensor] | None = None
        self._kinematics = policy.kinematics

    def loss(self, batch: Mapping[str, Any]) -> Tensor:
        """The loss of a batch.

        Parameters
        ----------
        batch : mapping of str to Tensor
            As LeRobot's data loader gives it, behind the preprocessor.

        Returns
        -------
        Tensor of shape ()
            Zero, without gradient for any parameter, while frames are collected.

        Raises
        ------
        DataError
            If the batch cannot be learned from, or the loss is not finite.
        NotFittedError
            If a held-out batch comes before the end of the first epoch.
        """
        recorder, training = self._recorder, self._policy.training
        if training:
            check_one_process()
        if training and recorder is not None:
            again = recorder.record(batch)
            if not (again and recorder.complete):
                # no gradient, not a zero one: an optimizer's momentum must not move anything
                return torch.zeros((), requires_grad=True)
            self._finish()
        if not self._policy.mixture.fitted:
            raise NotFittedError(
                f"there is nothing to evaluate before the first epoch is over: {recorder}. "
                "Evaluate less often (--eval_steps, --env_eval_freq)"
            )
        return self._gradient_loss(batch)

    def end_epoch(self) -> None:
        """Fit, if all frames are there; a loop that evaluates or saves may stop right then."""
        if self._recorder is not None and self._recorder.complete:
            self._finish()

    def check_saveable(self) -> None:
        """Refuse to save a policy that has nothing learned.

        Raises
        ------
        DataError
            With the number of steps that are needed.
        """
        self.end_epoch()
        if not self._policy.mixture.fitted:
            raise DataError(
                f"there is nothing to save before the first epoch is over: {self._recorder}. "
                "Train for more --steps, with a larger --batch_size, or save less often "
                "(--save_freq)"
            )

    def _finish(self) -> None:
        """Align what was recorded, and learn it unless the policy is fitted already."""
        policy, recorder = self._policy, self._recorder
        assert recorder is not None
        config, mixture = policy.config, policy.mixture
        numbers = sorted(recorder.episodes)
        columns = {number: recorder.episodes[number].columns for number in numbers}
        demonstrations = [self._demonstration(columns[number]) for number in numbers]
        kinematics = policy.kinematics.to(device="cpu")
        aligner = alignment(config.alignment, kinematics, config.alignment_features)
        aligned = demonstrations if aligner is None else aligner.fit_transform(demonstrations)
        steps = sum(map(len, demonstrations))
        message = f"{steps} frames of {len(numbers)} episodes collected"
        if not mixture.fitted:
            model = config.estimator(kinematics, list(policy.operators)).fit(aligned)
            mixture.copy_from(model)
            config.n_steps = len(mixture.time)
            message += (
                f"; {config.n_components} components fitted to them by {model.n_iter_} steps "
                f"of EM: log-likelihood {model.score(aligned):.3f} per step"
            )
        log.info(message)
        self._clock = self._aligned_clock(aligner, numbers)
        for number in numbers:
            self._first[number] = {key: c[0].clone() for key, c in columns[number].items()}
        self._regularization = self._regularize(aligned, kinematics)
        self._learned, self._recorder = set(numbers), None

    def _regularize(
        self, demonstrations: Sequence[Demonstration], kinematics: Kinematics
    ) -> list[Tensor]:
        """What EM adds to the diagonals of the covariances of these demonstrations."""
        policy = self._policy
        rows = local_data(demonstrations, policy.operators, kinematics)
        points = torch.cat(rows).numpy()
        model = policy.config.estimator(kinematics, policy.operators)
        widths = [mean.shape[1] for mean in policy.mixture.means]
        isotropic = model.covariance_type == "spherical"
        moments = ColumnMoments.of(points)
        units = moments.standardization(widths, isotropic=isotropic)
        shares = regularization(
            moments,
            policy.operators,
            kinematics,
            reg_covar=model.reg_covar,
            covariance_type=model.covariance_type,
        )
        added = torch.from_numpy(shares) * torch.cat(units.scales).square()
        return list(added.to(policy.mixture.time).split(widths))

    def _demonstration(self, columns: Mapping[str, Tensor]) -> Demonstration:
        policy = self._policy
        rows = {key: column.to(policy.mixture.time.device) for key, column in columns.items()}
        joints = policy.joints.joints(rows[OBS_STATE]).cpu()
        follow = policy.config.follow_frames
        frames = policy.frames.frames(rows if follow else {k: v[:1] for k, v in rows.items()})
        return Demonstration(
            torch.arange(len(joints), dtype=torch.float64) / self._fps,
            joints,
            {name: (f if follow else f[0]).to("cpu") for name, f in frames.items()},
            policy.kinematics.joint_names,
        )

    def _aligned_clock(self, aligner: Alignment | None, numbers: Sequence[int]) -> Clock:
        """Paths of the learned episodes, on the time grid of the mixture."""
        if self._policy.config.alignment == "none":
            return Clock(self._lengths, None, {}, self._fps)
        grid = self._policy.mixture.time.detach().cpu().double().numpy()
        paths = {}
        if aligner is not None:
            # a policy that was fitted before has its own grid
            own = aligner.time_.numpy()
            instants = np.interp(grid, grid[[0, -1]], own[[0, -1]])
            for number, path in zip(numbers, aligner.paths_, strict=True):
                paths[number] = np.interp(instants, own, path.numpy())
        return Clock(self._lengths, grid, paths, self._fps)

    def _gradient_loss(self, batch: Mapping[str, Any]) -> Tensor:
        policy = self._policy
        config, mixture = policy.config, policy.mixture
        numbers, steps = located(batch, self._ranges)
        if policy.training and not self._learned.issuperset(numbers.tolist()):
            new = sorted({*numbers.tolist()} - self._learned)
            raise DataError(
                f"episodes {new} came after the first epoch was over: shuffle the frames of "
                "all episodes, as lerobot-train does"
            )
        if self._kinematics.lower.device != mixture.time.device:
            self._kinematics = self._kinematics.to(device=mixture.time.device)
        samples = self._samples(batch, numbers, steps)
        model = regression(config, self._kinematics, policy.operators, mixture)
        if config.loss == "likelihood":
            # held-out frames are scored, not learned
            kept = self._regularization if policy.training else None
            loss = likelihood_loss(mixture, local_points(model, samples), kept)
        else:
            wanted = policy.joints.targets(batch[ACTION])
            loss = imitation_loss(model, samples, wanted, policy.joints.order)
        if not loss.isfinite():
            raise DataError(
                f"the {config.loss} loss is {loss.item()}: the steps are too large, lower "
                "--policy.optimizer_lr"
            )
        return loss

    def _samples(self, batch: Mapping[str, Any], numbers: Tensor, steps: Tensor) -> Samples:
        policy = self._policy
        like = policy.mixture.time
        joints = policy.joints.joints(batch[OBS_STATE]).to(like)
        poses = policy.frames.frames(self._situations(batch, numbers, steps))
        clock = self._clock
        if clock is None:  # of a policy that was fitted before, and is only evaluated
            clock = self._aligned_clock(None, ())
        return Samples(
            clock(numbers, steps).to(like),
            clock(numbers, steps + 1).to(like),
            self._kinematics.state(joints),
            {name: frame.to(like) for name, frame in poses.items()},
        )

    def _situations(
        self, batch: Mapping[str, Any], numbers: Tensor, steps: Tensor
    ) -> dict[str, Tensor]:
        """What the frames are read from: the beginning of the episode, where that is known."""
        rows = {key: batch[key] for key in (OBS_STATE, OBS_ENV_STATE) if key in batch}
        if self._policy.config.follow_frames:
            return rows
        for place in torch.nonzero(steps == 0).flatten().tolist():
            number = int(numbers[place])
            self._first.setdefault(number, {key: row[place] for key, row in rows.items()})
        return {
            key: torch.stack(
                [
                    self._first.get(number, {}).get(key, own).to(own)
                    for number, own in zip(numbers.tolist(), row, strict=True)
                ]
            )
            for key, row in rows.items()
        }


def check_one_process() -> None:
    """Refuse a training that is shared among processes.

    Raises
    ------
    DataError
        If there are several: each would see a part of the demonstrations.
    """
    if distributed.is_available() and distributed.is_initialized():
        processes = distributed.get_world_size()
        if processes > 1:
            raise DataError(
                f"a tpgmm policy is trained in one process, this run has {processes}: each "
                "would see a part of every demonstration. Start lerobot-train without "
                "accelerate launch, or with --num_processes=1"
            )

"""Learning inside LeRobot's training loop: collect an epoch, fit by EM, go on by gradient.

The first epoch of a run changes nothing: its frames become demonstrations. These
are aligned and learned as :class:`tpgmm_torch.TaskParameterizedGMM` does; a policy that is
fitted already keeps its mixture. From then on every batch gives a loss whose gradient reaches
all parameters of the mixture.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from sklearn.pipeline import Pipeline
from torch import Tensor, distributed

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.mixture_parameters import MixtureParameters
from lerobot_policy_tpgmm.observations import FrameFeatures, JointFeatures
from lerobot_policy_tpgmm.training.clocks import Clock
from lerobot_policy_tpgmm.training.covariance_prior import CovariancePrior
from lerobot_policy_tpgmm.training.epoch_recorder import (
    COLUMNS,
    EpochRecorder,
    episode_ranges,
    located,
)
from lerobot_policy_tpgmm.training.losses import (
    Samples,
    imitation_loss,
    likelihood_loss,
    local_points,
    regression,
)
from tpgmm_datasets import check
from tpgmm_datasets.conversion.assembly import event_sources
from tpgmm_datasets.events import Detector, find_events
from tpgmm_datasets.lerobot.columns import EVENT, WRENCH
from tpgmm_datasets.lerobot.event_flags import stored_events
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, NotFittedError, PlausibilityWarning
from tpgmm_torch.mixture.row_file import ColumnMoments
from tpgmm_torch.operators import Operator
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots import Kinematics
from tpgmm_torch.structure.choices import Choices, aligner, learn, prepare_demonstrations
from tpgmm_torch.training.hold_detection import holding_as_in, with_holds
from tpgmm_torch.training.local_data import local_data
from tpgmm_torch.training.mixture_settings import regularization
from tpgmm_torch.training.outlying_demonstrations import outlying_demonstrations

__all__ = ["Learner"]

log = logging.getLogger(__name__)

#: Covariances of these types are shrunk after EM.
SHRUNK = ("full", "tied")


class Learner:
    """Collects demonstrations, learns them by EM, and gives losses of batches afterwards.

    Parameters
    ----------
    config : TPGMMConfig
        Of the policy that is trained.
    kinematics : Kinematics
    operators : sequence of Operator
    mixture : MixtureParameters
        What is learned.
    joints : JointFeatures
    frames : FrameFeatures
        Where observations hold the joints and the frames.
    dataset_meta : LeRobotDatasetMetadata
        Of the data set that the batches come from.
    become : callable
        Makes the policy what a fitted model or skill is, ``mixture`` included.
    model : TaskParameterizedGMM or Skill, optional
        What was fitted before.

    Attributes
    ----------
    clock : Clock or None
        Of the episodes of the data set; None before they are collected.
    prior : CovariancePrior or None
        What EM's regularisation and shrinkage say of the covariances of the collected
        demonstrations.
    """

    def __init__(
        self,
        config: TPGMMConfig,
        kinematics: Kinematics,
        operators: Sequence[Operator],
        mixture: MixtureParameters,
        joints: JointFeatures,
        frames: FrameFeatures,
        dataset_meta: Any,
        become: Callable[[Any], None],
        model: Any = None,
    ) -> None:
        self._config, self._mixture, self._become = config, mixture, become
        self._model, self._choices = model, config.choices()
        self._kinematics, self._operators = kinematics, tuple(operators)
        self._joints, self._frames = joints, frames
        self._dataset, flags = dataset_meta, dataset_meta.features
        self._stored = [k.removeprefix(EVENT) for k in flags if k.startswith(EVENT)]
        sources = event_sources(
            config.training.events, config.link_poses(), self._stored, kinematics.joint_names
        )
        self._detectors = {n: s for n, s in sources.items() if isinstance(s, Detector)}
        self._fps = float(dataset_meta.fps)
        self._ranges = episode_ranges(dataset_meta)
        self._recorder: EpochRecorder | None = EpochRecorder(self._ranges, self._fps)
        self._learned: set[int] = set()
        self._first: dict[int, dict[str, Tensor]] = {}
        self.clock: Clock | None = None
        self.prior: CovariancePrior | None = None
        self._left_out: set[int] = set()
        self._begun = False
        self._warned = False

    def loss(self, batch: Mapping[str, Any], training: bool) -> Tensor:
        """The loss of a batch.

        Parameters
        ----------
        batch : mapping of str to Tensor
            As LeRobot's data loader gives it, behind the preprocessor.
        training : bool
            Whether the batch is to be learned from; a held-out one is not.

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
        recorder = self._recorder
        if training:
            check_one_process()
        if training and recorder is not None:
            repeated = recorder.record(batch)
            if not self._begun:
                log.info("collecting: the loss is 0 until every frame has come; %s", recorder)
            self._begun = True
            if not (repeated and recorder.complete):
                # no gradient, not a zero one: an optimizer's momentum must not move anything
                return torch.zeros((), requires_grad=True)
            self._finish(recorder)
        if not self._mixture.fitted:
            raise NotFittedError(
                f"there is nothing to evaluate before the first epoch is over: {recorder}. "
                "Evaluate less often (--eval_steps, --env_eval_freq)"
            )
        if unlearnable := self._unlearnable():
            if not self._warned:
                log.warning(
                    "%s: the mixture stays as EM fitted it, and more steps change nothing",
                    unlearnable,
                )
            self._warned = True
            return torch.zeros((), requires_grad=True)
        return self._gradient_loss(batch, training)

    def end_epoch(self) -> None:
        """Fit, if all frames are there; a loop that evaluates or saves may stop right then."""
        if self._recorder is not None and self._recorder.complete:
            self._finish(self._recorder)

    def _unlearnable(self) -> str:
        """Why frames by themselves are not enough for a gradient; empty if they are."""
        config = self._config
        if self._choices != Choices():  # the mixture has no place in the optimizer
            return "operators, components, parts or ways were found by the fit"
        if not isinstance(self._model, TaskParameterizedGMM):
            return f"the policy is a skill, {type(self._model).__name__}, of several models"
        given = config.given_holds()
        if holds := self._model.holds_ if given is None else given:
            # frames do not tell where an object was last free
            return f"objects are held, {', '.join(map(str, holds))}"
        if config.training.link_frames:  # nor where a link is at an event of the episode
            return f"frames are at events, {', '.join(config.training.link_frames.values())}"
        return ""

    def check_saveable(self) -> None:
        """Refuse to save a policy that has nothing learned.

        Raises
        ------
        DataError
            With the number of steps that are needed.
        """
        self.end_epoch()
        if not self._mixture.fitted:
            raise DataError(
                f"there is nothing to save before the first epoch is over: {self._recorder}. "
                "Train for more --steps, with a larger --batch_size, or save less often "
                "(--save_freq)"
            )

    def _finish(self, recorder: EpochRecorder) -> None:
        """Learn from the recorded episodes; the configuration says what a warning does."""
        action = self._config.training.plausibility
        with warnings.catch_warnings():
            if action in ("error", "ignore"):
                warnings.simplefilter(action, PlausibilityWarning)  # type: ignore[arg-type]
            self._learn(recorder)

    def _learn(self, recorder: EpochRecorder) -> None:
        """Align what was recorded, and learn it unless the policy is fitted already."""
        config, mixture = self._config, self._mixture
        episodes = recorder.episodes
        numbers = sorted(episodes)
        kinematics = self._kinematics.to(device="cpu")
        demonstrations = self._linked(
            {number: self._demonstration(episodes[number]) for number in numbers}, kinematics
        )
        check(demonstrations, kinematics, self._joints.raw).act()
        training = config.training
        chosen = aligner(training.alignment, kinematics, training.alignment_features)
        steps = sum(map(len, demonstrations))
        log.info("%d frames of %d episodes collected", steps, len(numbers))
        aligned = demonstrations
        if chosen is not None:
            log.info("aligning them: --policy.training.alignment=%s", training.alignment)
            aligned = chosen.fit_transform(demonstrations)
        if not mixture.fitted:
            self._fit(config.estimator(kinematics, list(self._operators)), aligned)
        self.clock = self._aligned_clock(chosen, numbers)
        for number in numbers:
            self._first[number] = {key: c[0].clone() for key, c in episodes[number].items()}
        self._learned, self._recorder = set(numbers), None
        self._go_on_from(dict(zip(numbers, aligned, strict=True)), kinematics)

    def _fit(self, model: TaskParameterizedGMM, aligned: Sequence[Demonstration]) -> None:
        """Learn aligned demonstrations, and what of their structure is asked for."""
        config, operators = self._config, self._operators
        log.info("EM: fitting %s components", config.n_components)
        robust, holds = config.training.robust, config.given_holds()
        shown = prepare_demonstrations(aligned, operators, model.robot, robust, holds)
        self._model, reports = learn(model, shown, self._choices)
        for report in reports:
            log.info("%s", report)
        self._become(self._model)
        if isinstance(self._model, TaskParameterizedGMM):
            self._operators = self._model.operators_
            log.info(
                "%d components fitted by %d steps of EM: the policy is trained",
                len(self._model.weights_),
                self._model.n_iter_,
            )

    def _go_on_from(self, aligned: Mapping[int, Demonstration], kinematics: Kinematics) -> None:
        """Find what the loss of later steps needs to know of the demonstrations."""
        config, mixture, operators = self._config, self._mixture, self._operators
        if self._choices != Choices() or not isinstance(self._model, TaskParameterizedGMM):
            return
        given = config.given_holds()
        holds = self._model.holds_ if given is None else given
        shown = list(aligned.values())
        if config.training.robust:  # as in fit, which says so
            held = with_holds(shown, holds)
            outlying = outlying_demonstrations(held, operators, kinematics)
            self._left_out = {list(aligned)[one.episode] for one in outlying}
            if self._left_out:
                log.info("unlike the others, not learned from: %s", sorted(self._left_out))
        kept = [one for number, one in aligned.items() if number not in self._left_out]
        like = mixture.time
        with torch.no_grad():
            model = self._regression(kinematics.to(like.dtype, like.device))

            def expected(j: int, time: Tensor) -> Tensor:
                return model.expect(j, time.to(like)).to(time)

            rows = torch.cat(local_data(kept, operators, kinematics, expected, holds))
            points = list(rows.to(like).split([mean.shape[1] for mean in mixture.means], 1))
            self.prior = CovariancePrior.of(
                mixture,
                points,
                self._regularization(rows, kinematics),
                config.em.covariance_shrinkage if config.em.covariance_type in SHRUNK else 0.0,
                len(kept),
            )
            likelihood = likelihood_loss(mixture, points, self.prior)
        unit = "imitation error [mrad^2]" if config.training.loss == "imitation" else "same"
        log.info(
            "negative log-likelihood per frame, with the prior: %.3f; further steps go on by "
            "gradient, and their loss is the %s",
            likelihood.item(),
            unit,
        )

    def _linked(
        self, shown: Mapping[int, Demonstration], kinematics: Kinematics
    ) -> list[Demonstration]:
        """Demonstrations with the events and the frames at links that are asked for."""
        config, poses, detectors = self._config, self._config.link_poses(), self._detectors
        found = list(shown.values())
        if self._stored and (poses or config.training.alignment.startswith("events")):
            # LeRobot's preprocessor hands no such columns on
            log.info("reading events: %s", ", ".join(self._stored))
            stored = stored_events(Path(self._dataset.root), shown)
            found = [replace(one, events=stored[n]) for n, one in shown.items()]
        if detectors:
            log.info("finding events: %s", ", ".join(detectors))
            found = find_events(found, detectors, kinematics)
        for event in {pose.event for pose in poses.values()} - {"start", "end"}:
            lost = [n for n, d in zip(shown, found, strict=True) if event not in d.events]
            if lost:
                raise DataError(
                    f"event {event!r}, at which a frame is, is not found in episodes {lost}: "
                    "say how, --policy.training.events='{...}', or leave them out, "
                    "--dataset.episodes"
                )
        return [
            replace(
                one,
                frames={
                    **one.frames,
                    **{n: p.frame(one, kinematics, p.time(one)) for n, p in poses.items()},
                },
            )
            for one in found
        ]

    def _regularization(self, rows: Tensor, kinematics: Kinematics) -> list[Tensor]:
        """Regularisation that EM adds to the diagonals of covariances of these local data."""
        config = self._config
        moments = ColumnMoments.of(rows.numpy())
        shares = regularization(
            moments,
            self._operators,
            kinematics,
            reg_covar=config.em.reg_covar,
            covariance_type=config.em.covariance_type,
        )
        widths = [mean.shape[1] for mean in self._mixture.means]
        scales = moments.scales(widths, isotropic=config.em.covariance_type == "spherical")
        return list(torch.from_numpy(shares * scales**2).to(self._mixture.time).split(widths))

    def _demonstration(self, columns: Mapping[str, Tensor]) -> Demonstration:
        rows = {key: column.to(self._mixture.time.device) for key, column in columns.items()}
        joints = self._shown(rows).cpu()
        follow = self._config.control.follow_frames
        frames = self._frames.frames(rows if follow else {k: v[:1] for k, v in rows.items()})
        shown = Demonstration(
            torch.arange(len(joints), dtype=torch.float64) / self._fps,
            joints,
            {name: (f if follow else f[0]).to("cpu") for name, f in frames.items()},
            self._kinematics.joint_names,
            wrenches={
                key.removeprefix(WRENCH): column.double().cpu()
                for key, column in columns.items()
                if key.startswith(WRENCH)
            },
        )
        if self._config.training.learn_from == "commanded":
            joints = self._joints.joints(rows[OBS_STATE]).cpu()
            shown = holding_as_in(shown, joints, self._kinematics.to(device="cpu"))
        return shown

    def _shown(self, rows: Mapping[str, Tensor]) -> Tensor:
        """The joint vectors (B, n_joints) that a demonstration is made of."""
        if self._config.training.learn_from == "commanded":
            return self._joints.commanded(rows[ACTION])
        return self._joints.joints(rows[OBS_STATE])

    def _aligned_clock(self, chosen: Any, numbers: Sequence[int]) -> Clock:
        """Paths of the learned episodes, on the time grid of the mixture."""
        lengths = {number: len(frames) for number, frames in self._ranges.items()}
        if self._config.training.alignment == "none":
            return Clock(lengths, None, {}, self._fps)
        grid = self._mixture.time.detach().cpu().double().numpy()
        paths = {}
        if chosen is not None:
            warping = chosen[-1] if isinstance(chosen, Pipeline) else chosen
            # a policy that was fitted before has its own grid
            time = warping.time_.numpy()
            instants = np.interp(grid, grid[[0, -1]], time[[0, -1]])
            for number, path in zip(numbers, warping.paths_, strict=True):
                paths[number] = self._fps * np.interp(instants, time, path - path[0])
        return Clock(lengths, grid, paths, self._fps)

    def _gradient_loss(self, batch: Mapping[str, Any], training: bool) -> Tensor:
        config, mixture = self._config, self._mixture
        numbers, steps = located(batch, self._ranges)
        if training and not self._learned.issuperset(numbers.tolist()):
            new = sorted({*numbers.tolist()} - self._learned)
            raise DataError(
                f"episodes {new} came after the first epoch was over: shuffle the frames of "
                "all episodes, as lerobot-train does"
            )
        if training and self._left_out:
            rows = torch.tensor([n not in self._left_out for n in numbers.tolist()])
            if not bool(rows.any()):
                return torch.zeros((), requires_grad=True)
            numbers, steps = numbers[rows], steps[rows]
            batch = {key: batch[key][rows] for key in COLUMNS if key in batch}
        if self._kinematics.lower.device != mixture.time.device:
            self._kinematics = self._kinematics.to(device=mixture.time.device)
        samples = self._samples(batch, numbers, steps)
        model = self._regression(self._kinematics)
        if config.training.loss == "likelihood":
            # held-out frames are scored, not learned
            prior = self.prior if training else None
            loss = likelihood_loss(mixture, local_points(model, samples), prior)
        else:
            targets = self._joints.targets(batch[ACTION])
            loss = imitation_loss(model, samples, targets, self._joints.order)
        if not loss.isfinite():
            raise DataError(
                f"the {config.training.loss} loss is {loss.item()}: the steps are too large, "
                "lower --policy.training.optimizer_lr"
            )
        return loss

    def _regression(self, kinematics: Kinematics) -> Regression:
        count = self._model.n_demonstrations_
        return regression(self._config, kinematics, self._operators, self._mixture, count)

    def _samples(self, batch: Mapping[str, Any], numbers: Tensor, steps: Tensor) -> Samples:
        like = self._mixture.time
        joints = self._shown(batch).to(like)
        poses = self._frames.frames(self._situations(batch, numbers, steps))
        # a policy that was fitted before, and is only evaluated, has collected none
        clock = self._aligned_clock(None, ()) if self.clock is None else self.clock
        return Samples(
            clock(numbers, steps).to(like),
            clock(numbers, steps + 1).to(like),
            self._kinematics.state(joints),
            {name: frame.to(like) for name, frame in poses.items()},
        )

    def _situations(
        self, batch: Mapping[str, Any], numbers: Tensor, steps: Tensor
    ) -> dict[str, Tensor]:
        """Rows that frames are read from: the beginning of the episode, where it has come."""
        rows = {key: batch[key] for key in (OBS_STATE, OBS_ENV_STATE) if key in batch}
        if self._config.control.follow_frames:
            return rows
        for place in torch.nonzero(steps == 0).flatten().tolist():
            number = int(numbers[place])
            self._first.setdefault(number, {key: row[place] for key, row in rows.items()})
        return {
            key: torch.stack(
                [
                    self._first.get(number, {}).get(key, present).to(present)
                    for number, present in zip(numbers.tolist(), row, strict=True)
                ]
            )
            for key, row in rows.items()
        }


def check_one_process() -> None:
    """Refuse a training that is shared among processes."""
    if distributed.is_available() and distributed.is_initialized():
        processes = distributed.get_world_size()
        if processes > 1:
            raise DataError(
                f"a tpgmm policy is trained in one process, this run has {processes}: each "
                "would see a part of every demonstration. Start lerobot-train without "
                "accelerate launch, or with --num_processes=1"
            )

"""Learning inside LeRobot's training loop: collect the frames of an epoch, fit them by EM.

The frames of the first epoch become demonstrations, which are aligned and learned as
:class:`tpgmm_torch.TaskParameterizedGMM` does. There is nothing to learn after that.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, distributed

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.observations import FrameFeatures, JointFeatures
from lerobot_policy_tpgmm.training.epoch_recorder import EpochRecorder, episode_ranges
from tpgmm_datasets import check
from tpgmm_datasets.conversion.assembly import event_sources
from tpgmm_datasets.conversion.commands import keep_postures, report_left_out
from tpgmm_datasets.events import Detector, find_events
from tpgmm_datasets.lerobot.columns import EVENT, WRENCH
from tpgmm_datasets.lerobot.stored_signals import stored_events
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.checks.report import Report
from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.exceptions import DataError, NotFittedError, PlausibilityWarning
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots import Kinematics
from tpgmm_torch.structure.choices import aligner, learn, prepare_demonstrations

log = logging.getLogger(__name__)


class Learner:
    """Collects demonstrations from batches, and learns them by EM.

    Parameters
    ----------
    config : TPGMMConfig
        Of the policy that is trained.
    kinematics : Kinematics
        Robot whose links the operators see.
    operators : sequence of Operator
        Operators of the model, or the candidates to choose from.
    joints : JointFeatures
        Where observations and actions hold the joints.
    frames : FrameFeatures
        Where observations hold the frames.
    dataset_meta : LeRobotDatasetMetadata
        Of the data set that the batches come from.
    model : TaskParameterizedGMM or Skill, optional
        What was fitted before; it stays as it is.

    Attributes
    ----------
    model : TaskParameterizedGMM, Skill or None
        What was learned; None during the first epoch.
    """

    def __init__(
        self,
        config: TPGMMConfig,
        kinematics: Kinematics,
        operators: Sequence[Operator],
        joints: JointFeatures,
        frames: FrameFeatures,
        dataset_meta: Any,
        model: Any = None,
    ) -> None:
        self._config, self.model = config, model
        self._kinematics, self._operators = kinematics.to(device="cpu"), tuple(operators)
        self._joints, self._frames = joints, frames
        self._dataset, flags = dataset_meta, dataset_meta.features
        self._stored = [k.removeprefix(EVENT) for k in flags if k.startswith(EVENT)]
        sources = event_sources(
            config.training.events, config.link_poses(), self._stored, kinematics.joint_names
        )
        self._detectors = {n: s for n, s in sources.items() if isinstance(s, Detector)}
        self._fps = float(dataset_meta.fps)
        self._recorder = EpochRecorder(episode_ranges(dataset_meta), self._fps)
        self._learned: set[int] = set()
        self._warned = False

    def learn(self, batch: Mapping[str, Any], training: bool) -> Any:
        """Collect the frames of a batch, and fit once all of the epoch have come.

        Parameters
        ----------
        batch : mapping of str to Tensor
            As LeRobot's data loader gives it, behind the preprocessor.
        training : bool
            Whether the batch is to be learned from; a held-out one is not.

        Returns
        -------
        TaskParameterizedGMM, Skill or None
            The ``model``.

        Raises
        ------
        DataError
            If the batch cannot be learned from.
        NotFittedError
            If a held-out batch comes before the end of the first epoch.
        """
        if training:
            check_one_process()
            if self.model is None:
                self._collect(batch)
                return self.model
            self._check_episodes(batch)
        elif self.model is None:
            raise NotFittedError(
                f"there is nothing to evaluate before the first epoch is over: "
                f"{self._recorder}. Evaluate less often (--eval_steps, --env_eval_freq)"
            )
        if not self._warned:
            log.warning("the policy is fitted: more steps change nothing, the loss stays 0")
        self._warned = True
        return self.model

    def end_epoch(self) -> Any:
        """Fit if all frames are there; a loop that evaluates or saves may stop right then.

        Returns
        -------
        TaskParameterizedGMM, Skill or None
            The ``model``.
        """
        if self.model is None and self._recorder.complete:
            self._finish()
        return self.model

    def check_saveable(self) -> None:
        """Refuse to save a policy that has nothing learned.

        Raises
        ------
        DataError
            With the number of steps that are needed.
        """
        if self.end_epoch() is None:
            raise DataError(
                f"there is nothing to save before the first epoch is over: {self._recorder}. "
                "Train for more --steps, with a larger --batch_size, or save less often "
                "(--save_freq)"
            )

    def _collect(self, batch: Mapping[str, Any]) -> None:
        begun = bool(self._recorder.episodes)
        repeated = self._recorder.record(batch)
        if not begun:
            log.info("collecting: the fit comes after every frame; %s", self._recorder)
        if repeated:
            self.end_epoch()

    def _check_episodes(self, batch: Mapping[str, Any]) -> None:
        """Refuse episodes that came too late; what a fitted policy was learned from is free."""
        new = {*batch["episode_index"].flatten().tolist()} - self._learned
        if self._learned and new:
            raise DataError(
                f"episodes {sorted(new)} came after the first epoch was over: shuffle the "
                "frames of all episodes, as lerobot-train does"
            )

    def _finish(self) -> None:
        """Learn the recorded episodes; the configuration says what a warning does."""
        episodes, action = self._recorder.episodes, self._config.training.plausibility
        with warnings.catch_warnings():
            if action in ("error", "ignore"):
                warnings.simplefilter(action, PlausibilityWarning)  # type: ignore[arg-type]
            self._fit(self._align(episodes))
        self._learned = set(episodes)
        self._recorder.clear()

    def _align(self, episodes: Mapping[int, Mapping[str, Tensor]]) -> list[Demonstration]:
        """Bring the demonstrations of recorded episodes onto one clock."""
        training = self._config.training
        shown, left_out = dict[int, Demonstration](), list[tuple[int, str]]()
        for number in sorted(episodes):
            shown[number], kind = self._make_demonstration(episodes[number])
            left_out += [(number, kind)] if kind else []
        demonstrations = self._add_link_frames(self._add_events(shown))
        report = check(demonstrations, self._kinematics, self._joints.raw)
        Report.of([*report_left_out(left_out), *report], report.subject).act()
        chosen = aligner(training.alignment, self._kinematics, training.alignment_features)
        steps = sum(map(len, demonstrations))
        log.info("%d frames of %d episodes collected", steps, len(demonstrations))
        if chosen is None:
            return demonstrations
        log.info("aligning them: --policy.training.alignment=%s", training.alignment)
        aligned: list[Demonstration] = chosen.fit_transform(demonstrations)
        return aligned

    def _fit(self, aligned: Sequence[Demonstration]) -> None:
        """Learn aligned demonstrations, and what of their structure is asked for."""
        config = self._config
        log.info("EM: fitting %s components", config.n_components)
        estimator = config.estimator(self._kinematics, list(self._operators))
        robust, holds = config.training.robust, config.given_holds()
        shown = prepare_demonstrations(aligned, self._operators, estimator.robot, robust, holds)
        self.model, reports = learn(estimator, shown, config.choices())
        gaps = getattr(getattr(self.model, "skill", self.model), "gaps", None)
        if gaps is not None:
            robot = self._kinematics
            log.info("servos: %s", gaps.describe(robot.joint_names, robot.lengths))
        for report in reports:
            log.info("%s", report)
        if isinstance(self.model, TaskParameterizedGMM):
            log.info(
                "%d components fitted by %d steps of EM: the policy is trained",
                len(self.model.weights_),
                self.model.n_iter_,
            )

    def _add_events(self, shown: Mapping[int, Demonstration]) -> dict[int, Demonstration]:
        """Add the events that are stored in the data set, or found in the motion."""
        config, poses = self._config, self._config.link_poses()
        found = list(shown.values())
        if self._stored and (poses or config.training.alignment.startswith("events")):
            # LeRobot's preprocessor hands no such columns on
            log.info("reading events: %s", ", ".join(self._stored))
            stored = stored_events(Path(self._dataset.root), shown)
            found = [replace(one, events=stored[n]) for n, one in shown.items()]
        if self._detectors:
            log.info("finding events: %s", ", ".join(self._detectors))
            found = find_events(found, self._detectors, self._kinematics)
        return dict(zip(shown, found, strict=True))

    def _add_link_frames(self, shown: Mapping[int, Demonstration]) -> list[Demonstration]:
        """Add the frames at links (``link_frames``) to demonstrations with events."""
        poses, kinematics = self._config.link_poses(), self._kinematics
        for event in {pose.event for pose in poses.values()} - {"start", "end"}:
            lost = [
                n for n, demonstration in shown.items() if event not in demonstration.events
            ]
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
            for one in shown.values()
        ]

    def _make_demonstration(self, columns: Mapping[str, Tensor]) -> tuple[Demonstration, str]:
        """Make a demonstration of an episode; and say what actions are, if no postures."""
        rows = {key: column.to(self._joints.scale.device) for key, column in columns.items()}
        joints = self._joints.joints(rows[OBS_STATE]).cpu()
        actions = self._joints.decode_action(rows[ACTION]).cpu()
        names = self._kinematics.joint_names
        commands, kind = keep_postures(as_array(actions), as_array(joints), names)
        follow = self._config.control.follow_frames
        frames = self._frames.frames(rows if follow else {k: v[:1] for k, v in rows.items()})
        shown = Demonstration(
            torch.arange(len(joints), dtype=torch.float64) / self._fps,
            joints,
            {name: (f if follow else f[0]).to("cpu") for name, f in frames.items()},
            names,
            wrenches={
                key.removeprefix(WRENCH): column.double().cpu()
                for key, column in columns.items()
                if key.startswith(WRENCH)
            },
            commands=None if commands is None else torch.from_numpy(commands),
        )
        return shown, kind


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

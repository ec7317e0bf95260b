"""The policy: a fitted mixture behind LeRobot's interface."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import torch
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from torch import Tensor, nn

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig, state_features
from lerobot_policy_tpgmm.dataset_contract import adopt, check_dataset, read_declared
from lerobot_policy_tpgmm.eyes import make_watch, open_cell, take_over
from lerobot_policy_tpgmm.observations import (
    FrameFeatures,
    JointFeatures,
    check_rate,
    list_missing,
    list_placed,
    select_observed,
)
from lerobot_policy_tpgmm.policy_files import PATTERNS, read_model, write_files
from lerobot_policy_tpgmm.settings import EMConfig, FusionConfig
from lerobot_policy_tpgmm.tick_durations import TickDurations
from lerobot_policy_tpgmm.training.learner import Learner
from tpgmm_control.loop.command import Command, Status
from tpgmm_control.loop.controller import Controller
from tpgmm_control.obstacles import Scene
from tpgmm_datasets.conversion.joints import LEARNED_BESIDE
from tpgmm_datasets.lerobot.columns import WRENCH
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.atomic import consistent, read_whole, recover
from tpgmm_torch.exceptions import (
    DataError,
    ModelFileError,
    NotFittedError,
    PlausibilityWarning,
    ShapeError,
    TPGMMError,
)
from tpgmm_torch.hub import describe, download, model_card, upload
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.base import frame_names
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.persistence import decode, encode, validate
from tpgmm_torch.robots import Kinematics, Robot
from tpgmm_torch.skills.skill import Skill
from tpgmm_torch.skills.via_points import ViaPoints
from tpgmm_torch.structure.choices import Choices

__all__ = ["TPGMMPolicy"]

log = logging.getLogger(__name__)

#: Options of :meth:`TPGMMPolicy.push_to_hub` for the card, and how that says to run it.
FOR_THE_CARD = ("measured", "notes", "license")
USE = """```bash
pip install lerobot_policy_tpgmm 'lerobot[evaluation]'
lerobot-rollout --policy.path={repo_id} --strategy.type=base
```"""
#: When an observation was made [s], of environments and robots that tell.
TIMESTAMP = "observation.timestamp"


@dataclass(frozen=True, eq=False)
class Chunk:
    """The last chunk of an episode, to go on from.

    Parameters
    ----------
    first : Controller
        After its first action, with its last measurements.
    moments : list of Controller
        After each of its actions.
    joints : Tensor of shape (B, chunk_size, n_joints)
        The references.
    actions : Tensor of shape (B, chunk_size, n_action)
    timestamp : float or None
        Of the observation that it was made from [s].
    rate : float
        Actions per second.
    """

    first: Controller
    moments: list[Controller]
    joints: Tensor
    actions: Tensor
    timestamp: float | None
    rate: float

    def find_last_sent(
        self, measured: Tensor, timestamp: float | None, left_over: Tensor | None
    ) -> int:
        """Return the index of the action that was sent last."""
        last = len(self.moments) - 1
        if left_over is not None:
            # rows of zeros fill up what is shorter than LeRobot's horizon
            if not bool(left_over.any()):
                return last
            same = (self.actions[0] == left_over[:1]).all(-1)
            if bool(same.any()):
                return max(int(same.nonzero()[-1]) - 1, 0)
        if timestamp is not None and self.timestamp is not None:
            steps = round((timestamp - self.timestamp) * self.rate) - 1
            return min(max(steps, 0), last)
        gap = (self.joints - measured[:, None]).square().sum((0, 2))
        return int(gap.nan_to_num(torch.inf).argmin())


class TPGMMPolicy(PreTrainedPolicy):  # type: ignore[misc]
    """A task-parameterised Gaussian mixture as a LeRobot policy.

    Actions are joint references. All sub-environments of a batch move through the time grid
    in step, from :meth:`reset` on.

    Parameters
    ----------
    dataset_stats : dict, optional
        Not used.
    dataset_meta : LeRobotDatasetMetadata, optional
        What the policy is trained on. It completes the configuration of a policy that is not
        fitted; with a fitted one it must agree.
    model : TaskParameterizedGMM or Skill, optional
        What was fitted.
    **unused
        What else LeRobot passes.

    Raises
    ------
    DataError, ShapeError, ModelFileError, UnknownNameError
        If the configuration is incomplete, or contradicts itself or the data set.
    """

    config_class = TPGMMConfig
    name = "tpgmm"

    def __init__(
        self,
        config: TPGMMConfig,
        dataset_stats: object = None,
        dataset_meta: Any = None,
        model: Any = None,
        **unused: Any,
    ) -> None:
        super().__init__(config)
        self.config, self._model = config, model
        self._placeholder = nn.Parameter(torch.zeros(()))  # optimizers refuse to have none
        self._handle_removed_options()
        kinematics, operators, required = self._describe_skill(dataset_meta)
        config.validate_features()
        cell = open_cell(config)
        self.kinematics = kinematics.to(getattr(torch, config.em.dtype))
        # where structure was found, the configuration says what was asked for, not what it is
        if isinstance(model, TaskParameterizedGMM) and config.choices() == Choices():
            self._model = self._apply_overrides(model)
        self.joints = self._match_joints(cell, dataset_meta)
        if dataset_meta is not None and isinstance(self.kinematics, Robot):
            self.kinematics = self.kinematics.drop_limits(self.joints.raw)
        summary = None if model is None else _skill(model).summary
        names = select_observed(config, required, summary)
        self.frames = self._locate_frames(names, config.frames)
        self.watch = make_watch(cell, self.kinematics, self.frames)
        self._learner = None
        if dataset_meta is not None:
            self._learner = self._make_learner(operators, required, dataset_meta)
        self.reset()

    def _make_learner(
        self, operators: Sequence[Operator], required: Sequence[str], dataset_meta: Any
    ) -> Learner:
        """Return a learner, which sees the frames that the data set has recorded."""
        config, at_links = self.config, self.config.training.link_frames
        recorded = [name for name in required if name not in at_links]
        places = {n: p for n, p in (config.frames or {}).items() if n in recorded}
        frames = self._locate_frames(recorded, places)
        signals = self.joints, frames, dataset_meta
        return Learner(config, self.kinematics, operators, *signals, self._model)

    def _handle_removed_options(self) -> None:
        """Refuse to train with options of release 0.3; a policy saved with them runs."""
        training = self.config.training
        if training.learn_from == "commanded" and self._model is None:
            log.warning("--policy.training.learn_from=commanded %s", LEARNED_BESIDE)
        training.learn_from = None
        if names := ", ".join(training.clear_removed_options()):
            said = f"{names}: lerobot-train fits by EM alone since 0.4, without gradient steps"
            if self._model is None:
                raise DataError(f"{said}. Leave the option out")
            log.warning("%s; the policy is what it was saved as", said)

    def _describe_skill(
        self, dataset_meta: Any
    ) -> tuple[Kinematics, Sequence[Operator], list[str]]:
        """Return robot, operators and names of the frames, of a model or of what to learn."""
        config, model = self.config, self._model
        if model is None:
            kinematics, operators = self._describe_training(dataset_meta)
            names = frame_names([*operators, *config.via_operators()], kinematics)
            return kinematics, operators, list(dict.fromkeys(names))
        if dataset_meta is not None:
            check_dataset(config, dataset_meta)
        skill = _skill(model)
        names = *skill.frame_names, *frame_names(config.via_operators(), skill.kinematics)
        operators = getattr(model, "operators_", ())
        return skill.kinematics, operators, list(dict.fromkeys(names))

    def _match_joints(self, cell: Any, dataset_meta: Any) -> JointFeatures:
        """Find the joints among the entries of states and actions."""
        config, names = self.config, self.kinematics.joint_names
        state_names, action_names = config.state_names or names, config.action_names or names
        if self._model is not None:  # the robot at hand may state more than the data set did
            size = (len(state_names),)
            config.input_features[OBS_STATE] = PolicyFeature(FeatureType.STATE, size)
        self._check_size("state_names", state_names, config.robot_state_feature)
        self._check_size("action_names", action_names, config.action_feature)
        offsets = getattr(cell, "joint_offsets", {})
        if dataset_meta is not None:  # a converted set declares none
            offsets = read_declared(config, dataset_meta.features, "offsets")
        every = state_names, action_names, config.units
        return JointFeatures(names, *every, self.kinematics, offsets)

    def _locate_frames(
        self, names: Sequence[str], places: Mapping[str, Sequence[int | str]] | None
    ) -> FrameFeatures:
        """Find the poses of frames among the entries of observations."""
        config, environment = self.config, self.config.env_state_feature
        return FrameFeatures(
            names,
            places,
            config.environment_names,
            self.joints.state_names,
            config.default_environment_state,
            environment.shape[0] if environment else None,
        )

    def _describe_training(self, dataset_meta: Any) -> tuple[Kinematics, Sequence[Operator]]:
        """Return robot and operators of a policy that is not fitted."""
        config = self.config
        kinematics: Kinematics | None = config.kinematics()
        operators: Sequence[Operator] | None = config.decoded_operators()
        if dataset_meta is not None:
            kinematics, operators = adopt(config, dataset_meta)
        if kinematics is None or operators is None:
            raise DataError(
                "a policy that is not fitted needs a data set to be trained on: lerobot-train "
                "--policy.type=tpgmm --dataset.root=..., or TPGMMPolicy.from_estimator(model), "
                "or tpgmm fit ... --format lerobot"
            )
        # an object that only stands where links do differs from a misspelt link by its data
        known = {name for operator in operators for name in operator.references()}
        known |= list_placed(config)
        for operator in operators:
            operator.check(kinematics, known - set(kinematics.links))
        return kinematics, operators

    @staticmethod
    def _check_size(field: str, names: Sequence[str], feature: PolicyFeature) -> None:
        if tuple(feature.shape) != (len(names),):
            raise ShapeError(
                f"{field} are {list(names)}, {len(names)} entries, but the environment or data "
                f"set has a feature of shape {tuple(feature.shape)}. Is this policy for "
                f"another robot? Else name the entries in order, --policy.{field}='[...]'"
            )

    def _apply_overrides(self, model: TaskParameterizedGMM) -> TaskParameterizedGMM:
        """Return the model with the configuration's settings; what cannot change is refused."""
        config = self.config
        asked = config.decoded_operators()
        there = list(map(format_operator, model.operators_))  # which has no mean paths
        changed = {
            "n_components": config.n_components != len(model.weights_),
            "operators": asked is not None and list(map(format_operator, asked)) != there,
        }
        if wrong := [name for name, differs in changed.items() if differs]:
            raise ModelFileError(
                f"{', '.join(wrong)} of the configuration differ from the model beside it, "
                f"which has {len(model.weights_)} components and the operators {there}: fit "
                "again to change them"
            )
        given = config.given_holds()
        settings = {
            "fusion": FusionConfig.from_fusion(model.skill.fusion) != config.fusion,
            "holds": given not in (None, tuple(model.holds_)),
            "em.covariance_shrinkage": (
                config.em.covariance_shrinkage != model.covariance_shrinkage
            ),
            "em.dtype": config.em.dtype != model.dtype,
        }
        if not any(settings.values()):
            return model
        return TaskParameterizedGMM.from_parameters(
            model.weights_,
            model.means_,
            model.covariances_,
            model.time_,
            holds=model.holds_ if given is None else given,
            n_demonstrations=model.n_demonstrations_,
            peaks=model.skill.peaks,
            summary=model.summary_,
            **config.estimator(self.kinematics, model.operators_).get_params(deep=False),
        )

    @classmethod
    def from_estimator(
        cls,
        model: Any,
        *,
        fps: float | None = None,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        environment_names: Sequence[str] | None = None,
        frames: Mapping[str, Sequence[int | str]] | None = None,
        **options: Any,
    ) -> Self:
        """Make a policy that does what a fitted model does.

        Parameters
        ----------
        model : TaskParameterizedGMM or Skill
            Fitted.
        fps : float, optional
            Steps per second; by default those of the model's time grid.
        state_names, action_names, environment_names : sequence of str, optional
            Names of the entries of ``observation.state``, ``action`` and
            ``observation.environment_state``; by default states and actions are the model's
            joints in its order, and the environment holds its frames in the order of
            ``skill.frame_names``, with a warning if there are several.
        frames : mapping of str to sequence, optional
            As in :class:`TPGMMConfig`.
        **options
            Other fields of :class:`TPGMMConfig`.

        Raises
        ------
        NotFittedError
            If the model is not fitted.
        DataError, ModelFileError
            If names or frames do not fit the model, or it holds an operator or a robot of
            your own, which a file cannot describe.
        """
        settings = {"device": "cpu", "push_to_hub": False, **_settings(model)}
        if fps is not None:
            settings["fps"] = fps
        config = TPGMMConfig(**(settings | options))
        skill = _skill(model)
        tensors: dict[str, Tensor] = {}
        model = decode(encode(model, tensors), (), tensors)  # what no file can hold is refused
        config.state_names = list(state_names or skill.kinematics.joint_names)
        config.action_names = list(action_names or skill.kinematics.joint_names)
        config.environment_names = list(environment_names or ()) or None
        config.frames = {k: list(v) for k, v in (frames or {}).items()} or None
        seen = select_observed(config, skill.frame_names, skill.summary)
        poses = FrameFeatures(seen, config.frames, environment_names, config.state_names, None)
        _warn_of_order(config, list_missing(poses.in_environment, config.frames or ()))
        sizes = len(config.state_names), poses.n_environment, len(config.action_names)
        config.input_features, config.output_features = state_features(*sizes).values()
        return cls(config, model=model).eval().to(config.device)

    def to_estimator(self) -> Any:
        """Return the fitted model or skill that the policy is.

        Raises
        ------
        NotFittedError
            If the policy is not fitted.
        """
        if self._model is None:
            raise NotFittedError("the policy is not fitted: train it, or use from_estimator")
        device = self._placeholder.device
        if _skill(self._model).kinematics.lower.device != device:
            tensors: dict[str, Tensor] = {}
            described = encode(self._model, tensors)
            model = decode(described, (), {k: v.to(device) for k, v in tensors.items()})
            if isinstance(model, TaskParameterizedGMM):
                model.set_params(device=str(device))
            self._model = model
        return self._model

    @property
    def skill(self) -> Skill:
        """Skill that an episode runs: the model's, through the via-points."""
        skill, points = _skill(self.to_estimator()), self.config.via_points
        return ViaPoints(skill, points, self.config.via_fade) if points else skill

    def reset(self) -> None:
        """Begin a new episode with the next observation."""
        self._controller: Controller | None = None
        self._chunk: Chunk | None = None
        self._ticks, self._statuses = TickDurations(), dict[int, list[str]]()
        self._stand: Any = None
        self._ages: dict[str, Any] = {}  # what keeps robots from moving
        if self.watch is not None:
            self.watch.reset()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_unused: Any) -> Tensor:
        """Return the next joint references.

        Parameters
        ----------
        batch : dict of str to Tensor
            ``observation.state`` (B, n_state) and what the frames are read from; in the middle
            of an episode they need not be finite. ``observation.timestamp`` (B, 1) says how
            much time has passed [s], where it is there; what a tick comes late is caught up by
            those that follow. ``observation.wrench.LINK`` (B, 6) is what a link exerts. With a
            cell, the pictures of its cameras (B, 3, height, width) in [0, 1]: robots stand
            until all objects were seen.

        Returns
        -------
        Tensor of shape (B, n_action)
            float32. After the end of the time grid it stays.

        Raises
        ------
        DataError, ShapeError
            If the observation is not what the policy was made for.
        """
        batch = self._look(batch, 1 / self.config.rate)
        if self._controller is None:
            self._controller = self._begin(batch)
        if self._controller is None:
            return self.joints.action(self._stand)
        return self.joints.action(self._step(self._controller, batch))

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Tensor],
        *,
        prev_chunk_left_over: Tensor | None = None,
        **_unused: Any,
    ) -> Tensor:
        """Return the next ``chunk_size`` references, of robots that follow.

        Called again in an episode, it goes on from the step of the last chunk at which the
        robot is: before the first action that is left over, where LeRobot's ``rtc`` says
        that, else where the timestamp says, else where the posture is nearest.

        Parameters
        ----------
        batch : dict of str to Tensor
            As for :meth:`select_action`.
        prev_chunk_left_over : Tensor of shape (n, n_action), optional
            Actions of the last chunk that were not sent yet.

        Returns
        -------
        Tensor of shape (B, chunk_size, n_action)
        """
        now = batch.get(TIMESTAMP)
        timestamp, last = None if now is None else float(now.flatten()[0]), self._chunk
        batch, ahead = self._look(batch, None if self._controller is None else 0.0), None
        if self._controller is not None:  # select_action says how far the episode is
            ahead = self._controller.copy()
        elif last is None:
            ahead = self._begin(batch)
        else:
            joints = self._read_joints(batch)
            passed = last.find_last_sent(joints, timestamp, prev_chunk_left_over)
            measured, poses = self._measurements(batch, last.first)
            ahead = last.first.resumed(
                last.moments[passed], passed / self.config.rate, measured, poses
            )
        if ahead is None:
            return self.joints.action(self._stand)[:, None].repeat(1, self.config.chunk_size, 1)
        references = [self._step(ahead, batch, 1 / self.config.rate)]
        moments, first = [ahead], ahead
        ahead = ahead.copy() if self._ages else ahead.ahead()
        while len(references) < self.config.chunk_size:
            ahead.step(1 / self.config.rate, ages=self._ages)
            references.append(ahead.reference.reshape(references[0].shape))
            moments.append(ahead.copy())
        joints = torch.stack(references, dim=1)
        actions = self.joints.action(joints)
        if self._controller is None:
            self._chunk = Chunk(first, moments, joints, actions, timestamp, self.config.rate)
        return actions

    def supports_rtc(self) -> bool:
        """Return True: ``lerobot-rollout --inference.type=rtc`` may be used."""
        return True

    def _look(self, batch: dict[str, Tensor], passed: float | None) -> dict[str, Tensor]:
        """Add the poses that are seen in the pictures of an observation, if there is a cell."""
        first = self._controller is None and self._chunk is None
        if self.watch is None or not (first or self.config.control.follow_frames):
            return batch
        images = {k: v.numpy(force=True) for k, v in batch.items() if k.startswith(OBS_IMAGES)}
        now, joints = batch.get(TIMESTAMP), self._read_joints(batch).numpy(force=True)
        times = None if now is None else now.flatten().numpy(force=True)
        self.watch.look(images, joints, passed, times)
        self._ages = self.watch.ages()
        return self.frames.with_poses(
            batch, self.watch.first() if first else self.watch.poses()
        )

    def _begin(self, batch: Mapping[str, Tensor]) -> Controller | None:
        """Start the skill; None while robots stand because not all objects were seen."""
        check_rate(batch, self.config.rate)
        joints = self._read_joints(batch)
        if self.watch is not None:
            if self._stand is None:
                self._stand = self.kinematics.joint_tensor(joints)
            joints = self._stand
            if missing := self.watch.missing():
                if missing != self._statuses.get(-1):
                    log.info("%s before the start: %s", Status.HOLDING, "; ".join(missing))
                self._statuses[-1] = missing
                return None
        frames = self.frames.frames(batch)
        if len(joints) == 1:  # one robot is faster without a batch
            joints, frames = joints[0], {name: frame[0] for name, frame in frames.items()}
        options = self.config.control.options()
        if self.config.obstacles is not None:
            options["obstacles"] = self._scene
        return Controller(self.skill, joints, frames, **options)

    @cached_property
    def _scene(self) -> Scene:
        """The obstacles, and links that come near each other as they were shown to."""
        path, _, visuals = (self.config.obstacles or "").partition(":")
        scene = Scene(self.kinematics, path, visuals=visuals == "visuals")
        return scene.allowing_skill(self.skill)

    def _measurements(
        self, batch: Mapping[str, Tensor], controller: Controller
    ) -> tuple[Tensor | None, dict[str, Any] | None]:
        """Return joints and poses for a controller, as they were measured."""
        shape, config, measured = (
            controller.reference.shape,
            self.config,
            self._read_joints(batch),
        )
        begun = shape[0] if len(shape) == 2 else 1
        if len(measured) != begun:
            raise ShapeError(
                f"the episode began with {begun} robots, now there are {len(measured)}: "
                "call reset() between episodes"
            )
        first = controller.command is None
        poses = self.frames.poses(batch) if config.control.follow_frames and not first else {}
        if len(shape) == 1:
            measured = measured[0]
            poses = {n: None if pose is None else pose[0] for n, pose in poses.items()}
        return measured if config.control.closed_loop else None, poses or None

    def _wrenches(
        self, batch: Mapping[str, Tensor], controller: Controller
    ) -> dict[str, Tensor]:
        """Return wrenches of links, ``observation.wrench.LINK``, as they were measured."""
        links = {WRENCH + link: link for link in self.kinematics.links}
        shape = *controller.reference.shape[:-1], 6
        return {links[key]: batch[key].reshape(shape) for key in links.keys() & batch.keys()}

    def _step(
        self, controller: Controller, batch: Mapping[str, Tensor], passed: Any = None
    ) -> Tensor:
        """Compute the references (B, n_joints) of the next action."""
        start, first = controller.reference, controller.command is None
        measured = self._measurements(batch, controller)
        passed = self._measure_tick(batch) if passed is None else passed
        passed = float(passed) if start.ndim == 1 else passed
        wrenches = self._wrenches(batch, controller)
        command = controller.step(passed, *measured, ages=self._ages, wrenches=wrenches)
        if first:
            self._check_start(start, command.estimate.joints)
        self._log(command)
        return controller.reference.reshape(-1, start.shape[-1])

    def _log(self, command: Command) -> None:
        """Log a line for each robot whose status is another one than at the last action."""
        several = command.codes.ndim > 0
        times = command.time.expand(command.codes.shape).flatten().tolist()
        for robot, status in enumerate(command.status if several else [command.status]):
            unseen = {} if self.watch is None else self.watch.unseen(robot)
            reasons = command.reason(robot if several else ()), *unseen.values()
            if (told := [str(status), *unseen]) != self._statuses.get(robot, [Status.RUNNING]):
                what = ": ".join(filter(None, (status, "; ".join(filter(None, reasons)))))
                log.info("robot %d at %.2f s of the skill: %s", robot, times[robot], what)
            self._statuses[robot] = told

    def _measure_tick(self, batch: Mapping[str, Tensor]) -> float | Tensor:
        """Return the seconds for which the next reference is."""
        period, now = 1 / self.config.rate, batch.get(TIMESTAMP)
        return period if now is None else self._ticks.next(now, period)

    def _check_start(self, start: Tensor, wanted: Tensor) -> None:
        """Refuse to move robots that stand far from where the skill begins."""
        largest, gap = self.config.control.largest_start_gap, (wanted - start).abs()
        if known := {*self.kinematics.angles, *self.kinematics.lengths}:
            gap[..., [i for i in range(gap.shape[-1]) if i not in known]] = 0  # of any unit
        if largest is None or not bool((gap > largest).any()):
            return
        row, joint = divmod(int(gap.argmax()), gap.shape[-1])
        stands, begins = (float(q.flatten()[gap.argmax()]) for q in (start, wanted))
        raise DataError(
            f"joint {self.kinematics.joint_names[joint]!r} of robot {row} stands at "
            f"{stands:.4g} rad, but the skill begins at {begins:.4g} rad: the "
            "order of the state's entries (--policy.state_names) or their unit "
            "(--policy.units) is wrong, or the robot has to be brought to the start first. "
            f"Further than {largest} rad is refused "
            "(--policy.control.largest_start_gap, null for any)"
        )

    def _read_joints(self, batch: Mapping[str, Tensor]) -> Tensor:
        if OBS_STATE not in batch:
            raise DataError(f"the policy needs {OBS_STATE}; the batch has {sorted(batch)}")
        return self.joints.joints(batch[OBS_STATE])

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, None]:
        """Learn a batch of a data set; see :mod:`lerobot_policy_tpgmm.training.learner`.

        Parameters
        ----------
        batch : dict of str to Tensor
            As LeRobot's data loader gives it, behind the preprocessor.

        Returns
        -------
        loss : Tensor of shape ()
            0: nothing is minimised. Without gradient for any parameter.
        None
            Where other policies have more figures for the log.

        Raises
        ------
        DataError, NotFittedError
            If the policy knows no data set, or the batch cannot be learned from.
        """
        if self._learner is None:
            raise DataError(
                "training needs the data set's meta data: make_policy(config, ds_meta=...) "
                "passes them, or TPGMMPolicy(config, dataset_meta=dataset.meta)"
            )
        self._model = self._learner.learn(batch, self.training)
        # no gradient, not a zero one: an optimizer's momentum must not move anything
        return torch.zeros((), requires_grad=True), None

    def train(self, mode: bool = True) -> Self:
        """Switch between training and use; what was collected in training is fitted by then."""
        if not mode and self._learner is not None:
            self._model = self._learner.end_epoch()
        return super().train(mode)

    def get_optim_params(self) -> Any:
        """Return a parameter that nothing changes, as an optimizer needs one."""
        return self.parameters()

    def _save_pretrained(
        self, save_directory: Path, state_dict: dict[str, Tensor] | None = None
    ) -> None:
        if self._learner is not None:
            self._learner.check_saveable()
            self._model = self._learner.model
        write_files(self.config, self.to_estimator(), Path(save_directory))

    def push_to_hub(self, repo_id: str, **options: Any) -> str:
        """Upload the policy to the Hugging Face hub, with a card made from it.

        Parameters
        ----------
        repo_id : str
            ``"owner/name"``; made if it does not exist.
        **options
            ``measured``, ``notes``, ``license``, ``private`` and ``token``, as of
            :func:`tpgmm_torch.hub.push`.

        Returns
        -------
        str
            Address of the commit.

        Raises
        ------
        DataError
            If that is no repository's id, or the policy cannot be saved.
        """
        about: dict[str, Any] = {"license": self.config.license}
        about |= {name: options.pop(name) for name in FOR_THE_CARD if name in options}
        card = model_card(self.to_estimator(), repo_id, use=USE, library="lerobot", **about)
        return upload(repo_id, self.save_pretrained, card, **options)

    def generate_model_card(self, *given: Any, **options: Any) -> Any:
        """Return LeRobot's card, which ``lerobot-train`` uploads, and what the mixture says."""
        card = super().generate_model_card(*given, **options)
        card.content = f"{card.content.rstrip()}\n\n{describe(self.to_estimator())}\n"
        return card

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: TPGMMConfig | None = None,
        revision: str | None = None,
        token: str | None = None,
        **options: Any,
    ) -> Self:
        """Load a policy from a folder, or from the Hugging Face hub by its id.

        Parameters
        ----------
        pretrained_name_or_path : str or Path
            A missing folder that is written as one, ``/home/me/policy``, is not looked up on
            the hub.
        config, revision, token, **options
            As for LeRobot's ``PreTrainedPolicy``.

        Raises
        ------
        ModelFileError
            If the folder is missing, a file in it is damaged, missing or of another release,
            or the configuration does not belong to the model.
        """
        name = str(pretrained_name_or_path)
        recover(name)
        if not Path(name).is_dir():
            if name.startswith((".", "/", "~")):
                raise ModelFileError(f"there is no folder {name}")
            name = str(download(name, PATTERNS, revision=revision, token=token))
        folder = Path(name)
        try:
            model, config = consistent(
                folder,
                lambda: (
                    read_model(folder),
                    config or PreTrainedConfig.from_pretrained(folder, **options),
                ),
            )
            if learned := json.loads(read_whole(folder / CONFIG_NAME)).get("cell"):
                config.cell = take_over(config.cell, learned)
            policy = cls(config, model=model, **options).eval().to(config.device)
            validate(policy.skill)  # with the settings of the configuration
        except TPGMMError:
            raise
        except Exception as error:  # of LeRobot, its parser and torch
            raise ModelFileError(f"{folder / CONFIG_NAME} cannot be read: {error}") from error
        # LeRobot passes none of this on to a policy: who starts it must compare
        log.info(
            "observation.state is taken as %s; actions are %s, %g per second (--fps)",
            list(policy.joints.state_names),
            list(policy.joints.action_names),
            policy.config.rate,
        )
        return policy


def _skill(model: Any) -> Any:
    """Return the skill of a model, or a skill itself."""
    return model.skill if isinstance(model, TaskParameterizedGMM) else model


def _settings(model: Any) -> dict[str, Any]:
    """Return the settings of a model or skill for a configuration."""
    skill = _skill(model)
    try:
        time = skill.time
    except AttributeError:
        raise DataError(f"a policy is made of a model or a skill, got {model!r}") from None
    rate = round(float((len(time) - 1) / (time[-1] - time[0])), 6) if len(time) > 1 else None
    settings: dict[str, Any] = {"fps": rate}
    if isinstance(model, TaskParameterizedGMM):
        em = {field.name: getattr(model, field.name) for field in fields(EMConfig)}
        if not isinstance(em["random_state"], int):  # a configuration has no generator
            em["random_state"] = None
        settings |= {"em": EMConfig(**em), "n_components": len(model.weights_)}
        settings["fusion"] = FusionConfig.from_fusion(model.skill.fusion)
    return settings


def _warn_of_order(config: TPGMMConfig, frames: Sequence[str]) -> None:
    """Warn if only the order of the operators says which pose is which object's."""
    if len(frames) > 1 and not config.environment_names:
        warnings.warn(
            f"nothing says which entries of {OBS_ENV_STATE} belong to which object: they "
            f"are read as the poses of {list(frames)}, in the order in which the operators "
            "name them. Say it by environment_names, the names of the entries in the data set "
            "('bottle.x', ..., 'bottle.qz'), or by frames",
            PlausibilityWarning,
            stacklevel=3,
        )

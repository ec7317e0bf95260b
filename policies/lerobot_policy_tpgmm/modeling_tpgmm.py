"""The policy: a fitted mixture behind LeRobot's interface."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import torch
from draccus.utils import DecodingError, ParsingError
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from lerobot_policy_tpgmm.configuration_tpgmm import (
    TPGMMConfig,
    state_features,
)
from lerobot_policy_tpgmm.control_rate import check_rate
from lerobot_policy_tpgmm.dataset_contract import adopt, check_dataset
from lerobot_policy_tpgmm.mixture_parameters import MixtureParameters
from lerobot_policy_tpgmm.observations import (
    FrameFeatures,
    JointFeatures,
    observed_frames,
    poses_named,
)
from lerobot_policy_tpgmm.policy_files import check_files, read_tensors, write_files
from lerobot_policy_tpgmm.settings import EMConfig
from lerobot_policy_tpgmm.tick_durations import TickDurations
from lerobot_policy_tpgmm.training.learner import Learner
from tpgmm_tools.hub import describe, model_card, upload
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.atomic import recover
from tpgmm_torch.control.controller import Controller
from tpgmm_torch.exceptions import (
    DataError,
    ModelFileError,
    NotFittedError,
    PlausibilityWarning,
    ShapeError,
)
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.base import frame_names

__all__ = ["TPGMMPolicy"]

log = logging.getLogger(__name__)

#: What :meth:`TPGMMPolicy.push_to_hub` is told for the card, and how that says to run it.
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
        After its first action: what it was told last.
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

    def passed(
        self, measured: Tensor, timestamp: float | None, left_over: Tensor | None
    ) -> int:
        """The index of the action that was sent last."""
        last = len(self.moments) - 1
        if left_over is not None:
            # rows of zeros fill up what is shorter than LeRobot's horizon
            same = (self.actions[0] == left_over[:1]).all(-1) if len(left_over) else None
            if same is None or not bool(left_over.any()):
                return last
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
    **unused
        What else LeRobot passes.

    Raises
    ------
    DataError, ShapeError, ModelFileError, UnknownNameError
        If the configuration is incomplete, or contradicts itself or the data set.
    """

    config_class = TPGMMConfig
    name = "tpgmm"

    mixture: MixtureParameters

    def __init__(
        self,
        config: TPGMMConfig,
        dataset_stats: object = None,
        dataset_meta: Any = None,
        **unused: Any,
    ) -> None:
        super().__init__(config)
        self.config = config
        if dataset_meta is not None:
            (check_dataset if config.fitted else adopt)(config, dataset_meta)
        kinematics, operators = config.kinematics(), config.decoded_operators()
        if kinematics is None or not operators:
            raise DataError(
                "a policy that is not fitted needs a data set to be trained on: lerobot-train "
                "--policy.type=tpgmm --dataset.root=..., or TPGMMPolicy.from_estimator(model), "
                "or tpgmm fit ... --format lerobot"
            )
        config.validate_features()
        self.kinematics = kinematics.to(getattr(torch, config.em.dtype))
        required = list(frame_names([*operators, *config.via_operators()], kinematics))
        # an object that only stands where links do is told from a misspelt link by its data
        known = {name for operator in operators for name in operator.references()}
        known |= {*(config.frames or ()), *poses_named(config.environment_names)}
        known |= {*poses_named(config.state_names)}
        for operator in operators:
            operator.check(self.kinematics, known - set(self.kinematics.links))
        self._make_mixture(operators)
        names = self.kinematics.joint_names
        state_names = config.state_names or names
        if config.fitted:  # the robot at hand may state more than the data set did
            size = (len(state_names),)
            config.input_features[OBS_STATE] = PolicyFeature(FeatureType.STATE, size)
        self._check_size("state_names", state_names, config.robot_state_feature)
        action_names = config.action_names or names
        self._check_size("action_names", action_names, config.action_feature)
        self.joints = JointFeatures(names, state_names, action_names, config.units)
        environment = config.env_state_feature
        width = environment.shape[0] if environment else None
        named = config.environment_names, state_names
        told = observed_frames(config, required)
        default = config.default_environment_state
        self.frames = FrameFeatures(told, config.frames, *named, default, width)
        self._learner: Learner | None = None
        if dataset_meta is not None:
            recorded = [name for name in required if name not in config.training.link_frames]
            places = {n: p for n, p in (config.frames or {}).items() if n in recorded}
            shown = FrameFeatures(recorded, places, *named, default, width)
            self._learner = Learner(
                config,
                self.kinematics,
                operators,
                self.mixture,
                self.joints,
                shown,
                dataset_meta,
                self._become,
            )
        self.reset()

    @staticmethod
    def _check_size(field: str, names: Sequence[str], feature: PolicyFeature) -> None:
        if tuple(feature.shape) != (len(names),):
            raise ShapeError(
                f"{field} are {list(names)}, {len(names)} entries, but the environment or data "
                f"set has a feature of shape {tuple(feature.shape)}. Is this policy for "
                f"another robot? Else name the entries in order, --policy.{field}='[...]'"
            )

    def _make_mixture(self, operators: Sequence[Operator]) -> None:
        """The mixture, once the number of time steps is known."""
        config, dtype = self.config, getattr(torch, self.config.em.dtype)
        dimensions = [one.dimension(self.kinematics) for one in operators]
        self.mixture = MixtureParameters(
            config.n_components, dimensions, config.fit.n_steps, dtype
        )

    def _become(self, model: TaskParameterizedGMM) -> None:
        """Take over what a fitted model is."""
        self.config.note(model)
        self.mixture.copy_from(model)
        self.to(self.mixture.time.device)

    @classmethod
    def from_estimator(
        cls,
        model: TaskParameterizedGMM,
        *,
        fps: float | None = None,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        environment_names: Sequence[str] | None = None,
        frames: Mapping[str, Sequence[int | str]] | None = None,
        **options: Any,
    ) -> Self:
        """A policy that does what a fitted model does.

        Parameters
        ----------
        model : TaskParameterizedGMM
            Fitted.
        fps : float, optional
            Steps per second; by default those of the model's time grid.
        state_names, action_names, environment_names : sequence of str, optional
            Names of the entries of ``observation.state``, ``action`` and
            ``observation.environment_state``; by default states and actions are the model's
            joints in its order, and the environment holds its frames in the order of
            ``model.frame_names_``, with a warning if there are several.
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
        if not isinstance(model, TaskParameterizedGMM):
            raise DataError(
                f"a policy is made of a TaskParameterizedGMM, got {type(model).__name__}"
            )
        if not hasattr(model, "weights_"):
            raise NotFittedError("the model is not fitted: call fit(demonstrations) first")
        kinematics, time = model.kinematics_, model.time_
        if fps is None and len(time) > 1:
            fps = round(float((len(time) - 1) / (time[-1] - time[0])), 6)
        config = TPGMMConfig(
            **{
                "device": "cpu",
                "push_to_hub": False,
                "fps": fps,
                "em": _settings(model),
                **options,
            }
        )
        config.describe(kinematics, model.operators_)
        config.note(model)
        config.state_names = list(state_names or kinematics.joint_names)
        config.action_names = list(action_names or kinematics.joint_names)
        config.environment_names = list(environment_names) if environment_names else None
        config.frames = {k: list(v) for k, v in frames.items()} if frames else None
        told = observed_frames(config, model.frame_names_)
        poses = FrameFeatures(told, config.frames, environment_names, config.state_names, None)
        given = frames or {}
        order = [name for name in poses.in_environment if name not in given]
        if len(order) > 1 and not environment_names:
            warnings.warn(
                f"nothing says which entries of {OBS_ENV_STATE} belong to which object: they "
                f"are read as the poses of {order}, in the order in which the operators name "
                "them. Say it by environment_names, the names of the entries in the data set "
                "('bottle.x', ..., 'bottle.qz'), or by frames",
                PlausibilityWarning,
                stacklevel=2,
            )
        sizes = len(config.state_names), poses.n_environment, len(config.action_names)
        config.input_features, config.output_features = state_features(*sizes).values()
        policy = cls(config)
        policy._become(model)
        return policy.eval().to(config.device)

    def to_estimator(self) -> TaskParameterizedGMM:
        """The fitted model that the policy is."""
        device = self.mixture.time.device
        operators, kinematics = (
            self.config.decoded_operators(),
            self.kinematics.to(device=device),
        )
        model = self.config.estimator(kinematics, operators).set_params(device=str(device))
        return self.mixture.to_estimator(model, **self.config.learned())

    def reset(self) -> None:
        """Begin a new episode with the next observation."""
        self._controller: Controller | None = None
        self._chunk: Chunk | None = None
        self._ticks = TickDurations()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_unused: Any) -> Tensor:
        """The next joint references.

        Parameters
        ----------
        batch : dict of str to Tensor
            ``observation.state`` (B, n_state) and what the frames are read from; in the middle
            of an episode they need not be finite. ``observation.timestamp`` (B, 1) says how
            much time has passed [s], where it is there; what a tick comes late is caught up by
            those that follow.

        Returns
        -------
        Tensor of shape (B, n_action)
            float32. After the end of the time grid it stays.

        Raises
        ------
        DataError, ShapeError
            If the observation is not what the policy was made for.
        """
        if self._controller is None:
            self._controller = self._begin(batch)
        return self.joints.action(self._step(self._controller, batch))

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Tensor],
        *,
        prev_chunk_left_over: Tensor | None = None,
        **_unused: Any,
    ) -> Tensor:
        """The next ``chunk_size`` references, of robots that follow.

        Called again in an episode, it goes on from the step of the last chunk at which the
        robot is: before the first action that is left over, where LeRobot's ``rtc`` tells
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
        if self._controller is not None:  # select_action says how far the episode is
            ahead = self._controller.copy()
        elif last is None:
            ahead = self._begin(batch)
        else:
            passed = last.passed(self._observed(batch), timestamp, prev_chunk_left_over)
            measured, poses = self._told(batch, last.first)
            ahead = last.first.resumed(
                last.moments[passed], passed / self.config.rate, measured, poses
            )
        references = [self._step(ahead, batch, 1 / self.config.rate)]
        moments, first, ahead = [ahead], ahead, ahead.ahead()
        while len(references) < self.config.chunk_size:
            ahead.step(1 / self.config.rate)
            references.append(ahead.reference.reshape(references[0].shape))
            moments.append(ahead.copy())
        joints = torch.stack(references, dim=1)
        actions = self.joints.action(joints)
        if self._controller is None:
            self._chunk = Chunk(first, moments, joints, actions, timestamp, self.config.rate)
        return actions

    def supports_rtc(self) -> bool:
        """Whether ``lerobot-rollout --inference.type=rtc`` may be used: yes."""
        return True

    def _begin(self, batch: Mapping[str, Tensor]) -> Controller:
        check_rate(batch, self.config.rate)
        skill = self.config.skill(self.to_estimator())
        joints, frames = self._observed(batch), self.frames.frames(batch)
        if len(joints) == 1:  # one robot is sooner computed without a batch
            joints, frames = joints[0], {name: frame[0] for name, frame in frames.items()}
        return Controller(skill, joints, frames, **self.config.control.options())

    def _told(
        self, batch: Mapping[str, Tensor], controller: Controller
    ) -> tuple[Tensor | None, dict[str, Any] | None]:
        """Joints and poses that a controller is told."""
        shape, config, measured = controller.reference.shape, self.config, self._observed(batch)
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

    def _step(
        self, controller: Controller, batch: Mapping[str, Tensor], passed: Any = None
    ) -> Tensor:
        """The references (B, n_joints) of the next action."""
        start, first = controller.reference, controller.command is None
        told = self._told(batch, controller)
        passed = self._passed(batch) if passed is None else passed
        command = controller.step(float(passed) if start.ndim == 1 else passed, *told)
        if first:
            self._check_start(start, command.estimate.joints)
        return controller.reference.reshape(-1, start.shape[-1])

    def _passed(self, batch: Mapping[str, Tensor]) -> float | Tensor:
        """Seconds for which the next reference is."""
        period, now = 1 / self.config.rate, batch.get(TIMESTAMP)
        return period if now is None else self._ticks.next(now, period)

    def _check_start(self, start: Tensor, wanted: Tensor) -> None:
        """Refuse to move robots that stand far from where the skill begins."""
        largest, gap = self.config.control.largest_start_gap, (wanted - start).abs()
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

    def _observed(self, batch: Mapping[str, Tensor]) -> Tensor:
        if OBS_STATE not in batch:
            raise DataError(f"the policy needs {OBS_STATE}; the batch has {sorted(batch)}")
        return self.joints.joints(batch[OBS_STATE])

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, None]:
        """The loss of a batch of a data set; see :mod:`lerobot_policy_tpgmm.training.learner`.

        Parameters
        ----------
        batch : dict of str to Tensor
            As LeRobot's data loader gives it, behind the preprocessor.

        Returns
        -------
        loss : Tensor of shape ()
        None
            Where other policies have more figures for the log.

        Raises
        ------
        DataError, NotFittedError
            If the policy was not told of a data set, or the batch cannot be learned from.
        """
        if self._learner is None:
            raise DataError(
                "training needs the data set's meta data: make_policy(config, ds_meta=...) "
                "passes them, or TPGMMPolicy(config, dataset_meta=dataset.meta)"
            )
        return self._learner.loss(batch, self.training), None

    def train(self, mode: bool = True) -> Self:
        """Switch between training and use; what was collected in training is fitted by then."""
        if not mode and self._learner is not None:
            self._learner.end_epoch()
        return super().train(mode)

    def get_optim_params(self) -> Any:
        """What gradient training changes: the mixture of one way.

        Others are found when there is an optimizer already, and a run that is resumed has to
        find in it as many parameters as before.
        """
        return self.mixture.parameters()

    def _save_pretrained(
        self, save_directory: Path, state_dict: dict[str, Tensor] | None = None
    ) -> None:
        if self._learner is not None:
            self._learner.check_saveable()
        self.to_estimator()  # refuses what could not be loaded
        write_files(self.config, state_dict or self.state_dict(), Path(save_directory))

    def push_to_hub(self, repo_id: str, **options: Any) -> str:
        """Upload the policy to the Hugging Face hub, with a card made from it.

        Parameters
        ----------
        repo_id : str
            ``"owner/name"``; made if it does not exist.
        **options
            ``measured``, ``notes``, ``license``, ``private`` and ``token``, as of
            :func:`tpgmm_tools.hub.push`.

        Returns
        -------
        str
            Address of the commit.

        Raises
        ------
        DataError
            If that is no repository's id, or the policy cannot be saved.
        """
        told: dict[str, Any] = {"license": self.config.license}
        told |= {name: options.pop(name) for name in FOR_THE_CARD if name in options}
        card = model_card(self.to_estimator(), repo_id, use=USE, library="lerobot", **told)
        return upload(repo_id, self.save_pretrained, card, **options)

    def generate_model_card(self, *given: Any, **options: Any) -> Any:
        """LeRobot's card, which ``lerobot-train`` uploads, and what the mixture says."""
        card = super().generate_model_card(*given, **options)
        card.content = f"{card.content.rstrip()}\n\n{describe(self.to_estimator())}\n"
        return card

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **options: Any) -> Self:
        """Load a policy from a folder, or from the Hugging Face hub by its id.

        Parameters
        ----------
        pretrained_name_or_path : str or Path
            A missing folder that is written as one, ``/home/me/policy``, is not looked up on
            the hub.
        **options
            As for LeRobot's ``PreTrainedPolicy``.

        Raises
        ------
        ModelFileError
            If the folder is missing, or a file in it is damaged, missing, changed, or of
            another save than the others.
        """
        folder = Path(pretrained_name_or_path)
        recover(folder)
        if folder.is_dir():
            check_files(folder)
        elif str(pretrained_name_or_path).startswith((".", "/", "~")):
            raise ModelFileError(f"there is no folder {folder}")
        try:
            return super().from_pretrained(pretrained_name_or_path, **options)
        except (DecodingError, ParsingError) as error:
            raise ModelFileError(
                f"{folder / CONFIG_NAME} cannot be read: {error}. Policies of 0.1 and 0.2 are "
                "not read any more: fit again"
            ) from error

    @classmethod
    def _load_as_safetensor(
        cls, model: Self, model_file: str, map_location: str, strict: bool
    ) -> Self:
        """Strictly, whatever ``strict`` says: LeRobot itself only warns of what is missing."""
        model.load_state_dict(read_tensors(model_file, model.state_dict()))
        model.to_estimator()  # refuses numbers that are no mixture
        # a robot of LeRobot tells none of this to a policy: who starts it must compare
        log.info(
            "observation.state is taken as %s; actions are %s, %g per second (--fps)",
            list(model.joints.state_names),
            list(model.joints.action_names),
            model.config.rate,
        )
        return model


def _settings(model: TaskParameterizedGMM) -> EMConfig:
    """Settings with which a model was learned; a policy has no generator of its own."""
    settings = {each.name: getattr(model, each.name) for each in fields(EMConfig)}
    if not isinstance(settings["random_state"], int):
        settings["random_state"] = None
    return EMConfig(**settings)

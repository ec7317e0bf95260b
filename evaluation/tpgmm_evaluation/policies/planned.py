"""Common parts of the baselines that plan ahead."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, Self

import torch
from lerobot.optim import SGDConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_policy_tpgmm.configuration_tpgmm import StatePolicyConfig, state_features
from lerobot_policy_tpgmm.observations import FrameFeatures, JointFeatures
from tpgmm_evaluation.policies.aligned import Aligned
from tpgmm_torch import Frame
from tpgmm_torch.persistence import decode, encode
from tpgmm_torch.robots.kinematics import Kinematics


@dataclass
class PlannedConfig(StatePolicyConfig):
    """Configuration of a :class:`PlannedPolicy`."""

    def validate_features(self) -> None:
        """Accept all features."""

    def get_optimizer_preset(self) -> SGDConfig:
        """Return a preset that LeRobot asks for; nothing is trained by gradient."""
        return SGDConfig()


class PlannedPolicy(PreTrainedPolicy):  # type: ignore[misc]
    """Plays what it planned when it last looked; at the end of a plan its last action.

    Parameters
    ----------
    config : PlannedConfig
    **unused
        What else LeRobot passes.
    """

    config_class = PlannedConfig
    name = "planned"

    def __init__(self, config: PlannedConfig, **unused: Any) -> None:
        super().__init__(config)
        self.config = config
        PlannedPolicy.reset(self)

    @property
    def looks(self) -> tuple[int, ...]:
        """The steps at which it looks and plans, from the first, 0, on."""
        return (0,)

    @abstractmethod
    def plan(self, batch: dict[str, Tensor], step: int) -> Tensor:
        """Plan actions (B, n, n_action) from a step on, from what is observed then.

        Parameters
        ----------
        batch : dict of str to Tensor
            Observations of B robots, each of which is planned for by itself.
        step : int
            One of ``looks``.
        """

    def reset(self) -> None:
        """Begin a new episode with the next observation."""
        self._plan: Tensor | None = None
        self._step = self._planned = 0

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_unused: Any) -> Tensor:
        """Return the next action."""
        if self._plan is None or self._step in self.looks:
            self._plan, self._planned = self.plan(batch, self._step), self._step
        row = min(self._step - self._planned, self._plan.shape[1] - 1)
        self._step += 1
        return self._plan[:, row]

    def predict_action_chunk(self, batch: dict[str, Tensor], **_unused: Any) -> Tensor:
        """Return one action as a chunk."""
        return self.select_action(batch)[:, None]

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any]]:
        """Refuse: there is no loss."""
        raise NotImplementedError(f"{self.name} is fitted at once, not by gradient")

    def get_optim_params(self) -> Any:
        """Return no parameters."""
        return []


@dataclass
class SituatedConfig(PlannedConfig):
    """Configuration of a policy that plans in a robot's joints, from poses of objects.

    Parameters
    ----------
    fps : int
        Actions per second.
    n_steps : int
        Of the whole skill.
    robot : dict
        As :func:`tpgmm_torch.persistence.encode` describes it.
    frames : list of str
        The objects whose poses are observed.
    state_names, action_names, environment_names : list of str
        What the entries of states, actions and environment states are.
    """

    fps: int = 100
    n_steps: int = 1
    robot: dict[str, Any] = field(default_factory=dict)
    frames: list[str] = field(default_factory=list)
    state_names: list[str] = field(default_factory=list)
    action_names: list[str] = field(default_factory=list)
    environment_names: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, aligned: Aligned, **fields: Any) -> Self:
        """Describe demonstrations of a skill, with ``fields`` of the configuration."""
        names = aligned.state_names, aligned.environment_names, aligned.action_names
        return cls(
            fps=aligned.fps,
            n_steps=len(aligned.mean),
            robot=encode(aligned.robot),
            frames=list(aligned.demonstrations[0].frames),
            state_names=list(names[0]),
            environment_names=list(names[1]),
            action_names=list(names[2]),
            **state_features(*map(len, names)),
            device="cpu",
            push_to_hub=False,
            **fields,
        )


@dataclass(frozen=True)
class Observed:
    """Observation that the plan of one robot is made from.

    Parameters
    ----------
    joints : Tensor of shape (n_joints,)
        Where the references go on from: the last one; at first the measured posture [rad].
    measured : Tensor of shape (n_joints,)
        The measured posture [rad].
    frames, first : dict of str to Frame
        Where the objects are now, and where they were at first.
    step : int
        One of the policy's ``looks``.
    """

    joints: Tensor
    measured: Tensor
    frames: dict[str, Frame]
    first: dict[str, Frame]
    step: int


class SituatedPolicy(PlannedPolicy):
    """Plans for each robot by itself: from its joints, and from where the objects are.

    Parameters
    ----------
    config : SituatedConfig
    **unused
        What else LeRobot passes.
    """

    config_class = SituatedConfig
    config: SituatedConfig
    name = "situated"
    #: The mean of the aligned references, and of the measured first postures.
    mean: Tensor
    start: Tensor

    def __init__(self, config: SituatedConfig, **unused: Any) -> None:
        super().__init__(config)
        robot = decode(config.robot)
        assert isinstance(robot, Kinematics)
        self.robot = robot
        names = config.state_names, config.action_names
        self.joints = JointFeatures(robot.joint_names, *names, None)
        self.objects = FrameFeatures(
            config.frames, None, config.environment_names, config.state_names, None
        )
        shape = config.n_steps, robot.n_joints
        self.register_buffer("mean", torch.zeros(shape, dtype=torch.float64))
        self.register_buffer("start", torch.zeros(shape[1], dtype=torch.float64))
        self.reset()

    @classmethod
    def fit(cls, aligned: Aligned, **options: Any) -> Self:
        """Learn from aligned demonstrations; ``options`` are fields of the configuration."""
        policy = cls(cls.config_class.of(aligned, **options))
        policy.mean[:], policy.start[:] = aligned.mean, aligned.starts.mean(0)
        return policy.eval()

    def recipe(self) -> dict[str, Any]:
        """Describe how it was made, for the record."""
        return {}

    def reset(self) -> None:
        """Begin a new episode with the next observation."""
        super().reset()
        self._first: list[dict[str, Frame]] = []
        self._last: Tensor | None = None

    @abstractmethod
    def references(self, seen: Observed) -> Tensor:
        """Plan joint references (n, n_joints) of one robot from a step on."""

    def plan(self, batch: dict[str, Tensor], step: int) -> Tensor:
        """Plan actions from a step on, one robot after the other."""
        measured = self.joints.joints(batch[OBS_STATE].double())
        seen = self.objects.frames(batch)
        frames = [{name: f[i] for name, f in seen.items()} for i in range(len(measured))]
        if not self._first:
            self._first = frames
        joints = measured if self._last is None else self._last
        plans = [
            self.references(Observed(joints[i], measured[i], frames[i], self._first[i], step))
            for i in range(len(measured))
        ]
        planned = torch.stack(plans).clamp(self.robot.lower, self.robot.upper)
        self._last = planned[:, -1]
        return self.joints.action(planned)

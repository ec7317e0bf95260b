"""Everything that a policy is but its numbers: what ``config.json`` holds."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_policy_tpgmm.settings import (
    ControlConfig,
    EMConfig,
    FitConfig,
    FusionConfig,
    TrainingConfig,
)
from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_datasets.conversion.poses import LinkPose
from tpgmm_datasets.events import parse_event
from tpgmm_datasets.robots import so101_urdf, upper_body_urdf
from tpgmm_torch import (
    Hold,
    Robot,
    TaskParameterizedGMM,
    ViaPoint,
)
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.constraints import check_parameters
from tpgmm_torch.exceptions import DataError, TPGMMError
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.text import format_operator, parse_operator
from tpgmm_torch.persistence import decode, encode
from tpgmm_torch.robots import Kinematics
from tpgmm_torch.skills.via_points import ViaPoints

__all__ = [
    "StatePolicyConfig",
    "TPGMMConfig",
    "state_features",
]


#: Robots that come with the package: what describes each, and its hands.
ROBOTS: dict[str, tuple[Callable[[], str], Sequence[str]]] = {
    "upper_body": (upper_body_urdf, HANDS),
    "so101": (so101_urdf, ("gripper_frame_link",)),
}


@dataclass
class StatePolicyConfig(PreTrainedConfig):  # type: ignore[misc]
    """What a policy shares that sees the present state alone, in SI units."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(
            ("STATE", "ENV", "ACTION"), NormalizationMode.IDENTITY
        )
    )

    def get_scheduler_preset(self) -> None:
        """No schedule."""

    @property
    def observation_delta_indices(self) -> None:
        """Only the present observation."""

    @property
    def action_delta_indices(self) -> None:
        """Only the present action."""

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""


def state_features(
    n_state: int, n_environment: int, n_action: int
) -> dict[str, dict[str, PolicyFeature]]:
    """``input_features`` and ``output_features`` of a policy on states of such sizes.

    There is no ``observation.environment_state`` where it has no entries.
    """
    inputs = {OBS_STATE: PolicyFeature(FeatureType.STATE, (n_state,))}
    if n_environment:
        inputs[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (n_environment,))
    outputs = {ACTION: PolicyFeature(FeatureType.ACTION, (n_action,))}
    return {"input_features": inputs, "output_features": outputs}


@PreTrainedConfig.register_subclass("tpgmm")
@dataclass
class TPGMMConfig(StatePolicyConfig):
    """Configuration of :class:`TPGMMPolicy`, ``--policy.type=tpgmm``.

    A policy that is fitted has everything here filled in; for training from a data set,
    ``robot``, ``links`` and what differs from the defaults are enough.

    Parameters
    ----------
    n_components : int, default=10
        Number of Gaussians.
    operators : list of str or dict, optional
        As text, ``"pose:l_hand@bottle + pose:r_hand@bottle"``, or as
        :func:`tpgmm_torch.persistence.encode` describes them. The default is the poses of
        all links in all frames, stacked, and the joints.
    holds : list of str, optional
        From when to when a link holds an object, ``["bottle@l_hand:4.3-9.1"]``, in seconds of
        the aligned skill. By default it is found in frames that are read at every step
        (``follow_frames``); an empty list stands for nothing.
    via_points : list of str, optional
        Poses or postures at times of the skill, ``["3.2:position:l_hand@bottle=0,0,0.1"]``, as
        :meth:`tpgmm_torch.ViaPoint.parse` reads them.
    via_fade : float, default=1.0
        For how long before and after a via-point the skill is another [s].
    robot : dict or str, optional
        The description that :func:`tpgmm_torch.persistence.encode` gives, with the text of
        the URDF in it; to begin with, the path of a URDF or an MJCF, ``"upper_body"`` or
        ``"so101"``. None for joints alone.
    links, joints, coordinates : list of str, optional
        For a robot given by its path, as for :meth:`tpgmm_torch.Robot.from_urdf`; the links of
        ``"upper_body"`` and ``"so101"`` are their hands if none are named. Joints may be
        patterns, and one text with commas: ``"left_*,waist_yaw"``.
    state_names, action_names, environment_names : list of str, optional
        What the entries of ``observation.state``, ``action`` and
        ``observation.environment_state`` are, in the order in which they come and go. Joints
        are found among them by name. Override them for a robot that has another order than
        the data set: LeRobot tells a policy neither.
    units : str or dict, optional
        Unit of the joints in states and actions: ``"rad"``, ``"deg"``, ``"m"``, ``"mm"``, or
        ``[factor, offset]`` that bring a value to radians; for all, or by name; to begin with,
        the path of LeRobot's calibration file, ``"arm.json"``. By default what the data set
        declares, else radians (and metres).
    frames : dict of str to list, optional
        Where the seven values x y z qw qx qy qz of each frame are: positions in
        ``observation.environment_state``, or names of entries of it or of
        ``observation.state``. By default names like ``bottle.x`` tell, else the frames follow
        one another in ``observation.environment_state``.
    default_environment_state : list of float, optional
        Taken where there is no observation of the frames.
    fps : float, optional
        Steps per second of the demonstrations.
    control_fps : float, optional
        Actions per second; by default ``fps``.
    chunk_size : int, default=50
        Number of steps of ``predict_action_chunk``.
    em, fusion, control, training : EMConfig, FusionConfig, ControlConfig, TrainingConfig
        Settings by subject: ``--policy.control.clock=even``.
    fit : FitConfig
        Filled in by a fit.
    push_to_hub : bool, default=False
        Whether lerobot-train uploads the policy in the end, to ``repo_id``.

    Raises
    ------
    DataError, InvalidParameterError
        If a value is none that exists.
    """

    n_components: int = 10
    # draccus tries the members of a union in order, and can turn anything into a str
    operators: list[dict[str, Any] | str] | None = None
    holds: list[str] | None = None
    via_points: list[str] | None = None
    via_fade: float = 1.0
    robot: dict[str, Any] | str | None = None
    links: list[str] = field(default_factory=list)
    joints: list[str] | str | None = None
    coordinates: list[str] = field(default_factory=list)

    state_names: list[str] | None = None
    action_names: list[str] | None = None
    environment_names: list[str] | None = None
    units: dict[str, list[float] | str] | str | None = None
    frames: dict[str, list[int | str]] | None = None
    default_environment_state: list[float] | None = None
    fps: float | None = None
    control_fps: float | None = None
    chunk_size: int = 50

    em: EMConfig = field(default_factory=EMConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            self._check()
        except TPGMMError as error:
            # LeRobot's parser of commands drops the words of a ValueError
            logging.getLogger(__name__).error("%s", error)
            raise

    def _check(self) -> None:
        rates = {"fps": self.fps, "control_fps": self.control_fps}
        rates["control.largest_start_gap"] = self.control.largest_start_gap
        for name, value in rates.items():
            if value is not None and not 0 < value < math.inf:
                raise DataError(f"{name} is a positive number or null, got {value}")
        for name, count, least in (
            ("fit.n_steps", self.fit.n_steps, 0),
            ("chunk_size", self.chunk_size, 1),
        ):
            if count < least:
                raise DataError(f"{name} is at least {least}, got {count}")
        if set(self.normalization_mapping.values()) - {NormalizationMode.IDENTITY}:
            raise DataError(
                "a tpgmm policy works in SI units, normalization_mapping is IDENTITY for all; "
                f"got {self.normalization_mapping}"
            )
        self.training.check()
        self.link_poses()
        for text in self.training.events.values():
            parse_event(text)
        self.control.options()
        check_parameters(self.estimator(None, ()))

    @property
    def fitted(self) -> bool:
        """Whether what a fit fills in is there."""
        return bool(self.fit.n_steps)

    @property
    def rate(self) -> float:
        """Actions per second.

        Raises
        ------
        DataError
            If neither ``control_fps`` nor ``fps`` is known.
        """
        rate = self.control_fps or self.fps
        if rate is None:
            raise DataError("the policy does not know its rate: set fps or control_fps")
        return rate

    def link_poses(self) -> dict[str, LinkPose]:
        """What ``link_frames`` stands for."""
        return {name: LinkPose.parse(text) for name, text in self.training.link_frames.items()}

    def kinematics(self) -> Kinematics | None:
        """The robot that ``robot`` describes, None for joints alone."""
        if self.robot is None or isinstance(self.robot, dict):
            return None if self.robot is None else decode(self.robot)
        urdf, links = self.robot, self.links
        if urdf in ROBOTS:
            described, hands = ROBOTS[urdf]
            urdf, links = described(), links or list(hands)
        joints = self.joints
        if isinstance(joints, str):
            joints = [name.strip() for name in joints.split(",")]
        return Robot.from_file(urdf, links, joints=joints, coordinates=self.coordinates)

    def decoded_operators(self) -> list[Operator] | None:
        """The operators that ``operators`` describes; None if it says nothing.

        Raises
        ------
        DataError
            If a text describes none.
        """
        if self.operators is None:
            return None
        if "auto" in self.operators:
            raise DataError(
                "a policy has its operators before it sees demonstrations: find them with "
                "'tpgmm fit --operator auto', which can write a policy, --format lerobot, also "
                "with --parts auto; or name those that it reports in operators"
            )
        return [
            parse_operator(item) if isinstance(item, str) else decode(item)
            for item in self.operators
        ]

    def describe(self, kinematics: Kinematics, operators: Any) -> None:
        """Write robot and operators into the configuration, complete in themselves.

        Raises
        ------
        ModelFileError
            If one of them has no description, or none that can be read back.
        """
        self.robot = encode(kinematics)
        self.operators = [_description(operator) for operator in operators]
        self.kinematics()  # what cannot be read back is refused now
        self.decoded_operators()

    def note(self, model: TaskParameterizedGMM) -> None:
        """Fill in what a fit has learned beside the mixture's numbers."""
        skill = model.skill
        self.n_components = len(model.weights_)
        # with the paths that it found
        self.operators = list(map(_description, model.operators_))
        self.holds = list(map(str, model.holds_))
        self.fit = FitConfig(
            len(model.time_),
            None if skill.summary is None else skill.summary.config(),
            None if skill.peaks is None else [each.tolist() for each in skill.peaks],
        )
        self.fusion = FusionConfig.of(skill.fusion)

    def skill(self, model: TaskParameterizedGMM) -> Any:
        """What an episode runs: the model's skill, through the via-points."""
        if not self.via_points:
            return model.skill
        return ViaPoints(model.skill, self.via_points, self.via_fade)

    def via_operators(self) -> list[Operator]:
        """Whose coordinates the via-points are."""
        return [ViaPoint.parse(text).operator for text in self.via_points or ()]

    def estimator(self, kinematics: Kinematics | None, operators: Any) -> TaskParameterizedGMM:
        """An unfitted estimator of these hyper-parameters, for one way."""
        return TaskParameterizedGMM(
            self.n_components,
            operators,
            kinematics,
            fusion=self.fusion.value(),
            **vars(self.em),
        )

    def learned(self) -> dict[str, Any]:
        """What a fit has learned beside the mixture, for ``from_parameters``."""
        summary = None
        if self.fit.shown is not None:
            summary = TrainingSummary.from_config(self.fit.shown, self.kinematics())
        peaks = None
        if self.fit.peaks is not None:
            peaks = tuple(torch.tensor(each, dtype=torch.float64) for each in self.fit.peaks)
        return {
            "holds": list(map(Hold.parse, self.holds or ())),
            "n_demonstrations": None if summary is None else summary.n_demonstrations,
            "peaks": peaks,
            "summary": summary,
        }

    def validate_features(self) -> None:
        """Check that there are a state and an action."""
        for key, feature in (
            (OBS_STATE, self.robot_state_feature),
            (ACTION, self.action_feature),
        ):
            if feature is None:
                there = sorted({**(self.input_features or {}), **(self.output_features or {})})
                raise DataError(f"a tpgmm policy needs {key}; there are {there}")

    def get_optimizer_preset(self) -> AdamConfig:
        """Adam, without weight decay."""
        return AdamConfig(lr=self.training.optimizer_lr, weight_decay=0.0)


def _description(operator: Operator) -> dict[str, Any] | str:
    """As text, if that is the whole operator."""
    text = format_operator(operator)
    try:
        return text if parse_operator(text) == operator else encode(operator)
    except DataError:  # it has no text
        return encode(operator)

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

from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_datasets.conversion.poses import LinkPose
from tpgmm_datasets.events import parse_event
from tpgmm_datasets.robots import so101_urdf, upper_body_urdf
from tpgmm_torch import (
    Hold,
    Robot,
    TaskParameterizedGMM,
    Trust,
    ViaPoint,
    parse_clock,
)
from tpgmm_torch.alignment.text import METHODS
from tpgmm_torch.checks.report import PLAUSIBILITY
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.constraints import check_parameters
from tpgmm_torch.exceptions import DataError, TPGMMError
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.text import format_operator, parse_operator
from tpgmm_torch.persistence import decode, encode
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, Fusion, InformationFusion
from tpgmm_torch.robots import Kinematics
from tpgmm_torch.sensing.pose_filter import OneEuro
from tpgmm_torch.skills.via_points import ViaPoints

__all__ = [
    "FITTED",
    "StatePolicyConfig",
    "TPGMMConfig",
    "state_features",
]


#: Parameters of the estimator that go into the configuration under their own names.
HYPERPARAMETERS = (
    "n_components", "covariance_type", "reg_covar", "covariance_shrinkage", "tol", "max_iter",
    "n_init", "init_params", "responsibilities", "random_state", "dtype",
)  # fmt: skip

#: Robots that come with the package: what describes each, and its hands.
ROBOTS: dict[str, tuple[Callable[[], str], Sequence[str]]] = {
    "upper_body": (upper_body_urdf, HANDS),
    "so101": (so101_urdf, ("gripper_frame_link",)),
}

CHOICES = {
    "feedback": ("reference", "observation"),
    "alignment": (*METHODS, "parts"),
    "learn_from": ("measured", "commanded"),
    "loss": ("likelihood", "imitation"),
}


#: Fields that a fit fills in.
FITTED = (
    "n_components", "operators", "n_steps", "holds", "shown", "peaks",
)  # fmt: skip


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
    n_components, covariance_type, reg_covar, covariance_shrinkage, tol, max_iter, n_init, \
    init_params, responsibilities, random_state, dtype
        As for :class:`tpgmm_torch.TaskParameterizedGMM`.
    fusion : {"information", "covariance"}, default="information"
        Form of the product, with the settings ``prior_std``, ``priorities`` and ``negligible``
        of :class:`tpgmm_torch.InformationFusion`, or ``epsilon`` and ``activation`` of
        :class:`tpgmm_torch.CovarianceFusion`.
    blend : float, default=1.0
        How long the difference between start posture and model fades [s].
    keep_limits : bool, default=True
        Whether references stay within the bounds of motion.
    robust : bool, default=True
        Whether training leaves out episodes that are unlike the others.
    plausibility : {"warn", "error", "ignore"}, default="warn"
        What training does about recordings that are unlikely to be what they are taken for.
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
    n_steps : int, default=0
        T, the length of the time grid that was learned; 0 before a fit.
    shown : dict, optional
        The summary of the demonstrations, :class:`tpgmm_torch.checks.TrainingSummary`, as JSON.
    peaks : list of two lists of float, optional
        Accelerations and jerks of the joints in the demonstrations [rad/s^n]: with a margin,
        the bounds of what neither the robot nor the user bounds.
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
    link_frames : dict of str to str, optional
        Frames that training takes from a link at an event, ``{"bottle": "r_hand@close"}``:
        ``LINK@EVENT`` as for :func:`tpgmm_datasets.load_lerobot`. When it runs, the policy has
        to be told them like any frame, but for those at ``start``: they follow from the joints.
    events : dict of str to str, optional
        How training finds events, ``{"close": "closing:*gripper*"}``, as
        :func:`tpgmm_datasets.events.parse_event` takes it. Others are those of the columns
        ``event.*`` of the data set; ``close``, ``open`` and ``stop`` of a link at which a
        frame is are found by themselves, where there is no such column.
    default_environment_state : list of float, optional
        Taken where there is no observation of the frames.
    follow_frames : bool, default=True
        Read the frames at every step, instead of at the start of an episode alone.
    closed_loop : bool, default=True
        Read the joints at every step: the clock looks at them, and a robot stands whose
        joints cannot be believed. Else a skill is played as it was at the start.
    clock : str, default="localizing:initial=anywhere"
        How time goes on, as :func:`tpgmm_torch.parse_clock` takes it: ``"even"``,
        ``"waiting"`` or ``"localizing"``, with options. By default an episode may begin in the
        middle of the skill.
    smoothing : float or None, default=0.5
        Cutoff frequency of the filter on observed poses of objects at rest [Hz]; null for none.
    patience, frame_patience : float, default=0.2, 1.0
        How long a robot goes on with the joints and the frames that it saw last, before it
        stands [s].
    velocity, acceleration, jerk : float, list of float or dict, optional
        Bounds that are tighter than those of the robot and of the demonstrations [rad/s^n].
    fps : float, optional
        Steps per second of the demonstrations.
    control_fps : float, optional
        Actions per second; by default ``fps``.
    feedback : {"reference", "observation"}, default="reference"
        What q_{t-1} is: the last reference (as in the paper), or the measured posture.
    largest_start_gap : float or None, default=1.0
        Refuse to begin if a joint stands further from its first reference [rad]: the order
        or the unit is wrong then, or the robot does not stand where the skill begins.
    chunk_size : int, default=50
        Number of steps of ``predict_action_chunk``.
    alignment : {"dtw", "barycenter", "linear", "events", "events+dtw", "parts", "none"}, \
    default="dtw"
        How training brings episodes onto one clock; ``"events"`` anchors them at all events,
        ``"events+dtw"`` warps them in between, too; ``"parts"`` stretches each of the parts
        that are found.
    alignment_features : list of str, optional
        What time warping compares, as for
        :class:`tpgmm_torch.alignment.DynamicTimeWarping`, by default the speed and the places
        of the links and the joints.
    learn_from : {"measured", "commanded"}, default="measured"
        Whether the joints of a demonstration are its states or its actions. Measured joints
        lag behind commanded ones, by which a skill learned from them misses.
    loss : {"likelihood", "imitation"}, default="likelihood"
        What training by gradient minimises once the mixture is fitted.
    optimizer_lr : float, default=1e-4
        Step size of that training.
    push_to_hub : bool, default=False
        Whether lerobot-train uploads the policy in the end, to ``repo_id``.

    Raises
    ------
    DataError, InvalidParameterError
        If a value is none that exists.
    """

    n_components: int = 10
    priorities: list[int] | None = None
    covariance_type: str = "full"
    reg_covar: float = 1e-5
    covariance_shrinkage: float | str = "auto"
    tol: float = 1e-3
    max_iter: int = 100
    n_init: int = 1
    init_params: str = "time"
    responsibilities: str = "auto"
    fusion: str = "information"
    activation: str = "time"
    epsilon: float = 1e-4
    prior_std: float = 10.0
    negligible: float = 1e-9
    blend: float = 1.0
    keep_limits: bool = True
    robust: bool = True
    plausibility: str = "warn"
    random_state: int | None = None
    dtype: str = "float64"

    # draccus tries the members of a union in order, and can turn anything into a str
    operators: list[dict[str, Any] | str] | None = None
    holds: list[str] | None = None
    via_points: list[str] | None = None
    via_fade: float = 1.0
    robot: dict[str, Any] | str | None = None
    links: list[str] = field(default_factory=list)
    joints: list[str] | str | None = None
    coordinates: list[str] = field(default_factory=list)
    n_steps: int = 0
    shown: dict[str, Any] | None = None
    peaks: list[list[float]] | None = None

    state_names: list[str] | None = None
    action_names: list[str] | None = None
    environment_names: list[str] | None = None
    units: dict[str, list[float] | str] | str | None = None
    frames: dict[str, list[int | str]] | None = None
    link_frames: dict[str, str] = field(default_factory=dict)
    events: dict[str, str] = field(default_factory=dict)
    default_environment_state: list[float] | None = None
    follow_frames: bool = True
    closed_loop: bool = True
    clock: str = "localizing:initial=anywhere"
    smoothing: float | None = 0.5
    patience: float = 0.2
    frame_patience: float = 1.0
    velocity: dict[str, float] | list[float] | float | None = None
    acceleration: dict[str, float] | list[float] | float | None = None
    jerk: dict[str, float] | list[float] | float | None = None

    fps: float | None = None
    control_fps: float | None = None
    feedback: str = "reference"
    largest_start_gap: float | None = 1.0
    chunk_size: int = 50

    alignment: str = "dtw"
    alignment_features: list[str] | None = None
    learn_from: str = "measured"
    loss: str = "likelihood"
    optimizer_lr: float = 1e-4
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
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise DataError(
                    f"{name} is one of {list(choices)}, got {getattr(self, name)!r}"
                )
        for name in ("fps", "control_fps", "largest_start_gap"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise DataError(f"{name} is a positive number or null, got {value}")
        for name, least in (("n_steps", 0), ("chunk_size", 1)):
            if getattr(self, name) < least:
                raise DataError(f"{name} is at least {least}, got {getattr(self, name)}")
        if set(self.normalization_mapping.values()) - {NormalizationMode.IDENTITY}:
            raise DataError(
                "a tpgmm policy works in SI units, normalization_mapping is IDENTITY for all; "
                f"got {self.normalization_mapping}"
            )
        if (self.learn_from, self.loss) == ("commanded", "imitation"):
            raise DataError(
                "the imitation error is that of actions that follow measured joints: "
                "--policy.learn_from=commanded goes with --policy.loss=likelihood"
            )
        self.link_poses()
        for text in self.events.values():
            parse_event(text)
        self.control()
        if self.fusion not in ("information", "covariance"):
            raise DataError(f"fusion is 'information' or 'covariance', got {self.fusion!r}")
        if self.plausibility not in PLAUSIBILITY:
            raise DataError(
                f"plausibility is one of {list(PLAUSIBILITY)}, got {self.plausibility!r}"
            )
        check_parameters(self.estimator(None, ()))

    @property
    def fitted(self) -> bool:
        """Whether what a fit fills in is there."""
        return bool(self.n_steps)

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

    def control(self) -> dict[str, Any]:
        """Options of :meth:`tpgmm_torch.TaskParameterizedGMM.controller`."""
        limits = {name: getattr(self, name) for name in ("velocity", "acceleration", "jerk")}
        return {
            "clock": parse_clock(self.clock),
            "trust": Trust(joint_timeout=self.patience, frame_timeout=self.frame_patience),
            "smoothing": None if self.smoothing is None else OneEuro(cutoff=self.smoothing),
            "feedback": "measured" if self.feedback == "observation" else "reference",
            "bounds": None
            if not self.keep_limits
            else {name: limit for name, limit in limits.items() if limit is not None},
            "blend": self.blend,
        }

    def link_poses(self) -> dict[str, LinkPose]:
        """What ``link_frames`` stands for."""
        return {name: LinkPose.parse(text) for name, text in self.link_frames.items()}

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
        self.n_components, self.n_steps = len(model.weights_), len(model.time_)
        # with the paths that it found
        self.operators = list(map(_description, model.operators_))
        self.holds = list(map(str, model.holds_))
        self.shown = None if skill.summary is None else skill.summary.config()
        self.peaks = None if skill.peaks is None else [each.tolist() for each in skill.peaks]
        for name, value in _fusion(skill.fusion).items():
            setattr(self, name, value)

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
        settings = {name: getattr(self, name) for name in HYPERPARAMETERS}
        fusion: Fusion = InformationFusion(self.prior_std, self.priorities, self.negligible)
        if self.fusion == "covariance":
            fusion = CovarianceFusion(self.epsilon, self.activation)
        return TaskParameterizedGMM(
            operators=operators, robot=kinematics, fusion=fusion, **settings
        )

    def learned(self) -> dict[str, Any]:
        """What a fit has learned beside the mixture, for ``from_parameters``."""
        summary = None
        if self.shown is not None:
            summary = TrainingSummary.from_config(self.shown, self.kinematics())
        peaks = None
        if self.peaks is not None:
            peaks = tuple(torch.tensor(each, dtype=torch.float64) for each in self.peaks)
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
        return AdamConfig(lr=self.optimizer_lr, weight_decay=0.0)


def _fusion(fusion: Fusion) -> dict[str, Any]:
    """Fields of the configuration that stand for a form of fusion."""
    if isinstance(fusion, CovarianceFusion):
        return {
            "fusion": "covariance",
            "epsilon": fusion.epsilon,
            "activation": fusion.activation,
        }
    priorities = None if fusion.priorities is None else list(fusion.priorities)
    return {
        "fusion": "information",
        "prior_std": fusion.prior_std,
        "priorities": priorities,
        "negligible": fusion.negligible,
    }


def _description(operator: Operator) -> dict[str, Any] | str:
    """As text, if that is the whole operator."""
    text = format_operator(operator)
    try:
        return text if parse_operator(text) == operator else encode(operator)
    except DataError:  # it has no text
        return encode(operator)

"""Everything that a policy is but its numbers: what ``config.json`` holds."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from draccus.parsers.decoding import decode as draccus_decode
from draccus.utils import DecodingError
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_policy_tpgmm.settings import ControlConfig, EMConfig, FusionConfig, TrainingConfig
from tpgmm_datasets.conversion.poses import LinkPose
from tpgmm_datasets.events import parse_event
from tpgmm_datasets.robots import parse_robot
from tpgmm_torch import Hold, TaskParameterizedGMM
from tpgmm_torch.constraints import check_parameters
from tpgmm_torch.exceptions import DataError, TPGMMError
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.text import parse_operator
from tpgmm_torch.persistence import decode
from tpgmm_torch.robots import Kinematics
from tpgmm_torch.skills.via_point import ViaPoint
from tpgmm_torch.structure.choices import Choices, parse_parts
from tpgmm_torch.structure.select_ways import SelectWays

__all__ = ["TPGMMConfig"]

#: Said of policies of earlier releases.
OLD = (
    "a policy of release 0.1 or 0.2 is not read any more: fit it again, by lerobot-train or "
    "tpgmm fit --format lerobot"
)

#: In place of a cell: its cameras are not used.
NO_CELL = "none"


@dataclass
class StatePolicyConfig(PreTrainedConfig):  # type: ignore[misc]
    """Base configuration of policies that see the present state alone, in SI units."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(
            ("STATE", "ENV", "ACTION"), NormalizationMode.IDENTITY
        )
    )

    def get_scheduler_preset(self) -> None:
        """Return no schedule."""

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
    """Return ``input_features`` and ``output_features`` of a policy on states of such sizes.

    There is no ``observation.environment_state`` where it has no entries.
    """
    inputs = {OBS_STATE: PolicyFeature(FeatureType.STATE, (n_state,))}
    if n_environment:
        inputs[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (n_environment,))
    outputs = {ACTION: PolicyFeature(FeatureType.ACTION, (n_action,))}
    return {"input_features": inputs, "output_features": outputs}


class Earlier:
    """A value that the configurations of releases 0.1 and 0.2 alone have."""


@draccus_decode.register(Earlier)  # type: ignore[untyped-decorator]
def _refuse(raw_value: Any, path: Sequence[str] = ()) -> Earlier:
    raise DecodingError(path, OLD)


@PreTrainedConfig.register_subclass("tpgmm")
@dataclass
class TPGMMConfig(StatePolicyConfig):
    """Configuration of :class:`TPGMMPolicy`, ``--policy.type=tpgmm``.

    It holds what was asked for; what was learned is the model in the policy's folder. For
    training from a data set, ``robot``, ``links`` and what differs from the defaults are
    enough.

    Parameters
    ----------
    n_steps : Earlier, optional
        Of policies of releases 0.1 and 0.2, which are not read any more.
    n_components : int or "auto", default=10
        Number of Gaussians; "auto" finds it, :class:`tpgmm_torch.SelectComponents`.
    operators : list of str or dict, optional
        As text, ``"pose:l_hand@bottle + pose:r_hand@bottle"``, or as
        :func:`tpgmm_torch.persistence.encode` describes them. The default is the poses of
        all links in all frames, stacked, and the joints; ``["auto"]`` finds those that
        matter, :class:`tpgmm_torch.SelectOperators`.
    parts : str, optional
        Where the skill has parts that are learned one by one: ``"auto"``, or when they end, as
        seconds and events joined by commas, ``"4.2,shake"``.
    modes : int or "auto", default=1
        In how many ways the skill is done, each learned for itself; "auto" finds it,
        :class:`tpgmm_torch.structure.select_ways.SelectWays`.
    holds : list of str, optional
        From when to when a link holds an object, ``["bottle@l_hand:4.3-9.1"]``, in seconds of
        the aligned skill. By default it is found in frames that are read at every step
        (``follow_frames``); an empty list stands for nothing.
    via_points : list of str, optional
        Poses or postures at times of the skill, ``["3.2:position:l_hand@bottle=0,0,0.1"]``, as
        :meth:`tpgmm_torch.skills.via_point.ViaPoint.parse` reads them.
    via_fade : float, default=1.0
        For how long before and after a via-point the skill is another [s].
    obstacles : str, optional
        An MJCF file with what references keep clear of, read when an episode begins;
        ``"scene.xml:visuals"`` takes visual geometry of a robot that has no other.
    robot : dict or str, optional
        The description that :func:`tpgmm_torch.persistence.encode` gives, with the text of
        the URDF in it; to begin with, the path of a URDF or an MJCF, ``"upper_body"``,
        ``"so101"``, ``"bi_so101"``, or several robots as
        :func:`tpgmm_datasets.robots.parse_robot` takes them,
        ``"left=so101@0,0.2,0;right=so101@0,-0.2,0"``. None for joints alone.
    links, joints, coordinates : list of str, optional
        For a robot given so, as for :meth:`tpgmm_torch.Robot.from_urdf`; the links are by
        default those that carry grippers. Joints may be patterns, and one text with commas:
        ``"left_*,waist_yaw"``.
    state_names, action_names, environment_names : list of str, optional
        What the entries of ``observation.state``, ``action`` and
        ``observation.environment_state`` are, in the order in which they come and go. Joints
        are found among them by name. Override them for a robot that has another order than
        the data set: LeRobot gives a policy neither.
    units : str or dict, optional
        Unit of the joints in states and actions: ``"rad"``, ``"deg"``, ``"m"``, ``"mm"``, or
        ``"raw"``, ``"lerobot"`` (arms in degrees, grippers 0 to 100) or ``[factor, offset]``
        that bring a value to radians; for all, or by name or pattern, ``{"*": "deg",
        "*gripper": "raw"}``; to begin with, the path of LeRobot's calibration file,
        ``"arm.json"``. By default what the data set declares, else radians (and metres).
    frames : dict of str to list, optional
        Where the seven values x y z qw qx qy qz of each frame are: positions in
        ``observation.environment_state``, or names of entries of it or of
        ``observation.state``. By default names like ``bottle.x`` tell, else the frames follow
        one another in ``observation.environment_state``.
    default_environment_state : list of float, optional
        Taken where there is no observation of the frames.
    cell : dict or str, optional
        The content of a cell file, to begin with its path, ``cell.json``. Frames are found in
        the pictures of its cameras at each step, whatever ``observation.environment_state``
        says, and joints are measured with its offsets. By default that of the data set, if it
        was tracked; ``"none"`` reads poses from the observation.
    fps : float, optional
        Steps per second of the demonstrations.
    control_fps : float, optional
        Actions per second; by default ``fps``.
    chunk_size : int, default=50
        Number of steps of ``predict_action_chunk``.
    em, fusion, control, training : EMConfig, FusionConfig, ControlConfig, TrainingConfig
        Settings by subject: ``--policy.control.clock=even``.
    push_to_hub : bool, default=False
        Whether lerobot-train uploads the policy in the end, to ``repo_id``.

    Raises
    ------
    DataError, InvalidParameterError
        If a value does not exist.
    """

    n_steps: Earlier | None = None
    n_components: int | str = 10
    # draccus tries the members of a union in order, and can turn anything into a str
    operators: list[dict[str, Any] | str] | None = None
    parts: str | None = None
    modes: int | str = 1
    holds: list[str] | None = None
    via_points: list[str] | None = None
    via_fade: float = 1.0
    obstacles: str | None = None
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
    cell: dict[str, Any] | str | None = None
    fps: float | None = None
    control_fps: float | None = None
    chunk_size: int = 50

    em: EMConfig = field(default_factory=EMConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
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
        self._check_numbers()
        self._check_features()
        self.training.check()
        self.link_poses()
        for text in self.training.events.values():
            parse_event(text)
        self.control.options()
        self.given_holds()
        self.choices().check(None)
        model = self.estimator(None, ())
        check_parameters(model)
        check_parameters(SelectWays(model, self.modes))

    def _check_numbers(self) -> None:
        """Refuse rates and sizes that are out of range."""
        rates = {"fps": self.fps, "control_fps": self.control_fps}
        rates["control.largest_start_gap"] = self.control.largest_start_gap
        for name, value in rates.items():
            if value is not None and not 0 < value < math.inf:
                raise DataError(f"{name} is a positive number or null, got {value}")
        if self.chunk_size < 1:
            raise DataError(f"chunk_size is at least 1, got {self.chunk_size}")

    def _check_features(self) -> None:
        """Refuse names, shapes and normalisations that no feature has."""
        for names in (self.links, self.state_names, self.action_names, self.environment_names):
            if not all(isinstance(name, str) for name in names or ()):
                raise DataError(f"names are texts, got {names}")
        for name, feature in self._list_features().items():
            if not all(type(size) is int and 0 < size <= 10**6 for size in feature.shape):
                raise DataError(
                    f"the shape of {name} is of sizes from 1 to a million, got {feature.shape}"
                )
        if set(self.normalization_mapping.values()) - {NormalizationMode.IDENTITY}:
            raise DataError(
                "a tpgmm policy works in SI units, normalization_mapping is IDENTITY for all; "
                f"got {self.normalization_mapping}"
            )

    def _list_features(self) -> dict[str, PolicyFeature]:
        """Return the features of observations and actions."""
        return {**(self.input_features or {}), **(self.output_features or {})}

    def choices(self) -> Choices:
        """Return what of the structure is found in the demonstrations."""
        parts, found = parse_parts(self.parts), self.operators == ["auto"]
        return Choices(found, self.n_components == "auto", parts, self.modes)

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
        """Return the link poses that ``link_frames`` stands for."""
        return {name: LinkPose.parse(text) for name, text in self.training.link_frames.items()}

    def kinematics(self) -> Kinematics | None:
        """Return the robot that ``robot`` describes, None for joints alone."""
        if self.robot is None or isinstance(self.robot, dict):
            return None if self.robot is None else decode(self.robot)
        joints = self.joints
        if isinstance(joints, str):
            joints = [name.strip() for name in joints.split(",")]
        settings = {"joints": joints, "coordinates": self.coordinates}
        return parse_robot(self.robot, self.links, **settings)

    def decoded_operators(self) -> list[Operator] | None:
        """Return the operators that ``operators`` describes; None if they are not given.

        Raises
        ------
        DataError
            If a text describes none.
        """
        if self.operators is None or self.operators == ["auto"]:
            return None
        if "auto" in self.operators:
            raise DataError(
                f"operators are named or found, got {self.operators}: give ['auto'] alone, or "
                "leave it out"
            )
        return [
            parse_operator(item) if isinstance(item, str) else decode(item)
            for item in self.operators
        ]

    def via_operators(self) -> list[Operator]:
        """Return the operators whose coordinates the via-points are."""
        return [ViaPoint.parse(text).operator for text in self.via_points or ()]

    def estimator(self, kinematics: Kinematics | None, operators: Any) -> TaskParameterizedGMM:
        """Make an unfitted estimator of these hyper-parameters."""
        count: Any = 10 if self.n_components == "auto" else self.n_components
        fusion, settings = self.fusion.value(), vars(self.em)
        return TaskParameterizedGMM(count, operators, kinematics, fusion=fusion, **settings)

    def given_holds(self) -> tuple[Hold, ...] | None:
        """Return the holds that ``holds`` describes; None if they are to be found."""
        return None if self.holds is None else tuple(map(Hold.parse, self.holds))

    def validate_features(self) -> None:
        """Check that there are a state and an action."""
        needed = {OBS_STATE: self.robot_state_feature, ACTION: self.action_feature}
        for key, feature in needed.items():
            if feature is None:
                there = sorted(self._list_features())
                raise DataError(f"a tpgmm policy needs {key}; there are {there}")

    def get_optimizer_preset(self) -> AdamConfig:
        """Return an optimizer, as ``lerobot-train`` asks for; it has nothing to change."""
        return AdamConfig(weight_decay=0.0)

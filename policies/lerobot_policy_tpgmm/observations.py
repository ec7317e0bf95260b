"""Between the entries of LeRobot's features and the model's joints and frames.

A data set, a robot and a URDF each have their own order, names and units. Here joints are
found by name, and values converted both ways; the model works in radians and metres.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from itertools import chain
from types import MappingProxyType
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from tpgmm_datasets.conversion.poses import LinkPose
from tpgmm_datasets.names import match_names
from tpgmm_datasets.units import Scale, Units, as_scale, units_of
from tpgmm_torch import Frame
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.data.pose_names import pose_groups
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.robots import Kinematics

REMEDY = (
    "Does the robot have joints that the data have not? --policy.joints='left_*,right_*' names "
    "those that move. Is this policy for another robot or data set? If the names alone differ, "
    "give those that the policy shall see, in order: "
    "--policy.state_names='[...]' --policy.action_names='[...]'"
)
POSE = 7
#: Key of the rate in an observation [1/s].
CONTROL_RATE = "observation.control_fps"


class JointFeatures(nn.Module):
    """Joints in ``observation.state`` and ``action``.

    Parameters
    ----------
    joint_names : sequence of str
        Of the model, in its order.
    state_names : sequence of str
        Of the entries of the state, which may have others too.
    action_names : sequence of str
        Of the entries of the action, each of which must be a joint.
    units : str, mapping or None
        As in :class:`TPGMMConfig`; by the name of an entry or of a joint.
    robot : Kinematics, optional
        Whose limits grippers in LeRobot's units have.
    offsets : mapping of str to float, optional
        What is added to values in radians to be joints of the robot's description [rad].

    Attributes
    ----------
    raw : set of str
        Joints in a unit of their own.

    Raises
    ------
    DataError
        If a joint is missing, ambiguous or too many, or a unit is unknown.
    """

    columns: Tensor
    order: Tensor
    scale: Tensor
    back: Tensor

    def __init__(
        self,
        joint_names: Sequence[str],
        state_names: Sequence[str],
        action_names: Sequence[str],
        units: Mapping[str, Sequence[float] | str] | str | None,
        robot: Kinematics | None = None,
        offsets: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        super().__init__()
        self.joint_names = tuple(joint_names)
        self.state_names, self.action_names = tuple(state_names), tuple(action_names)
        in_state = match_names(joint_names, state_names, OBS_STATE, REMEDY)
        in_action = match_names(joint_names, action_names, ACTION, REMEDY)
        if extra := list_missing(action_names, in_action):
            raise DataError(
                f"the action has the entries {extra}, which are no joints of the model; it has "
                f"{list(joint_names)}. Learn them too (--policy.joints; what moves no link of "
                "the URDF, like a gripper, is in --policy.coordinates), or make a set without "
                "them: tpgmm dataset convert SET NEW --robot ROBOT --robot-joint PATTERN"
            )
        entry = {joint: name for name, joint in in_state.items()}
        called = [*(in_state.get(name, name) for name in state_names)]
        called += map(in_action.__getitem__, action_names)
        every = *state_names, *action_names
        chosen = units_of(_parse_units(units), every, called, robot, OBS_STATE)
        units_by_name = list(zip(every, called, chosen, strict=True))
        self.raw = {joint for _, joint, unit in units_by_name if unit == "raw"}
        rows = [
            _add_offset(as_scale(unit, name), offsets.get(joint, offsets.get(name, 0)))
            for name, joint, unit in units_by_name
        ]
        scales = torch.tensor(rows, dtype=torch.float64)
        columns = torch.tensor([every.index(entry[joint]) for joint in joint_names])
        order = torch.tensor([self.joint_names.index(in_action[n]) for n in action_names])
        # they follow from the configuration: not in the file
        self.register_buffer("columns", columns, persistent=False)
        self.register_buffer("order", order, persistent=False)
        self.register_buffer("scale", scales[columns], persistent=False)
        self.register_buffer("back", scales[len(state_names) :], persistent=False)

    def joints(self, state: Tensor) -> Tensor:
        """Return joint vectors (B, n_joints) in the model's order and units.

        Parameters
        ----------
        state : Tensor of shape (B, n_state)
        """
        if state.ndim != 2 or state.shape[-1] != len(self.state_names):
            raise ShapeError(
                f"{OBS_STATE} has shape (batch, {len(self.state_names)}) for "
                f"{list(self.state_names)}, got {tuple(state.shape)}. {REMEDY}"
            )
        return state[:, self.columns] * self.scale[:, 0] + self.scale[:, 1]

    def action(self, joints: Tensor) -> Tensor:
        """Return actions (..., n_action), float32, from joint vectors (..., n_joints)."""
        ordered = joints[..., self.order]
        return ((ordered - self.back[:, 1]) / self.back[:, 0]).to(torch.float32)

    def decode_action(self, action: Tensor) -> Tensor:
        """Return joint vectors (..., n_joints) in the model's order and units, from actions."""
        return (action * self.back[:, 0] + self.back[:, 1])[..., self.order.argsort()]


class FrameFeatures:
    """Where the poses of frames are observed.

    The first that is there counts: ``observation.environment_state``, entries of
    ``observation.state``, the default.

    Parameters
    ----------
    frame_names : sequence of str
        The frames that the model needs.
    places : mapping of str to sequence of int or str, optional
        As ``frames`` in :class:`TPGMMConfig`.
    default : sequence of float, optional
        A whole ``observation.environment_state``.
    n_environment : int, optional
        Its size, if that is known otherwise than from the names.
    """

    def __init__(
        self,
        frame_names: Sequence[str],
        places: Mapping[str, Sequence[int | str]] | None,
        environment_names: Sequence[str] | None,
        state_names: Sequence[str],
        default: Sequence[float] | None,
        n_environment: int | None = None,
    ) -> None:
        places, environment_names = places or {}, environment_names or ()
        if unknown := list_missing(places, frame_names):
            raise UnknownNameError("frame", unknown[0], "the model", frame_names)
        named, stated = find_poses(environment_names), find_poses(state_names)
        if not environment_names:  # then they follow one another
            starts = range(0, POSE * len(frame_names), POSE)
            named = {n: [*range(i, i + POSE)] for n, i in zip(frame_names, starts, strict=True)}
        for name, place in places.items():
            named.pop(name, None)
            columns, in_state = _find_columns(name, place, environment_names, state_names)
            (stated if in_state else named)[name] = columns
        self.frame_names = tuple(frame_names)
        self.in_environment = self._keep(named)
        self.in_state = self._keep(stated)
        self.n_environment = self._count_entries(len(environment_names) or n_environment)
        self.default = None if default is None else self._make_default(default)

    def _keep(self, found: Mapping[str, list[int]]) -> dict[str, list[int]]:
        """Keep the columns of the frames that the model needs."""
        return {name: found[name] for name in self.frame_names if name in found}

    def _count_entries(self, given: int | None) -> int:
        """Return the size of the environment's state, if not given that of its frames."""
        least = 1 + max(chain(*self.in_environment.values()), default=-1)
        if given and given < least:
            raise ShapeError(
                f"{OBS_ENV_STATE} has {given} entries, the frames {list(self.frame_names)} are "
                f"at {self.in_environment}"
            )
        return given or least

    def _make_default(self, default: Sequence[float]) -> Tensor:
        """Return a whole state of the environment, of the right size."""
        if len(default) != self.n_environment:
            raise ShapeError(
                f"default_environment_state has {len(default)} values, "
                f"{OBS_ENV_STATE} has {self.n_environment}"
            )
        return torch.tensor(default, dtype=torch.float64)

    def frames(self, batch: Mapping[str, Any]) -> dict[str, Frame]:
        """Return the poses (B,) of all frames.

        Parameters
        ----------
        batch : mapping of str to Tensor
            Observations.

        Raises
        ------
        DataError, ShapeError
            If the pose of a frame is missing, or not a pose.
        """
        environment = batch.get(OBS_ENV_STATE)
        state = batch[OBS_STATE]
        if environment is not None and environment.shape != (len(state), self.n_environment):
            raise ShapeError(
                f"{OBS_ENV_STATE} has shape ({len(state)}, {self.n_environment}), got "
                f"{tuple(environment.shape)}: is this policy for another environment?"
            )
        poses = {name: self._pose(name, state, environment) for name in self.frame_names}
        frames = {}
        for name, pose in poses.items():
            try:
                frames[name] = Frame(pose[:, :3], pose[:, 3:])
            except DataError as error:
                raise DataError(f"frame {name!r}: {error}") from error
        return frames

    def with_poses(self, batch: Mapping[str, Any], found: Mapping[str, Any]) -> dict[str, Any]:
        """Return an observation in which frames are at poses (B, 7) that were ``found``."""
        nothing = torch.full((self.n_environment,), math.nan, dtype=torch.float64)
        known = nothing if self.default is None else self.default
        environment = known.repeat(len(batch[OBS_STATE]), 1)
        for name, poses in found.items():
            environment[:, self.in_environment[name]] = torch.from_numpy(poses)
        return {**batch, OBS_ENV_STATE: environment.to(batch[OBS_STATE].device)}

    def poses(self, batch: Mapping[str, Any]) -> dict[str, Tensor | None]:
        """Return poses (B, 7) of any values, within an episode; None for a lost one."""
        state, environment = batch[OBS_STATE], batch.get(OBS_ENV_STATE)
        poses: dict[str, Tensor | None] = {}
        for name in self.frame_names:
            try:
                poses[name] = self._pose(name, state, environment)
            except (DataError, IndexError):
                poses[name] = None
        return poses

    def _pose(self, name: str, state: Tensor, environment: Tensor | None) -> Tensor:
        if environment is not None and name in self.in_environment:
            values = environment[:, self.in_environment[name]]
        elif name in self.in_state:
            values = state[:, self.in_state[name]]
        elif self.default is not None and name in self.in_environment:
            values = self.default[self.in_environment[name]].to(state).expand(len(state), POSE)
        else:
            observed = "is not there" if environment is None else "has entries of other names"
            raise DataError(
                f"the pose of {name!r} is missing: {OBS_ENV_STATE} {observed}, and {OBS_STATE} "
                f"has no {name}.x ... {name}.qz. Let the robot observe it, or give "
                "--policy.default_environment_state='[x,y,z,qw,qx,qy,qz]'"
            )
        return values.to(torch.float64)


def is_at_start(pose: LinkPose) -> bool:
    """Return True for where a link is when the skill begins: it follows from the joints."""
    return pose.event == "start" and pose.offset is None


def list_placed(config: TPGMMConfig) -> set[str]:
    """Return the frames of which the configuration says where they are observed."""
    named = find_poses(config.environment_names), find_poses(config.state_names)
    return {*(config.frames or ())}.union(*named)


def select_observed(
    config: TPGMMConfig, required: Sequence[str], summary: TrainingSummary | None = None
) -> list[str]:
    """Select those of the ``required`` frames that a running policy observes.

    Where a link is at the start follows from the joints, unless the names of the entries of
    ``config`` tell of the frame. The ``summary`` is that of the demonstrations.
    """
    start = {name for name, pose in config.link_poses().items() if is_at_start(pose)}
    if summary is not None:
        start |= {name for name, shown in summary.frames.items() if shown.link is not None}
    placed = list_placed(config)
    return [name for name in required if name not in start or name in placed]


def list_missing(names: Iterable[str], known: Container[str]) -> list[str]:
    """Return the names that are not known."""
    return [name for name in names if name not in known]


def _add_offset(scale: Scale, offset: float) -> tuple[float, float]:
    """Return factor and offset of a unit, shifted."""
    return scale.factor, scale.offset + offset


def _parse_units(units: Any) -> Units:
    """Parse units as they are in a configuration, ``[factor, offset]`` among them."""
    if not isinstance(units, Mapping):
        return units or "auto"
    for name, unit in units.items():
        numbers = isinstance(unit, str) or (
            len(unit) == 2 and unit[0] and all(map(math.isfinite, unit))
        )
        if not numbers:
            raise DataError(f"the unit of {name!r} is a name or [factor, offset], got {unit!r}")
    return {n: unit if isinstance(unit, str) else Scale(*unit) for n, unit in units.items()}


def find_poses(names: Sequence[str] | None) -> dict[str, list[int]]:
    """Return the positions of poses that names tell of; LeRobot puts ``.pos`` behind."""
    plain = [name.removesuffix(".pos") for name in names or ()]
    return {name: list(group) for name, group in pose_groups(plain).items()}


def _find_columns(
    name: str,
    place: Sequence[int | str],
    environment_names: Sequence[str],
    state_names: Sequence[str],
) -> tuple[list[int], bool]:
    """Return the columns of a pose, and whether they are of the robot's state."""
    if len(place) != POSE:
        raise DataError(f"frame {name!r} is at seven entries, x y z qw qx qy qz; got {place}")
    if all(isinstance(entry, int) and entry >= 0 for entry in place):
        return [int(entry) for entry in place], False
    for in_state, names in ((False, environment_names), (True, state_names)):
        if set(place) <= set(names):
            return [list(names).index(str(entry)) for entry in place], in_state
    raise DataError(
        f"frame {name!r} is at {list(place)}, which are not all entries of {OBS_ENV_STATE}, "
        f"{list(environment_names)}, nor of {OBS_STATE}, {list(state_names)}"
    )


def check_rate(batch: Mapping[str, Any], rate: float) -> None:
    """Refuse observations that say that they come at another rate than the policy's.

    LeRobot itself does not compare: a policy made for 100 Hz would run at half its speed in an
    environment of 50 Hz. Those of ``lerobot_env_bimanual`` add their rate to each observation.

    Parameters
    ----------
    batch : mapping of str to Tensor
        Observations.
    rate : float
        Of the policy [1/s].
    """
    if CONTROL_RATE not in batch:
        return
    own = float(batch[CONTROL_RATE].flatten()[0])
    if abs(own - rate) > 1e-3 * rate:
        raise DataError(
            f"the environment takes {own:g} actions per second, the policy gives {rate:g}: "
            f"--policy.control_fps={own:g} makes its time pass accordingly, "
            f"--env.fps={rate:g} changes the environment"
        )

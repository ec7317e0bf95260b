"""Between the entries of LeRobot's features and the model's joints and frames.

A data set, a robot and a URDF each have their own order, names and units. Here joints are
found by name, and values converted both ways; the model works in radians and metres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from tpgmm_datasets.names import match_names, pose_groups
from tpgmm_datasets.units import Scale, Units, as_scale, units_of
from tpgmm_torch import Frame
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.robots import Kinematics

__all__ = [
    "CONTROL_RATE", "FrameFeatures", "JointFeatures", "check_rate", "observed_frames",
    "poses_named",
]  # fmt: skip

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
        extra = [name for name in action_names if name not in in_action]
        if extra:
            raise DataError(
                f"the action has the entries {extra}, which are no joints of the model; it has "
                f"{list(joint_names)}. Learn them too (--policy.joints; what moves no link of "
                "the URDF, like a gripper, is in --policy.coordinates), or make a set without "
                "them: tpgmm dataset convert SET NEW --robot ROBOT --robot-joint PATTERN"
            )
        entry = {joint: name for name, joint in in_state.items()}
        called = [in_state.get(name, name) for name in state_names]
        called += [in_action[name] for name in action_names]
        every = *state_names, *action_names
        chosen = units_of(_scales(units), every, called, robot, OBS_STATE)
        self.raw = {name for name, unit in zip(called, chosen, strict=True) if unit == "raw"}
        scales = [as_scale(unit, name) for name, unit in zip(every, chosen, strict=True)]
        added = [offsets.get(n, offsets.get(m, 0)) for n, m in zip(called, every, strict=True)]
        scales = [Scale(s.factor, s.offset + x) for s, x in zip(scales, added, strict=True)]
        state = [scales[every.index(entry[joint])] for joint in joint_names]
        action = scales[len(state_names) :]
        buffers = {
            "columns": torch.tensor([self.state_names.index(entry[j]) for j in joint_names]),
            "order": torch.tensor([self.joint_names.index(in_action[n]) for n in action_names]),
            "scale": torch.tensor([(s.factor, s.offset) for s in state], dtype=torch.float64),
            "back": torch.tensor([(s.factor, s.offset) for s in action], dtype=torch.float64),
        }
        for name, buffer in buffers.items():
            # they follow from the configuration: not in the file
            self.register_buffer(name, buffer, persistent=False)

    def joints(self, state: Tensor) -> Tensor:
        """Joint vectors (B, n_joints) in the model's order and units.

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
        """Actions (..., n_action), float32, from joint vectors (..., n_joints)."""
        ordered = joints[..., self.order]
        return ((ordered - self.back[:, 1]) / self.back[:, 0]).to(torch.float32)

    def commanded(self, action: Tensor) -> Tensor:
        """Joint vectors (..., n_joints) in the model's order and units, from actions."""
        return self.targets(action)[..., self.order.argsort()]

    def targets(self, action: Tensor) -> Tensor:
        """Targets of the joints ``order`` of actions (..., n_action), in the model's units."""
        return action * self.back[:, 0] + self.back[:, 1]


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
        for name in places or {}:
            if name not in frame_names:
                raise UnknownNameError("frame", name, "the model", frame_names)
        named, stated = poses_named(environment_names), poses_named(state_names)
        self.in_environment: dict[str, list[int]] = {}
        self.in_state: dict[str, list[int]] = {}
        for index, name in enumerate(frame_names):
            environment, state = named.get(name), stated.get(name)
            if places and name in places:
                environment, placed = _placed(
                    name, places[name], environment_names, state_names
                )
                state = placed or state
            elif environment is None and not environment_names:
                environment = [*range(POSE * index, POSE * (index + 1))]
            if environment is not None:
                self.in_environment[name] = environment
            if state is not None:
                self.in_state[name] = state
        self.frame_names = tuple(frame_names)
        least = 1 + max((max(p) for p in self.in_environment.values()), default=-1)
        self.n_environment = len(environment_names or ()) or n_environment or least
        if self.n_environment < least:
            raise ShapeError(
                f"{OBS_ENV_STATE} has {self.n_environment} entries, the frames "
                f"{list(frame_names)} are at {self.in_environment}"
            )
        self.default = None
        if default is not None:
            self.default = torch.tensor(list(default), dtype=torch.float64)
            if len(self.default) != self.n_environment:
                raise ShapeError(
                    f"default_environment_state has {len(self.default)} values, "
                    f"{OBS_ENV_STATE} has {self.n_environment}"
                )

    def frames(self, batch: Mapping[str, Any]) -> dict[str, Frame]:
        """Poses (B,) of all frames.

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
        """An observation in which frames are at poses (B, 7) that were ``found``."""
        nothing = torch.full((self.n_environment,), math.nan, dtype=torch.float64)
        known = nothing if self.default is None else self.default
        environment = known.repeat(len(batch[OBS_STATE]), 1)
        for name, poses in found.items():
            environment[:, self.in_environment[name]] = torch.from_numpy(poses)
        return {**batch, OBS_ENV_STATE: environment.to(batch[OBS_STATE].device)}

    def poses(self, batch: Mapping[str, Any]) -> dict[str, Tensor | None]:
        """The same in the middle of an episode: (B, 7), of any values; None for a lost one."""
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


def observed_frames(
    config: TPGMMConfig, required: Sequence[str], summary: TrainingSummary | None = None
) -> list[str]:
    """Those of the ``required`` frames that a running policy observes.

    Where a link is at the start follows from the joints, unless the names of the entries of
    ``config`` tell of the frame. The ``summary`` is that of the demonstrations.
    """
    poses = config.link_poses().items()
    start = {name for name, pose in poses if pose.event == "start" and pose.offset is None}
    if summary is not None:
        start |= {name for name, shown in summary.frames.items() if shown.link is not None}
    placed = {*(config.frames or ()), *poses_named(config.environment_names)}
    placed |= {*poses_named(config.state_names)}
    return [name for name in required if name not in start or name in placed]


def _scales(units: Any) -> Units:
    """Units as they are in a configuration, ``[factor, offset]`` among them."""
    if not isinstance(units, Mapping):
        return units or "auto"
    for name, unit in units.items():
        numbers = isinstance(unit, str) or (
            len(unit) == 2 and unit[0] and all(map(math.isfinite, unit))
        )
        if not numbers:
            raise DataError(f"the unit of {name!r} is a name or [factor, offset], got {unit!r}")
    return {n: unit if isinstance(unit, str) else Scale(*unit) for n, unit in units.items()}


def poses_named(names: Sequence[str] | None) -> dict[str, list[int]]:
    """Where poses are that names tell of; LeRobot puts ``.pos`` behind the names of robots."""
    plain = [name.removesuffix(".pos") for name in names or ()]
    return {name: list(group) for name, group in pose_groups(plain).items()}


def _placed(
    name: str,
    place: Sequence[int | str],
    environment_names: Sequence[str] | None,
    state_names: Sequence[str],
) -> tuple[list[int] | None, list[int] | None]:
    """Columns of the environment's or of the robot's state."""
    if len(place) != POSE:
        raise DataError(f"frame {name!r} is at seven entries, x y z qw qx qy qz; got {place}")
    if all(isinstance(entry, int) and entry >= 0 for entry in place):
        return [int(entry) for entry in place], None
    for where, names in enumerate((environment_names or (), state_names)):
        if all(entry in names for entry in place):
            columns = [list(names).index(str(entry)) for entry in place]
            return (None, columns) if where else (columns, None)
    raise DataError(
        f"frame {name!r} is at {list(place)}, which are not all entries of {OBS_ENV_STATE}, "
        f"{list(environment_names or ())}, nor of {OBS_STATE}, {list(state_names)}"
    )


def check_rate(batch: Mapping[str, Any], rate: float) -> None:
    """Whether observations come at the rate of the policy, if they say.

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

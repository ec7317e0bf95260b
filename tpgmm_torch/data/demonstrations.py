"""Demonstrations and new situations, the input of a model.

Times are in seconds, joints in radians (or metres, where they slide). Everything given is
copied once into tensors, see :mod:`tpgmm_torch.data.arrays`; nothing is modified in place.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.data.holds import Hold, check_holds
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError

__all__ = ["Demonstration", "Situation"]

#: The fewest demonstrations that have a variance; to leave one out takes one more.
FEWEST = 2
#: Over so long speeds are measured [s]: less is noise, more blurs where motions begin.
SMOOTHING = 0.2


def _check_time(values: Any) -> Tensor:
    time = as_tensor(values, "time")
    if time.ndim != 1 or len(time) == 0:
        raise ShapeError(f"time has shape (T,) with T >= 1, got {tuple(time.shape)}")
    steps = time.diff()
    if bool((steps <= 0).any()):
        at = int(torch.nonzero(steps <= 0)[0])
        raise DataError(
            f"time must increase strictly: it goes from {time[at]:.6g} to {time[at + 1]:.6g} s "
            f"at index {at + 1}"
        )
    return time


def _check_frames(frames: Frames | None, length: int | None) -> dict[str, Frame]:
    """Check types and lengths; without ``length``, frames per time step share one."""
    frames = dict(frames or {})
    for name, frame in frames.items():
        if not isinstance(name, str) or not isinstance(frame, Frame):
            raise DataError(
                f"frames maps names to Frame objects, got {name!r}: {type(frame).__name__}"
            )
        if length is None and frame.batch_shape:
            length = frame.batch_shape[0]
        if frame.batch_shape not in ((), (length,)):
            raise ShapeError(
                f"frame {name!r} has leading shape {tuple(frame.batch_shape)}; "
                f"it is one pose, (), or one per time step, ({length},)"
            )
    return frames


def _check_wrenches(wrenches: Mapping[str, Any], length: int) -> dict[str, Tensor]:
    """Check wrenches by link, each (T, 6)."""
    checked = {}
    for link, values in dict(wrenches).items():
        wrench = as_tensor(values, f"the wrench of {link!r}")
        if wrench.shape != (length, 6):
            raise ShapeError(
                f"the wrench of {link!r} has shape ({length}, 6), forces [N] before moments "
                f"[N m] at each time step, got {tuple(wrench.shape)}"
            )
        checked[str(link)] = wrench
    return checked


def _check_names(names: Sequence[str] | None, count: int) -> tuple[str, ...] | None:
    names = None if names is None else tuple(names)
    if names is not None and not len(set(names)) == len(names) == count:
        raise ShapeError(f"joint_names needs {count} different names, got {names}")
    return names


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One demonstration of a skill: T_m datapoints and the frames they were made in.

    Parameters
    ----------
    time : array-like of shape (T,)
        Seconds, strictly increasing.
    joints : array-like of shape (T, n_joints)
        Joint positions q_t [rad or m], in the order of the robot. Coordinates without
        kinematics (a gripper) are joints too.
    frames : mapping of str to Frame, optional
        Object poses by name, constant or one per time step.
    joint_names : sequence of str, optional
        Names of the columns of ``joints``; with them a robot may have another order.
    events : mapping of str to float, optional
        Instants that matter, by name [s], for example ``{"grasp": 4.2}``. ``"start"`` and
        ``"end"`` need not be given: they are the first and the last instant.
    holds : sequence of Hold, optional
        From when to when the robot holds which object, see
        :func:`~tpgmm_torch.attach_holds`; empty if it holds none, None if that is not known.
    wrenches : mapping of str to array-like of shape (T, 6), optional
        By link, the forces [N] and then the moments [N m] that the robot exerts on its
        surroundings there: at the link's origin, in the axes of the base frame, without the
        weight of the tool.
    commands : array-like of shape (T, n_joints), optional
        Where the joints were commanded to be at each time step [rad or m], if ``joints`` are
        measured: what servos need beyond the postures is learned from the gap between them.

    Raises
    ------
    ShapeError, DataError
        If shapes do not match, a value is not finite, or time does not increase.

    Examples
    --------
    >>> demonstration = Demonstration(
    ...     time=[0.0, 0.1, 0.2],
    ...     joints=[[0.0, 1.0], [0.1, 0.9], [0.2, 0.7]],
    ...     frames={"cup": Frame([0.4, 0.0, 0.1])},
    ...     joint_names=["shoulder", "elbow"],
    ... )
    >>> demonstration
    Demonstration(3 steps, 0.20 s, 2 joints, frames=['cup'], events={})
    >>> demonstration.reorder(["elbow"]).joints[:, 0].tolist()
    [1.0, 0.9, 0.7]
    """

    time: Tensor
    joints: Tensor
    frames: Frames = field(default_factory=dict)
    joint_names: tuple[str, ...] | None = None
    events: Mapping[str, float] = field(default_factory=dict)
    holds: tuple[Hold, ...] | None = None
    wrenches: Mapping[str, Tensor] = field(default_factory=dict)
    commands: Tensor | None = None

    def __post_init__(self) -> None:
        time = _check_time(self.time)
        joints = as_tensor(self.joints, "joints")
        if joints.ndim != 2 or len(joints) != len(time):
            raise ShapeError(
                f"joints has shape (T, n_joints) with T = {len(time)} as in time, "
                f"got {tuple(joints.shape)}"
            )
        names = _check_names(self.joint_names, joints.shape[1])
        events = {str(name): float(at) for name, at in dict(self.events).items()}
        for name, at in events.items():
            if not time[0] <= at <= time[-1]:
                raise DataError(
                    f"event {name!r} at {at} s lies outside the demonstration, "
                    f"{time[0]:.6g} to {time[-1]:.6g} s"
                )
        frames = _check_frames(self.frames, len(time))
        holds = None if self.holds is None else check_holds(self.holds, frames)
        vars(self).update(time=time, joints=joints, frames=frames, joint_names=names)
        wrenches = _check_wrenches(self.wrenches, len(time))
        commands = self.commands
        if commands is not None:
            commands = as_tensor(commands, "commands")
            if commands.shape != joints.shape:
                raise ShapeError(
                    f"commands has the shape of joints, {tuple(joints.shape)}, got "
                    f"{tuple(commands.shape)}"
                )
        vars(self).update(events=events, holds=holds, wrenches=wrenches, commands=commands)

    def __len__(self) -> int:
        """Number of time steps T."""
        return len(self.time)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.joints.shape[1]

    @property
    def duration(self) -> float:
        """Seconds from the first to the last time step."""
        return float(self.time[-1] - self.time[0])

    def frame(self, name: str) -> Frame:
        """Return the frame of that name.

        Raises
        ------
        UnknownNameError
            If there is none; the message lists those that exist.
        """
        if name not in self.frames:
            raise UnknownNameError("frame", name, "the demonstration", self.frames)
        return self.frames[name]

    def event(self, name: str) -> float:
        """Return when an event is [s]; every demonstration has a start and an end.

        Raises
        ------
        UnknownNameError
            If there is no such event.
        """
        ends = {"start": float(self.time[0]), "end": float(self.time[-1])}
        known = {**ends, **self.events}
        if name not in known:
            raise UnknownNameError("event", name, "the demonstration", known)
        return known[name]

    def at_steps(self, chosen: slice | Tensor) -> Demonstration:
        """Cut the demonstration to some time steps, with the events between them.

        Parameters
        ----------
        chosen : slice or Tensor
            Ascending numbers of time steps, or a mask (T,).
        """
        time = self.time[chosen]
        begin, end = float(time[0]), float(time[-1])
        return replace(
            self,
            time=time,
            joints=self.joints[chosen],
            frames={n: f[chosen] if f.batch_shape else f for n, f in self.frames.items()},
            events={name: at for name, at in self.events.items() if begin <= at <= end},
            wrenches={link: wrench[chosen] for link, wrench in self.wrenches.items()},
            commands=None if self.commands is None else self.commands[chosen],
        )

    def reorder(self, joint_names: Sequence[str]) -> Demonstration:
        """Bring the joints into the order of ``joint_names``.

        Other columns are left out. Without names, the order is trusted.

        Raises
        ------
        UnknownNameError
            If one of the names is not among the demonstration's.
        """
        return _reorder(self, joint_names, "the demonstration")

    def __repr__(self) -> str:
        return (
            f"Demonstration({len(self)} steps, {self.duration:.2f} s, {self.n_joints} joints, "
            f"frames={sorted(self.frames)}, events={dict(self.events)})"
        )


@dataclass(frozen=True, eq=False)
class Situation:
    """A new situation: where the robot starts and where the objects are.

    Parameters
    ----------
    joints : array-like of shape (n_joints,), or mapping of str to float
        The start posture q_0 [rad or m], in the order of the model, or by name. Names that
        the model does not have are left out.
    frames : mapping of str to Frame, optional
        Object poses by name, constant or one per time step.
    time : array-like of shape (T,), optional
        When references are wanted [s]; by default the time grid that the model learned.
        Before the skill begins and after its end references are held.
    joint_names : sequence of str, optional
        Names of the values of ``joints``, in place of a mapping.
    frames_time : array-like of shape (T_f,), optional
        When the poses of frames that move were recorded [s]; by default at ``time``. In
        between they are interpolated, before and after they stand still.

    Raises
    ------
    ShapeError, DataError
        If shapes do not match, a value is not finite, or time does not increase.

    Examples
    --------
    >>> situation = Situation({"elbow": 1.0, "shoulder": 0.0}, {"cup": Frame([0.4, 0.0, 0.1])})
    >>> situation.reorder(["shoulder", "elbow"]).joints.tolist()
    [0.0, 1.0]
    """

    joints: Tensor
    frames: Frames = field(default_factory=dict)
    time: Tensor | None = None
    joint_names: tuple[str, ...] | None = None
    frames_time: Tensor | None = None

    def __post_init__(self) -> None:
        joints, names = self.joints, self.joint_names
        if isinstance(joints, Mapping):
            if names is not None:
                raise DataError("joints are given by name: leave out joint_names")
            names, joints = tuple(joints), _values(joints)
        joints = as_tensor(joints, "the start posture")
        if joints.ndim != 1 or not len(joints):
            shape = tuple(joints.shape)
            raise ShapeError(f"the start posture is a number for each joint, got shape {shape}")
        names = _check_names(names, len(joints))
        times = {
            name: None if value is None else _check_time(value)
            for name, value in (("time", self.time), ("frames_time", self.frames_time))
        }
        recorded = times["time"] if self.frames_time is None else times["frames_time"]
        frames = _check_frames(self.frames, None if recorded is None else len(recorded))
        vars(self).update(joints=joints, frames=frames, joint_names=names, **times)

    @classmethod
    def of(cls, demonstration: Demonstration, time: Any = None) -> Situation:
        """Return the situation of a demonstration: its start posture and its frames.

        Parameters
        ----------
        demonstration : Demonstration
            Frames that move do so when they did in the demonstration.
        time : array-like of shape (T,), optional
            When references are wanted [s]. By default the model's own time, not that of the
            demonstration, which may be longer or shorter than the skill.
        """
        return cls(
            demonstration.joints[0],
            demonstration.frames,
            time,
            demonstration.joint_names,
            demonstration.time,
        )

    def reorder(self, joint_names: Sequence[str]) -> Situation:
        """Bring the joints into the order of ``joint_names``.

        Other joints are left out. Without names, the order is trusted.

        Raises
        ------
        UnknownNameError
            If one of the names is not among the situation's.
        """
        return _reorder(self, joint_names, "the situation")

    def __repr__(self) -> str:
        time = "" if self.time is None else f", {len(self.time)} steps"
        return f"Situation({len(self.joints)} joints, frames={sorted(self.frames)}{time})"

    def frames_at(self, time: Tensor) -> dict[str, Frame]:
        """Return the frames as they are at other times.

        Parameters
        ----------
        time : Tensor of shape (T,)
            In seconds.

        Raises
        ------
        ShapeError
            If it is not known when the poses of a frame that moves were recorded, and there
            are not as many as times.
        """
        recorded = self.time if self.frames_time is None else self.frames_time
        if recorded is None:
            _check_frames(self.frames, len(time))
            return dict(self.frames)
        recorded = recorded.to(time)
        return {name: frame.resample(recorded, time) for name, frame in self.frames.items()}


def _values(joints: Mapping[str, Any]) -> Tensor:
    """Join the numbers of joints that are given by name."""
    parts = [as_tensor(value, f"joint {name!r}").reshape(-1) for name, value in joints.items()]
    return torch.cat(parts) if parts else torch.empty(0)


def _reorder[Given: (Demonstration, Situation)](
    given: Given, wanted: Sequence[str], where: str
) -> Given:
    """Select wanted joints, in their order; all as they are where they are unnamed."""
    present = given.joint_names
    if present is None or present == tuple(wanted):
        return given
    for name in wanted:
        if name not in present:
            raise UnknownNameError("joint", name, where, present)
    columns = [present.index(name) for name in wanted]
    changed: dict[str, Any] = {"joints": given.joints[..., columns]}
    if isinstance(given, Demonstration) and given.commands is not None:
        changed["commands"] = given.commands[..., columns]
    return replace(given, joint_names=tuple(wanted), **changed)


def check_robot(robot: Any) -> None:
    """Refuse what is no robot, as the name of its file.

    Parameters
    ----------
    robot : object
        None, or what has ``joint_names`` or ``state(joints)``.

    Raises
    ------
    DataError
        If it is something else.
    """
    if robot is not None and not (hasattr(robot, "state") or hasattr(robot, "joint_names")):
        raise DataError(
            f"robot is a Robot, Poses, or another Kinematics, got {robot!r}; a file is read by "
            "Robot.from_urdf(path, links) or Robot.from_mjcf(path, links)"
        )


def check_demonstrations(demonstrations: Any) -> list[Demonstration]:
    """Check what a user passes as ``X``: a non-empty sequence of like demonstrations.

    Their joints are brought into the order of the first that names them.

    Raises
    ------
    DataError
        If ``demonstrations`` are something else, empty, or differ in joints or frames.
    """
    if isinstance(demonstrations, Demonstration):
        raise DataError("expected a list of demonstrations, got one: wrap it, [demonstration]")
    if not isinstance(demonstrations, Iterable):
        name = type(demonstrations).__name__
        raise DataError(f"expected a list of Demonstration, got {name}")
    checked = list(demonstrations)
    if not checked:
        raise DataError("expected at least one demonstration, got an empty list")
    names: tuple[str, ...] = ()
    for index, item in enumerate(checked):
        if not isinstance(item, Demonstration):
            raise DataError(
                f"expected a list of Demonstration, item {index} is {type(item).__name__}"
            )
        names = names or item.joint_names or ()
    for index, item in enumerate(checked):
        _check_alike(index, item, checked[0], names)
    return [item.reorder(names) for item in checked]


def _check_alike(
    index: int, item: Demonstration, first: Demonstration, names: tuple[str, ...]
) -> None:
    if item.n_joints != first.n_joints:
        raise ShapeError(
            f"demonstration {index} has {item.n_joints} joints, the first has {first.n_joints}"
        )
    if set(item.joint_names or names) != set(names):
        raise DataError(
            f"demonstration {index} has joint_names {item.joint_names}, another {names}"
        )
    for what in ("frames", "wrenches"):
        own, others = sorted(getattr(item, what)), sorted(getattr(first, what))
        if own != others:
            raise DataError(f"demonstration {index} has {what} {own}, the first has {others}")

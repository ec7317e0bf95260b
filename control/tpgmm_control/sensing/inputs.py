"""Inputs of a running skill: measured joints, poses of objects, and how old they are."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_control.sensing.pose_filter import OneEuro, PoseFilter
from tpgmm_control.sensing.states import replace_fields
from tpgmm_control.sensing.trust import (
    DEAD,
    FLIPPED,
    IMPOSSIBLE,
    JUMPED,
    LOST,
    OTHER_UNIT,
    Floats,
    JointReading,
    Mask,
    PoseReading,
    Reading,
    Trust,
)
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.robots.kinematics import Kinematics

#: Faults of readings in words.
FAULTS = {
    LOST: "is missing or not finite",
    IMPOSSIBLE: "cannot be (beyond the joints' limits, or no unit quaternion)",
    JUMPED: "has jumped further than it can have moved",
    OTHER_UNIT: "is in another unit than before (degrees for radians?)",
    DEAD: "is 0 in all joints at once",
    FLIPPED: "has turned in place further than it can have (a flip of the tracker?)",
}


@dataclass(frozen=True, eq=False)
class Inputs:
    """The accepted inputs of one tick; :meth:`update` gives those of the next.

    A signal that was read in one step is expected in each that follows: joints or an object's
    pose that stop to come are lost, and not the same as those that never came.

    Parameters
    ----------
    kinematics : Kinematics
    start : Tensor of shape (..., n_joints)
        Where the robots stand when the skill begins.
    frames : dict of str to Frame
        Where the objects are taken to be.
    trust : Trust
    smoothing : OneEuro, optional
        Filter of poses that come at each step; none by default.
    ignored : ndarray of bool, of shape (n_joints,), optional
        Joints of which readings tell nothing, as of grippers, which objects keep from their
        references.
    joints : JointReading, optional
        None as long as nothing was measured.
    poses : dict of str to PoseReading
        Of objects whose poses come at each step.
    filters : dict of str to PoseFilter
        Their filters.
    ages : dict of str to ndarray
        Ages of inputs that were given at this step [s].
    """

    kinematics: Kinematics
    start: Tensor
    frames: dict[str, Frame]
    trust: Trust
    smoothing: OneEuro | None = None
    ignored: Mask | None = None
    joints: JointReading | None = None
    poses: dict[str, PoseReading] = field(default_factory=dict)
    filters: dict[str, PoseFilter] = field(default_factory=dict)
    ages: dict[str, Floats] = field(default_factory=dict)

    def update(
        self,
        dt: float | Floats,
        joints: Any,
        frames: Mapping[str, Any] | None,
        ages: Mapping[str, float] | None = None,
    ) -> Self:
        """The accepted inputs ``dt`` seconds later.

        Parameters
        ----------
        dt : float or ndarray of shape (...)
            Above 0, the same for all robots or of each one [s].
        joints : array-like of shape (..., n_joints), optional
            Measured; a robot whose values are not finite has none.
        frames : mapping of str to Frame, to array-like of shape (..., 7), or to None, optional
            Positions and unit quaternions (w, x, y, z), which need not be finite.
        ages : mapping of str to float, optional
            How old the measured ``"joints"`` and the frames are [s].

        Raises
        ------
        ShapeError
            If an array does not have the shape of the robots.
        """
        seen, old = _mapping(frames), _mapping(ages)
        quiet = joints is None and self.joints is None
        if quiet and not (seen or old or self.poses or self.ages):
            return self
        poses, filters, known = dict(self.poses), dict(self.filters), dict(self.frames)
        for name in {*poses, *seen} & known.keys():  # operators refer to no other object
            pose = seen.get(name)
            if name in poses or pose is not known[name]:  # a pose of the start is no stream
                poses[name], filters[name], known[name] = self._pose(name, pose, dt)
        return replace_fields(
            self,
            joints=None if quiet else self._joints(joints, dt),
            poses=poses,
            filters=filters,
            frames=known,
            ages={name: _number(age) for name, age in old.items()},
        )

    def _joints(self, joints: Any, dt: float | Floats) -> JointReading:
        """The joints after a tick."""
        measured = None
        if joints is not None:
            measured = self._array(joints, "joints", self.kinematics.n_joints)
        if measured is not None and self.ignored is not None:
            measured = np.where(self.ignored, 0.0, measured)
        return (self.joints or self._first_joints()).update(measured, dt)

    @property
    def measured(self) -> Tensor | None:
        """Joints (..., n_joints), NaN where they are not accepted; None before the first."""
        if self.joints is None:
            return None
        value = np.where(self.joints.accepted[..., None], self.joints.value, np.nan)
        return torch.from_numpy(value).to(self.kinematics.lower)

    @property
    def jumped(self) -> Mask:
        """Robots (...) whose joints have jumped to where they are now."""
        return self._no_robots if self.joints is None else self.joints.jumped

    @property
    def jumping(self) -> Mask:
        """Robots (...) whose joints are read elsewhere, which is not accepted yet."""
        return self._no_robots if self.joints is None else self.joints.fault == JUMPED

    @property
    def frozen(self) -> Mask:
        """Robots (...) whose joints have been the same to the last bit for too long."""
        joints, longest = self.joints, self.trust.joint_timeout
        return self._no_robots if joints is None else joints.same_for > longest

    @property
    def _no_robots(self) -> Mask:
        return np.zeros(tuple(self.start.shape[:-1]), bool)

    @property
    def shares(self) -> dict[str, Tensor]:
        """Share of the last reading in an object's pose (...), of those that filters delay."""
        shares = {name: np.asarray(smooth.share) for name, smooth in self.filters.items()}
        like = self.kinematics.lower
        return {n: torch.from_numpy(s).to(like) for n, s in shares.items() if (s < 1).any()}

    @property
    def lost(self) -> dict[str, Tensor]:
        """Robots (...) that do not see an object now, of objects that some do not see."""
        lost = {name: ~reading.accepted for name, reading in self.poses.items()}
        return {name: torch.as_tensor(where) for name, where in lost.items() if where.any()}

    def untrusted(self, held: Mapping[str, Mask]) -> Mask:
        """Robots (...) without an accepted input for too long.

        Parameters
        ----------
        held : mapping of str to ndarray of bool, of shape (...)
            Robots that know where an object is without seeing it.
        """
        old = self._no_robots
        for name, reading in self._readings().items():
            old |= (reading.age > self._timeout(name)) & ~held.get(name, np.False_)
        for name, age in self.ages.items():
            old |= ~(age <= self._timeout(name)) & ~held.get(name, np.False_)
        return old

    def reasons(self, robots: Mask) -> dict[tuple[int, ...], str]:
        """Why these robots are held, in words, by their index."""
        texts: dict[tuple[int, ...], str] = {}
        for index in map(tuple, np.argwhere(robots).tolist()):
            parts = []
            for name, reading in self._readings().items():
                if reading.age[index] > self._timeout(name):
                    fault = FAULTS.get(int(reading.fault[index]), "was not accepted")
                    what = name if name == "joints" else f"frame {name!r}"
                    parts.append(f"{what} {fault}, for {float(reading.age[index]):.2g} s")
            for name, age in self.ages.items():
                old = float(np.broadcast_to(age, robots.shape)[index])
                if not old <= self._timeout(name):
                    parts.append(name if old == np.inf else f"{name} is {old:.2g} s old")
            texts[index] = "; ".join(parts)
        return texts

    def _timeout(self, name: str) -> float:
        """Of a signal, with room for the rounding of a sum of ticks."""
        trust = self.trust
        return (1 + 1e-9) * (trust.joint_timeout if name == "joints" else trust.frame_timeout)

    def _readings(self) -> dict[str, Reading]:
        joints: dict[str, Reading] = {} if self.joints is None else {"joints": self.joints}
        return joints | self.poses

    def _first_joints(self) -> JointReading:
        start = _numpy(self.start)
        ignored = np.zeros(start.shape[-1], bool) if self.ignored is None else self.ignored
        ends = {"lower": -np.inf, "upper": np.inf, "velocity": np.inf}
        limits = {
            name: np.where(ignored, end, _numpy(getattr(self.kinematics, name)))
            for name, end in ends.items()
        }
        return JointReading.first(self.trust, np.where(ignored, 0.0, start), **limits)

    def _pose(
        self, name: str, seen: Any, dt: float | Floats
    ) -> tuple[PoseReading, PoseFilter, Frame]:
        pose = None if seen is None else self._pose_array(seen, name)
        if name in self.poses:
            reading, smooth = self.poses[name], self.filters[name]
        else:
            start = self._pose_array(self.frames[name], name)
            assert start is not None
            reading = PoseReading.first(self.trust, start)
            smooth = PoseFilter.first(self.smoothing or OneEuro(cutoff=np.inf), start)
        reading = reading.update(pose, dt)
        smoother = smooth.update(reading.value, dt)
        if smoother is smooth:
            return reading, smooth, self.frames[name]
        values = torch.from_numpy(smoother.pose).to(self.kinematics.lower)
        return reading, smoother, Frame.from_checked(values[..., :3], values[..., 3:])

    def _pose_array(self, pose: Any, name: str) -> Floats | None:
        if isinstance(pose, Frame):
            pose = np.concatenate((_numpy(pose.position), _numpy(pose.orientation)), -1)
        return self._array(pose, f"frame {name!r}", 7)

    def _array(self, values: Any, what: str, size: int) -> Floats | None:
        """An array of the robots' shape; None if these are no numbers."""
        try:
            given = _numpy(values) if isinstance(values, Tensor) else values
            array = np.asarray(given, np.float64)
        except (TypeError, ValueError, OverflowError):
            return None
        batch = tuple(self.start.shape[:-1])
        if array.shape == (*batch, size):
            return array.copy()
        with suppress(ValueError):
            if array.shape[-1:] == (size,):  # one value is not broadcast over the coordinates
                return np.array(np.broadcast_to(array, (*batch, size)))
        raise ShapeError(
            f"the skill began with robots of shape {batch}, {what} now has shape "
            f"{array.shape}, not {(*batch, size)}: begin it again for other robots"
        )


def _mapping(values: Any) -> Mapping[str, Any]:
    """Values by name; empty if none were given."""
    return values if isinstance(values, Mapping) else {}


def _number(value: Any) -> Floats:
    """An age; NaN if it is not a number."""
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return np.asarray(np.nan)


def _numpy(values: Tensor) -> NDArray[np.float64]:
    """Of a processor's float64 tensor a view, of others a copy."""
    array = values.numpy(force=True)
    return array if array.dtype == np.float64 else array.astype(np.float64)

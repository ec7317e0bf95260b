"""What a running skill is told: where its robots stand, where objects are, how old that is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import ShapeError, UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.sensing.pose_filter import OneEuro, PoseFilter
from tpgmm_torch.sensing.trust import (
    IMPOSSIBLE,
    JUMPED,
    LOST,
    OTHER_UNIT,
    JointReading,
    PoseReading,
    Reading,
    Trust,
)

__all__ = ["Inputs"]

#: In words, by what was wrong with a reading.
WORDS = {
    LOST: "is missing or not finite",
    IMPOSSIBLE: "cannot be (beyond the joints' limits, or no unit quaternion)",
    JUMPED: "has jumped further than it can have moved",
    OTHER_UNIT: "is in another unit than before (degrees for radians?)",
}

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Inputs:
    """The inputs that are believed at one tick; :meth:`hear` gives those of the next.

    What was told in one step is expected in each that follows: joints or an object's pose that
    stop to come are lost, and not the same as those that never came.

    Parameters
    ----------
    kinematics : Kinematics
    start : Tensor of shape (..., n_joints)
        Where the robots stand when the skill begins.
    frames : dict of str to Frame
        Where the objects are taken to be.
    trust : Trust
    smoothing : OneEuro, optional
        What takes the noise from poses that come at each step; None leaves it in.
    joints : JointReading, optional
        None as long as nothing was measured.
    poses : dict of str to PoseReading
        Of objects whose poses come at each step.
    filters : dict of str to PoseFilter
        What is left of their noise.
    stale : dict of str to ndarray
        Ages that were told at this step [s].
    """

    kinematics: Kinematics
    start: Tensor
    frames: dict[str, Frame]
    trust: Trust
    smoothing: OneEuro | None = None
    joints: JointReading | None = None
    poses: dict[str, PoseReading] = field(default_factory=dict)
    filters: dict[str, PoseFilter] = field(default_factory=dict)
    stale: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    def hear(
        self,
        dt: float | NDArray[np.float64],
        joints: Any,
        frames: Mapping[str, Any] | None,
        ages: Mapping[str, float] | None = None,
    ) -> Self:
        """What is believed ``dt`` seconds later.

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
        UnknownNameError
            If the age of something else is told.
        """
        reading = self.joints
        if joints is None and not frames and not ages and not self._listening:
            return self
        if joints is not None:
            measured = self._array(joints, "joints", self.kinematics.n_joints)
            reading = self._joints(measured, dt)
        elif reading is not None:
            reading = reading.hear(None, dt)
        told = {} if frames is None else frames
        poses, filters, known = self.poses, self.filters, self.frames
        for name in {*poses, *told} if poses or told else ():
            if name not in known:
                continue  # an object that no operator refers to
            heard = told.get(name)
            if heard is known[name] and name not in poses:
                continue  # the pose of the start, told again
            if poses is self.poses:
                poses, filters, known = dict(poses), dict(filters), dict(known)
            poses[name], filters[name], known[name] = self._pose(name, heard, dt)
        stale = {}
        for name, age in (ages or {}).items():
            if name != "joints" and name not in known:
                raise UnknownNameError("age of", name, "the inputs", ["joints", *known])
            stale[name] = np.asarray(age, dtype=np.float64)
        other = object.__new__(type(self))  # dataclasses.replace takes five times as long
        other.__dict__.update(
            self.__dict__, joints=reading, poses=poses, filters=filters, frames=known,
            stale=stale,
        )  # fmt: skip
        return other

    @property
    def _listening(self) -> bool:
        """Whether something has been told that is expected again, or was old."""
        return self.joints is not None or bool(self.poses) or bool(self.stale)

    @property
    def shape(self) -> torch.Size:
        """Of the batch."""
        return self.start.shape[:-1]

    @property
    def measured(self) -> Tensor | None:
        """Joints (..., n_joints), NaN where they are not believed; None before the first."""
        if self.joints is None:
            return None
        reading = self.joints
        value = reading.value
        if not reading.calm:
            value = np.where(reading.believed[..., None], value, np.nan)
        return torch.from_numpy(value).to(self.kinematics.lower)

    @property
    def shares(self) -> dict[str, Tensor]:
        """Of the last look at an object in its pose (...), of those that filters make late."""
        shares = {name: np.asarray(smooth.share) for name, smooth in self.filters.items()}
        like = self.kinematics.lower
        return {n: torch.from_numpy(s).to(like) for n, s in shares.items() if (s < 1).any()}

    def untrusted(self) -> Mask | None:
        """Robots (...) that have had nothing to believe for too long; None if there is none."""
        signals = self._signals()
        if all(reading.calm for _, reading in signals) and not self.stale:
            return None
        held = np.zeros(tuple(self.shape), dtype=bool)
        for name, reading in signals:
            held |= reading.age > self._patience(name)
        for name, age in self.stale.items():
            held |= ~(age <= self._patience(name))
        return held if held.any() else None

    def reasons(self, robots: Mask) -> dict[tuple[int, ...], str]:
        """Why these robots are held, in words, by their index."""
        texts: dict[tuple[int, ...], str] = {}
        for index in map(tuple, np.argwhere(robots).tolist()):
            parts = []
            for name, reading in self._signals():
                if reading.age[index] > self._patience(name):
                    what = WORDS.get(int(reading.why[index]), "was not believed")
                    parts.append(f"{name} {what}, for {float(reading.age[index]):.2g} s")
            for name, age in self.stale.items():
                old = float(np.broadcast_to(age, self.shape)[index])
                if not old <= self._patience(name):
                    parts.append(f"{name} is {old:.2g} s old")
            texts[index] = "; ".join(parts)
        return texts

    def _patience(self, name: str) -> float:
        """With a signal, but for the rounding of a sum of ticks."""
        trust = self.trust
        return (1 + 1e-9) * (trust.patience if name == "joints" else trust.frame_patience)

    def _signals(self) -> list[tuple[str, Reading]]:
        known: list[tuple[str, Reading]] = (
            [] if self.joints is None else [("joints", self.joints)]
        )
        return known + [(f"frame {name!r}", pose) for name, pose in self.poses.items()]

    def _joints(
        self, measured: NDArray[np.float64], dt: float | NDArray[np.float64]
    ) -> JointReading:
        if self.joints is not None:
            return self.joints.hear(measured, dt)
        robot = self.kinematics
        limits = tuple(_numpy(limit) for limit in (robot.lower, robot.upper, robot.velocity))
        start = JointReading.of(self.trust, _numpy(self.start).copy(), limits)  # type: ignore[arg-type]
        return start.hear(measured, dt)

    def _pose(
        self, name: str, heard: Any, dt: float | NDArray[np.float64]
    ) -> tuple[PoseReading, PoseFilter, Frame]:
        pose = None if heard is None else self._pose_array(heard, name)
        reading = self.poses.get(name)
        if reading is None:
            begun = self._pose_array(self.frames[name], name)
            reading = PoseReading.of(self.trust, begun)
            smooth = PoseFilter.of(self.smoothing or OneEuro(cutoff=np.inf), begun)
        else:
            smooth = self.filters[name]
        reading = reading.hear(pose, dt)
        smoother = smooth.see(reading.value, dt)
        if smoother is smooth:
            return reading, smooth, self.frames[name]
        values = torch.from_numpy(smoother.pose).to(self.kinematics.lower)
        return reading, smoother, Frame._from(values[..., :3], values[..., 3:])

    def _pose_array(self, pose: Any, name: str) -> NDArray[np.float64]:
        if isinstance(pose, Frame):
            pose = np.concatenate((_numpy(pose.position), _numpy(pose.orientation)), -1)
        return self._array(pose, f"frame {name!r}", 7)

    def _array(self, values: Any, what: str, size: int) -> NDArray[np.float64]:
        # a copy: who told it may write into it
        array = np.array(_numpy(values) if isinstance(values, Tensor) else values, np.float64)
        wanted = (*self.shape, size)
        if array.shape == wanted:
            return array
        try:
            if array.shape[-1:] == (size,):  # one value is not broadcast over the coordinates
                return np.broadcast_to(array, wanted)
        except ValueError:
            pass
        raise ShapeError(
            f"the skill began with robots of shape {tuple(self.shape)}, {what} now has "
            f"shape {array.shape}, not {wanted}: begin it anew for other robots"
        )


def _numpy(values: Tensor) -> NDArray[np.float64]:
    """Of a processor's float64 tensor a view, of others a copy."""
    array = values.numpy(force=True)
    return array if array.dtype == np.float64 else array.astype(np.float64)

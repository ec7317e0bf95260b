"""Object frames: from the columns of a set, or from the pose of a robot link at an event."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch

from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.layout import Feature
from tpgmm_datasets.names import pose_groups
from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import UnknownNameError

__all__ = ["FramePose", "LinkPose"]

#: Number of values of each way to write a rotation.
ROTATIONS = {"wxyz": 4, "xyzw": 4, "rotvec": 3, "euler": 3, "yaw": 1, None: 0}


@dataclass(frozen=True)
class FramePose:
    """A frame whose pose is stored in a feature.

    Parameters
    ----------
    feature : str
        Name of the feature.
    columns : sequence of int or str, or slice, optional
        Which of its values: the position's three, then the rotation's, by place or by name.
        By default those that are called ``<frame>.x``, ...; all where none are so called.
    rotation : {"wxyz", "xyzw", "rotvec", "euler", "yaw", None}, default="wxyz"
        How the orientation is written: a quaternion, w first or last; a rotation vector;
        roll, pitch and yaw about the fixed x, y and z axes (as in URDF); yaw only; None for
        no rotation.
    constant : bool or None, default=True
        Whether the first frame of the episode holds for all of it, as in the paper, or each
        step has its own pose. None: constant if it never changes.
    degrees : bool, default=False
        Whether angles are stored in degrees.
    scale : float, default=1.0
        Metres per stored unit of length.

    Examples
    --------
    A tracker that writes millimetres, and quaternions with w last:

    >>> FramePose("observation.tracker", rotation="xyzw", scale=0.001).rotation
    'xyzw'
    """

    feature: str
    columns: Sequence[int | str] | slice | None = None
    rotation: str | None = "wxyz"
    constant: bool | None = True
    degrees: bool = False
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.rotation not in ROTATIONS:
            raise DatasetError(
                f"rotation {self.rotation!r} is unknown; there are "
                f"{[name for name in ROTATIONS if name]} and None"
            )

    def select(self, name: str, feature: Feature) -> list[int]:
        """Positions of the values that make frame ``name``, checked for number."""
        needed = 3 + ROTATIONS[self.rotation]
        places = list(range(feature.width))
        if isinstance(self.columns, slice):
            places = places[self.columns]
        elif self.columns is not None:
            places = [self._place(column, feature) for column in self.columns]
        elif self.rotation == "wxyz" and (stored := pose_groups(feature.names)):
            if name not in stored:
                raise DatasetError(
                    f"frame {name!r} is not stored there, {sorted(stored)} are. To take one of "
                    "them by another name, give FramePose(..., columns=[...]) (--frame "
                    "NAME=FEATURE[7:14])",
                    column=self.feature,
                )
            places = list(stored[name])
        if len(places) != needed:
            raise DatasetError(
                f"frame {name!r} needs {needed} values (position, rotation as "
                f"{self.rotation!r}), the selection has {len(places)} of the feature's "
                f"{feature.width}, called {feature.names}. Give FramePose(..., columns=[...])",
                column=self.feature,
            )
        return places

    def _place(self, column: int | str, feature: Feature) -> int:
        names = feature.names or ()
        if isinstance(column, str) and column in names:
            return names.index(column)
        if isinstance(column, int) and -feature.width <= column < feature.width:
            return column % feature.width
        raise DatasetError(
            f"there is no value {column!r} among its {feature.width}, called {feature.names}",
            column=self.feature,
        )

    def frame(self, values: Array, places: list[int], **where: Any) -> Frame:
        """The frame of the values at ``places`` of a feature's (T, width).

        Raises
        ------
        DatasetError
            If a quaternion is not of unit norm.
        """
        rows = values if not self.constant else values[:1]
        rows = rows[:, places].astype(np.float64)
        still = self.constant or (self.constant is None and bool((rows == rows[:1]).all()))
        tensor = torch.from_numpy(rows[0] if still else rows)
        position, rotation = tensor[..., :3] * self.scale, tensor[..., 3:]
        if self.rotation in ("wxyz", "xyzw"):
            off = (torch.linalg.vector_norm(rotation, dim=-1) - 1).abs().max()
            if off > 2 * quaternions.DIGITS:
                message = (
                    f"the norm of a quaternion is off by {float(off):.3g}; are the columns "
                    f"and their order right? The rotation is read as {self.rotation!r}"
                )
                raise DatasetError(message, check="poses", column=self.feature, **where)
        return Frame(position, self._orientation(rotation))

    def _orientation(self, rotation: torch.Tensor) -> torch.Tensor | None:
        if self.rotation is None:
            return None
        if self.rotation == "wxyz":
            return rotation
        if self.rotation == "xyzw":
            return rotation.roll(1, dims=-1)
        angles = rotation.deg2rad() if self.degrees else rotation
        if self.rotation == "rotvec":
            return quaternions.exp(angles)
        axes = torch.eye(3, dtype=rotation.dtype)
        if self.rotation == "yaw":
            return quaternions.exp(angles * axes[2])
        roll, pitch, yaw = (quaternions.exp(angles[..., [i]] * axes[i]) for i in range(3))
        return quaternions.product(yaw, quaternions.product(pitch, roll))


@dataclass(frozen=True)
class LinkPose:
    """A frame that is where a link of the robot is at an event.

    Real recordings often carry no object pose; but where the hand closes, there is the
    object. In a new situation nothing has closed yet: the pose must come from elsewhere, a
    tracker or a detector. Only the pose at the ``"start"`` is known then: a model that learned
    it computes it from the start posture.

    Parameters
    ----------
    link : str
        Name of the link.
    event : str or callable
        Name of an event of the demonstration, ``"start"`` and ``"end"`` among them, or a
        function from the demonstration to a time [s].

    Examples
    --------
    >>> LinkPose.parse("right_hand@close")
    LinkPose(link='right_hand', event='close')
    """

    link: str
    event: str | Callable[[Demonstration], float]

    @classmethod
    def parse(cls, text: str) -> Self:
        """What ``LINK@EVENT`` stands for.

        Raises
        ------
        DatasetError
            If it is no such text.
        """
        link, _, event = text.strip().rpartition("@")
        if not link or not event or "@" in link:
            raise DatasetError(f"a link at an event is LINK@EVENT, got {text!r}")
        return cls(link, event)

    def time(self, demonstration: Demonstration, **where: Any) -> float:
        """When the event is [s].

        Raises
        ------
        DatasetError
            If the demonstration has no such event.
        """
        if callable(self.event):
            return float(self.event(demonstration))
        try:
            return demonstration.event(self.event)
        except UnknownNameError as error:
            message = (
                f"frame of link {self.link!r}: {error}. Say how to find it, as in "
                f"events={{{self.event!r}: 'closing:*gripper*'}} or --event "
                f"{self.event}='closing:*gripper*', or choose --episodes"
            )
            raise DatasetError(message, check="events", **where) from error

    def frame(self, demonstration: Demonstration, robot: Any, time: float) -> Frame:
        """The pose of the link at the step nearest to ``time``."""
        step = int((demonstration.time - time).abs().argmin())
        state = robot.state(demonstration.reordered(robot.joint_names).joints[step])
        return Frame(state.position(self.link), state.orientation(self.link))

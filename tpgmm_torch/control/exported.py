"""A controller that was exported: loaded in an instant, without a compiler."""

from __future__ import annotations

import json
import platform
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tpgmm_torch.control.command import Status
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ModelFileError, ShapeError, UnknownNameError

__all__ = ["ExportedCommand", "ExportedController", "load_exported"]

#: Of the package: which tensors go in and come out.
FORMAT = 1


class ExportedCommand(NamedTuple):
    """What is sent to a robot at one tick.

    Parameters
    ----------
    reference : Tensor of shape (n_joints,)
        [rad or m].
    velocity : Tensor of shape (n_joints,)
        [rad/s or m/s].
    covariance : Tensor of shape (n_joints, n_joints)
        Of the estimate that the reference was made from; the last one while the robot holds.
    time : float
        Progress [s].
    status : Status
        Running, holding or finished.
    """

    reference: Tensor
    velocity: Tensor
    covariance: Tensor
    time: float
    status: Status


class ExportedController:
    """One robot that runs an exported skill; made by :func:`load_exported`.

    Parameters
    ----------
    package : torch's loader of packages
    contents : mapping
        What the package says of itself.

    Attributes
    ----------
    joint_names, frame_names : tuple of str
        What its vectors are about, in order.
    begin, end : float
        Of the skill [s].
    bounds : dict of str to list of float
        Of position, speed, acceleration and jerk of each joint.
    clock : str
        How time goes on.
    """

    def __init__(self, package: Any, contents: Mapping[str, Any]) -> None:
        self._run, self._size = package.boxed_run, contents["state_size"]
        self.joint_names: tuple[str, ...] = tuple(contents["joints"])
        self.frame_names: tuple[str, ...] = tuple(contents["frames"])
        self.begin, self.end = contents["begin"], contents["end"]
        self.bounds: dict[str, list[float]] = contents["bounds"]
        self.clock: str = contents["clock"]
        self._state: Tensor | None = None

    def reset(self, joints: Any, frames: Mapping[str, Frame]) -> ExportedCommand:
        """Begin the skill where the robot stands.

        Parameters
        ----------
        joints : array-like of shape (n_joints,)
        frames : mapping of str to Frame

        Returns
        -------
        ExportedCommand
            Its reference is where the robot stands.

        Raises
        ------
        ShapeError, DataError, UnknownNameError
            If something is missing, not finite or of another shape. Nothing has moved then.
        """
        start = self._joints(joints)
        poses = self._frames(frames)
        if not bool(start.isfinite().all()):
            raise DataError(f"a skill begins where the robot stands, got joints {start}")
        before, self._state = self._state, start.new_zeros(self._size)
        self._measured, self._poses = start, poses
        command = self._step(0.0)
        if command.status is Status.HOLDING:
            self._state = before
            raise DataError("the model has no finite answer to these joints and frames")
        return command

    def step(
        self, dt: float, joints: Any = None, frames: Mapping[str, Frame] | Any = None
    ) -> ExportedCommand:
        """The next command. A robot is brought to rest while something is not finite.

        Parameters
        ----------
        dt : float
            Seconds since the last step; nothing moves if it is not positive.
        joints : array-like of shape (n_joints,), optional
            Measured; without them the clock takes the robot to follow.
        frames : mapping of str to Frame, or array-like of shape (F, 7), optional
            From now on; arrays are positions and quaternions (w, x, y, z).

        Raises
        ------
        DataError
            If the skill has not begun.
        ShapeError, UnknownNameError
            If the input does not fit. Nothing has moved then.
        """
        if self._state is None:
            raise DataError("the skill has not begun: call reset(joints, frames) first")
        measured = self._measured if joints is None else self._joints(joints)
        if frames is not None:
            self._poses = self._frames(frames)
        return self._step(dt, measured)

    def _step(self, dt: float, joints: Tensor | None = None) -> ExportedCommand:
        measured = self._measured if joints is None else joints
        given = [self._state, torch.tensor(dt, dtype=torch.float64), measured, self._poses]
        self._state, reference, velocity, covariance = self._run(given)
        self._measured = reference
        time, code = self._state[:2].tolist()
        return ExportedCommand(reference, velocity, covariance, time, _STATUSES[int(code)])

    def _joints(self, joints: Any) -> Tensor:
        vector = torch.as_tensor(joints, dtype=torch.float64)
        if vector.shape != (len(self.joint_names),):
            raise ShapeError(
                f"joints are {len(self.joint_names)} numbers ({', '.join(self.joint_names)}), "
                f"got shape {tuple(vector.shape)}"
            )
        return vector.contiguous()

    def _frames(self, frames: Mapping[str, Frame] | Any) -> Tensor:
        if isinstance(frames, Mapping):
            for name in self.frame_names:
                if name not in frames:
                    raise UnknownNameError("frame", name, "what was given", frames)
            poses = [(frames[n].position, frames[n].orientation) for n in self.frame_names]
            frames = torch.stack([torch.cat(pose, -1) for pose in poses])
        tensor = torch.as_tensor(frames, dtype=torch.float64).contiguous()
        if tensor.shape != (len(self.frame_names), 7):
            raise ShapeError(
                f"frames are poses of shape ({len(self.frame_names)}, 7), of "
                f"{list(self.frame_names)}, got shape {tuple(tensor.shape)}"
            )
        return tensor


def load_exported(path: str | Path) -> ExportedController:
    """Load what :meth:`TaskParameterizedGMM.export` wrote.

    This runs compiled code from the file, unlike :meth:`TaskParameterizedGMM.load`: load
    what you trust.

    Parameters
    ----------
    path : str or Path
        A package (.pt2).

    Raises
    ------
    ModelFileError
        If it is no such package, or was made for another version of PyTorch or another kind of
        processor. Nothing of it has run then.
    """
    contents = _contents(path)
    for name, value in here().items():
        if contents.get(name) != value:
            raise ModelFileError(
                f"{path} was exported for {name} {contents.get(name)!r}, and this is "
                f"{value!r}: export the model again here"
            )
    try:
        package = torch._inductor.aoti_load_package(str(path)).loader
    except (AssertionError, RuntimeError) as error:  # PyTorch 2.7 asserts that it ends in .pt2
        raise ModelFileError(f"{path} cannot be loaded: {error}") from error
    return ExportedController(package, contents)


def here() -> dict[str, str]:
    """What a package depends on."""
    return {
        "torch": torch.__version__,
        "system": f"{platform.system()} {platform.machine()}",
        "processor": torch.backends.cpu.get_cpu_capability(),
    }


def _contents(path: str | Path) -> dict[str, Any]:
    """What a package says of itself, read without running it."""
    try:
        with zipfile.ZipFile(path) as package:
            for name in package.namelist():
                if name.endswith("_metadata.json"):
                    told = json.loads(package.read(name))
                    if "tpgmm" in told:
                        contents: dict[str, Any] = json.loads(told["tpgmm"])
                        break
            else:
                raise ModelFileError(f"{path} is no controller of TaskParameterizedGMM.export")
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        if isinstance(error, ModelFileError):
            raise
        raise ModelFileError(f"{path} cannot be read as a package: {error}") from error
    if contents.get("format") != FORMAT:
        raise ModelFileError(
            f"{path} has the format {contents.get('format')!r}, this version of tpgmm-torch "
            f"reads {FORMAT}: export the model again"
        )
    return contents


_STATUSES = tuple(Status)

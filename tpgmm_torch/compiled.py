"""The control tick as one compiled graph: kinematics, operators, update (torch.compile)."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch.component_tables import Tables
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.frames import Frame
from tpgmm_torch.kinematics import RobotState
from tpgmm_torch.operators.pose_terms import PoseTerms, pose_terms
from tpgmm_torch.regression import Estimate, Regression
from tpgmm_torch.robots import Robot
from tpgmm_torch.task_update import PART, TaskUpdate

__all__ = ["CompiledRegression", "check_compiler"]


def check_compiler(backend: str) -> None:
    """Refuse to begin what cannot be finished.

    Parameters
    ----------
    backend : str
        Only ``"inductor"`` needs a compiler.

    Raises
    ------
    DependencyError
        If there is no C++ compiler.
    """
    names = (os.environ.get("CXX"), "g++", "clang++", "c++")
    if backend == "inductor" and not any(name and shutil.which(name) for name in names):
        raise DependencyError(
            "compile() needs a C++ compiler, and there is none (g++, clang++, or what CXX "
            "names): install one, or use the model as it is; the results are the same"
        )


@dataclass(frozen=True, eq=False)
class CompiledRegression(Regression):
    """A regression whose ticks at one instant run as one graph; the rest is inherited.

    Parameters
    ----------
    backend : str
        Of ``torch.compile``.

    Raises
    ------
    DataError
        At the first tick, if the model is not one of a :class:`Robot` with :class:`Canonical`
        and position and orientation operators that refer to objects.
    """

    backend: str = "inductor"

    def tick(
        self,
        time: Tensor,
        joints: Tensor,
        frames: Mapping[str, Frame],
        bounds: tuple[Tensor, Tensor] | None = None,
    ) -> Estimate:
        """One tick from the joints q_{t-1}; see :meth:`Regression.tick`."""
        joints = self.kinematics.joint_tensor(joints)
        poses = [frames[name] for name in self._terms.names if name in frames]
        learning = torch.is_grad_enabled() and joints.requires_grad
        if time.ndim or learning or len(poses) < len(self._terms.names):
            return super().tick(time, joints, frames, bounds)
        batch = torch.broadcast_shapes(joints.shape[:-1], *(f.batch_shape for f in poses))
        n = joints.shape[-1]
        frames = {name: frames[name].expand(batch) for name in self._terms.names}
        rows = [joints.expand(*batch, n).reshape(-1, n)]
        rows += [frame.position.reshape(-1, 3) for frame in frames.values()]
        rows += [frame.orientation.reshape(-1, 4) for frame in frames.values()]
        tables = self._tables(time)
        try:
            mean, covariance, activation = self._parts(time, rows, tables)
        except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
            raise DataError(
                "the covariance of the tasks is not positive definite: a direction has no "
                "variance; a larger reg_covar gives it some"
            ) from error
        mean, covariance = mean.reshape(*batch, n), covariance.reshape(*batch, n, n)
        return self.bounded(mean, covariance, activation, bounds)

    def __getstate__(self) -> dict[str, Any]:
        """What can be stored: the graph is made anew."""
        return {name: value for name, value in vars(self).items() if name != "_graph"}

    def _parts(
        self, time: Tensor, rows: list[Tensor], tables: Tables
    ) -> tuple[Tensor, Tensor, Tensor]:
        if len(rows[0]) <= PART or time.is_cuda:
            return self._graph(time, rows, tables)
        # what is between the operations shall stay in the cache
        parts = zip(*(row.split(PART) for row in rows), strict=True)
        results = [self._graph(time, list(part), tables) for part in parts]
        joints, covariances, activations = zip(*results, strict=True)
        return torch.cat(joints), torch.cat(covariances), activations[0]

    @cached_property
    def _terms(self) -> PoseTerms:
        kinematics, update = self.kinematics, self._update
        terms = None
        if isinstance(kinematics, Robot) and update is not None and update.task is not None:
            like = kinematics.lower
            terms = pose_terms(update.task.leaves, kinematics.links, like.dtype, like.device)
        if terms is None:
            raise DataError(
                "compile() serves models with robot=Robot.from_urdf(...), Canonical() and "
                "position and orientation operators in the base frame or an object's, "
                f"fusion='information', activation='time'; this one has {self.kinematics!r} "
                f"and {list(self.operators)}: use it as it is"
            )
        return terms

    @cached_property
    def _graph(self) -> Callable[..., tuple[Tensor, Tensor, Tensor]]:
        terms, update, robot = self._terms, self._update, self.kinematics
        assert update is not None
        assert isinstance(robot, Robot)
        kinematics, links = robot.forward_kinematics, robot.links

        def graph(
            time: Tensor, rows: list[Tensor], tables: Tables
        ) -> tuple[Tensor, Tensor, Tensor]:
            joints, poses, count = rows[0], rows[1:], len(terms.names)
            state = RobotState(joints, links, *kinematics(joints))
            frames = {
                name: Frame._from(poses[index], poses[count + index])
                for index, name in enumerate(terms.names)
            }
            at = terms.linearize(state, frames)
            row, shift = update.measurement(at, joints, joints.shape[:-1])
            return update.part(tables, time, row, shift, at.present)

        # every batch size is a graph of its own, with nothing left open
        how: dict[str, Any] = {"backend": self.backend, "dynamic": False, "fullgraph": True}
        if self.backend == "inductor":  # what calls the kernels is compiled too: half the time
            how["options"] = {"cpp_wrapper": True}
        return torch.compile(graph, **how)

    def _select(self, update: TaskUpdate, active: tuple[int, ...]) -> Tables:
        """Tables of one size at all instants: what is added has no weight."""
        return update.tables.padded(active, max(self._windows.largest, len(active)))

"""The control tick as one compiled graph: kinematics, operators, update.

The default is AOTInductor: what calls the kernels is compiled too, constants are part of it,
and nothing is asked before a call, which counts where a tick takes a tenth of a millisecond.
Other backends are those of torch.compile.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.control.compiled_update import CompiledUpdate
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.operators.pose_terms import PoseTerms, pose_terms
from tpgmm_torch.regression.component_tables import Tables
from tpgmm_torch.regression.regression import Estimate, Regression
from tpgmm_torch.regression.task_update import TaskUpdate
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.robots.robot import Robot

__all__ = ["CompiledRegression", "check_compiler"]

#: Robots of the graph that serves many, whose numbers a processor's cache holds.
PART = 64


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
        ``"inductor"`` compiles ahead of time; others are those of ``torch.compile``.

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
        names, n = self._terms.names, self.kinematics.n_joints
        poses = [frames[name] for name in names if name in frames]
        if not isinstance(joints, Tensor) or joints.shape[-1:] != (n,):
            joints = self.kinematics.joint_tensor(joints)
        learning = torch.is_grad_enabled() and joints.requires_grad
        if time.ndim or learning or len(poses) < len(names):
            return super().tick(time, joints, frames, bounds)
        batch = gaussians.common_shape(joints.shape[:-1], *(pose.batch_shape for pose in poses))
        tables = self._tables(time)
        if batch.numel() == 0 or len(tables.places) > self._windows.largest:
            return super().tick(time, joints, frames, bounds)
        like = self.kinematics.lower
        rows = [joints, *(p.position for p in poses), *(p.orientation for p in poses)]
        rows = [row.to(like) for row in rows]  # a graph does not ask what it is given
        run = self._one if batch.numel() == 1 else self._many
        mean, covariance, activation = run(rows, batch, [time.to(like), *vars(tables).values()])
        if not math.isfinite(mean.sum().item()):  # the plain tick says what is wrong
            return super().tick(time, joints, frames, bounds)
        return self.bounded(mean, covariance, activation, bounds)

    def __getstate__(self) -> dict[str, Any]:
        """What can be stored: graphs are made anew."""
        return {name: value for name, value in vars(self).items() if name != "_graphs"}

    def _one(
        self, rows: Sequence[Tensor], batch: torch.Size, shared: Sequence[Tensor]
    ) -> Sequence[Tensor]:
        """Joints, covariance and activation of one robot."""
        flat = [row.reshape(row.shape[-1]).contiguous() for row in rows]
        joints, covariance, activation = self._run([*flat, *shared])
        if batch:
            joints, covariance = (
                joints.view(*batch, -1),
                covariance.view(*batch, *covariance.shape),
            )
        return joints, covariance, activation

    def _many(
        self, rows: Sequence[Tensor], batch: torch.Size, shared: Sequence[Tensor]
    ) -> Sequence[Tensor]:
        """The same of robots of any number; on a processor part by part, one graph for all."""
        count, n = batch.numel(), rows[0].shape[-1]
        flat = [row.expand(*batch, row.shape[-1]).reshape(count, row.shape[-1]) for row in rows]
        size = count if rows[0].is_cuda else PART
        if spare := -count % size:
            flat = [torch.cat((row, row[:1].expand(spare, -1))) for row in flat]
        parts = zip(*(row.contiguous().split(size) for row in flat), strict=True)
        joints, covariance, activation = zip(
            *(self._run([*part, *shared]) for part in parts), strict=True
        )
        # the graph's robots stand in the last dimension
        whole = torch.cat(joints, -1)[:, :count].T.reshape(*batch, n)
        covariances = torch.cat(covariance, -1)[..., :count].permute(2, 0, 1)
        return whole, covariances.reshape(*batch, n, n), activation[0]

    def _run(self, inputs: list[Tensor]) -> Sequence[Tensor]:
        shape = inputs[0].shape
        if shape not in self._graphs:
            self._graphs[shape] = self._compile(inputs)
        return self._graphs[shape](inputs)

    @cached_property
    def _graphs(self) -> dict[torch.Size, Callable[[list[Tensor]], Sequence[Tensor]]]:
        return {}

    def _compile(self, inputs: Sequence[Tensor]) -> Callable[[list[Tensor]], Sequence[Tensor]]:
        """The graph for inputs of such shapes."""
        terms, update, robot = self._terms, self._update, self.kinematics
        assert update is not None
        assert isinstance(robot, Robot)
        graph = _Tick(terms, update, robot)
        if self.backend != "inductor":
            compiled = torch.compile(graph, backend=self.backend, dynamic=False, fullgraph=True)
            return lambda inputs: compiled(*inputs)
        # a graph of tensors that are made here serves whoever has gradients on or off
        with torch.inference_mode(False), torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what torch asks of itself
            examples = tuple(torch.empty_like(x).copy_(x) for x in inputs)
            program = torch.export.export(graph, examples)
            with tempfile.TemporaryDirectory() as folder:
                path = torch._inductor.aoti_compile_and_package(
                    program, package_path=f"{folder}/tick.pt2"
                )
                return torch._inductor.aoti_load_package(path).loader.run

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

    def _select(self, update: TaskUpdate, active: tuple[int, ...]) -> Tables:
        """Tables of one size within the windows: what is added has no weight."""
        return update.tables.padded(active, max(self._windows.largest, len(active)))


class _Tick(torch.nn.Module):
    """From joints, poses of objects, time and tables to what :class:`CompiledUpdate` gives."""

    def __init__(self, terms: PoseTerms, update: TaskUpdate, robot: Robot) -> None:
        super().__init__()
        self._terms, self._robot = terms, robot
        self._update = CompiledUpdate(update.sides)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        names = self._terms.names
        count = 1 + 2 * len(names)
        (joints, *poses), (time, *tables) = inputs[:count], inputs[count:]
        alone = joints.ndim == 1
        if alone:
            joints, *poses = (row.unsqueeze(0) for row in (joints, *poses))
        pairs = zip(poses[: len(names)], poses[len(names) :], strict=True)
        frames = {name: Frame._from(*pair) for name, pair in zip(names, pairs, strict=True)}
        links, kinematics = self._robot.links, self._robot.forward_kinematics
        state = RobotState(joints, links, *kinematics(joints))
        at = self._terms.linearize(state, frames)
        mean, covariance, activation = self._update(Tables(*tables), time, at, joints)
        if alone:
            return mean.squeeze(-1), covariance.squeeze(-1), activation
        return mean, covariance, activation

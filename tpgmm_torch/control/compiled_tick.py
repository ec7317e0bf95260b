"""The control tick as one compiled graph: kinematics, operators, update, mixing.

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
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.operators.pose_terms import pose_terms
from tpgmm_torch.regression.conditionals import Conditionals, TimeMarginals
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.regression import Components, Regression
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.robots.robot import Robot

__all__ = ["CompiledRegression", "check_compiler"]

#: Robots of the graph that serves many, whose numbers a processor's cache holds.
PART = 64


def check_compiler(backend: str, purpose: str = "compile") -> None:
    """Refuse to begin what cannot be finished.

    Parameters
    ----------
    backend : str
        Only ``"inductor"`` needs a compiler.
    purpose : str
        The method that needs it.

    Raises
    ------
    DependencyError
        If there is no C++ compiler.
    """
    names = (os.environ.get("CXX"), "g++", "clang++", "c++")
    if backend == "inductor" and not any(name and shutil.which(name) for name in names):
        raise DependencyError(
            f"{purpose}() needs a C++ compiler, and there is none (g++, clang++, or what CXX "
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
        and position and orientation operators that refer to objects, none in tangent space.
    """

    backend: str = "inductor"

    def estimate(
        self,
        time: Tensor,
        joints: Tensor | RobotState,
        frames: Mapping[str, Frame],
        bounds: tuple[Tensor, Tensor] | None = None,
    ) -> Estimate:
        """One tick from the joints q_{t-1}; see :meth:`Regression.estimate`."""
        if isinstance(joints, RobotState):
            return super().estimate(time, joints, frames, bounds)
        names, like = self.served_frames, self.kinematics.lower
        poses = [frames[name] for name in names if name in frames]
        learning = torch.is_grad_enabled() and joints.requires_grad
        components = self._components_at(time)
        large = len(components.index) > self._largest  # beyond the windows
        batch = gaussians.common_shape(joints.shape[:-1], *(pose.batch_shape for pose in poses))
        count = batch.numel()
        fits = joints.shape[-1:] == like.shape and len(poses) == len(names)
        if time.ndim or learning or large or not fits or count == 0:
            return super().estimate(time, joints, frames, bounds)
        rows = [joints, *(pose.position for pose in poses)]
        rows += [pose.orientation for pose in poses]
        # a graph does not ask what it is given
        rows = [row.to(like).expand(*batch, -1).reshape(count, -1) for row in rows]
        size = PART if count > 1 and not like.is_cuda else count
        if spare := -count % size:
            rows = [torch.cat((row, row[:1].expand(spare, -1))) for row in rows]
        [conditionals] = components.conditionals
        shared = [time.to(like), *vars(components.marginals).values()]
        shared += vars(conditionals).values()
        results = [
            self._run([*part, *shared])
            for part in zip(*(row.contiguous().split(size) for row in rows), strict=True)
        ]
        mean, covariance = (
            torch.cat(parts)[:count].view(*batch, *parts[0].shape[1:])
            for parts in list(zip(*results, strict=True))[:2]
        )
        if not math.isfinite(mean.sum().item()):  # the plain tick says what is wrong
            return super().estimate(time, joints, frames, bounds)
        estimate = Estimate(mean, covariance, results[0][2] @ components.places)
        return self.bounded(estimate, bounds)

    def __getstate__(self) -> dict[str, Any]:
        """What can be stored: graphs are compiled again."""
        return {name: value for name, value in vars(self).items() if name != "_graphs"}

    def _run(self, inputs: list[Tensor]) -> Sequence[Tensor]:
        """Joints, covariance and weights of as many robots as there are rows."""
        shape = inputs[0].shape
        if shape not in self._graphs:
            self._graphs[shape] = self._compile(inputs)
        return self._graphs[shape](inputs)

    @cached_property
    def _graphs(self) -> dict[torch.Size, Callable[[list[Tensor]], Sequence[Tensor]]]:
        return {}

    def _compile(self, inputs: Sequence[Tensor]) -> Callable[[list[Tensor]], Sequence[Tensor]]:
        """The graph for inputs of such shapes."""
        # a graph of tensors that are made here serves whoever has gradients on or off
        with torch.inference_mode(False), torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what torch asks of itself
            examples = tuple(torch.empty_like(x).copy_(x) for x in inputs)
            tick = Tick(self, self.served_frames)
            # traced, not interpreted: the default of later versions, not of PyTorch 2.7
            program = torch.export.export(tick, examples, strict=False)
            if self.backend != "inductor":
                graph = torch.compile(program.module(), backend=self.backend, fullgraph=True)
                return lambda inputs: graph(*inputs)
            with tempfile.TemporaryDirectory() as folder:
                path = torch._inductor.aoti_compile_and_package(
                    program, package_path=f"{folder}/tick.pt2"
                )
                return torch._inductor.aoti_load_package(path).loader.run

    @cached_property
    def served_frames(self) -> tuple[str, ...]:
        """Names of the frames, of a model that the graph serves."""
        kinematics, update = self.kinematics, self._update
        terms = None
        if isinstance(kinematics, Robot) and update is not None and update.task is not None:
            like = kinematics.lower
            terms = pose_terms(update.task.leaves, kinematics.links, like.dtype, like.device)
        if terms is None or not terms.fixed:
            raise DataError(
                "compile() serves models with robot=Robot.from_urdf(...), Canonical() and "
                "position and orientation operators (geometry='quaternion') in the base frame "
                "or an object's, "
                f"fusion='information', activation='time'; this one has {self.kinematics!r} "
                f"and {list(self.operators)}: use it as it is"
            )
        return terms.names

    @cached_property
    def _largest(self) -> int:
        """How many components a graph takes."""
        return len(self.log_weights) if self._active is None else self._active.largest

    def _select(self, active: tuple[int, ...]) -> Components:
        """Of one size within the windows: components that are added have no weight."""
        spare = active[:1] * (self._largest - len(active))
        components = super()._select((*active, *spare))
        components.marginals.log_peak[len(active) :] = -torch.inf
        return components


class Tick(torch.nn.Module):
    """:meth:`Regression.fuse` from joints, poses of objects, time and components."""

    def __init__(self, regression: Regression, names: Sequence[str]) -> None:
        super().__init__()
        self._regression, self._names = regression, names

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        regression, count = self._regression, len(self._names)
        joints, poses = inputs[0], inputs[1 : 1 + 2 * count]
        frames = {
            name: Frame._from(position, orientation)
            for name, position, orientation in zip(
                self._names, poses[:count], poses[count:], strict=True
            )
        }
        time, *parts = inputs[1 + 2 * count :]
        marginals, conditionals = TimeMarginals(*parts[:3]), Conditionals(*parts[3:])
        robot = regression.kinematics
        assert isinstance(robot, Robot)
        state = RobotState(joints, robot.links, *robot.forward_kinematics(joints))
        components = Components(joints, joints, marginals, (conditionals,))
        return regression.fuse(components, time, state, frames)

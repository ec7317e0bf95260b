"""The estimate of a skill as one compiled graph: kinematics, operators, fusion, mixing.

The default is AOTInductor: what calls the kernels is compiled too, and constants are part of
the graph, which counts where an estimate takes a tenth of a millisecond. Other backends are
those of torch.compile.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.atomic import replacing
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.operators import Operator
from tpgmm_torch.regression.conditionals import Components, Conditionals, TimeMarginals
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.joint_limits import keep_within
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import Bounds, RobotState
from tpgmm_torch.robots.robot import Robot

__all__ = ["compile_skill"]

#: Robots of the graph that serves many, whose numbers a processor's cache holds.
PART = 64


def compile_skill(
    skill: Regression, n_robots: int = 1, backend: str = "inductor"
) -> CompiledRegression:
    """Compile the estimate of a skill; its results are the same.

    Compiling takes about a minute. There is a graph for one robot and one for any number of
    robots; the one that is asked for is compiled now, the other when it is first needed.
    Estimates at several times, with held objects, or that are differentiated run as before.

    Parameters
    ----------
    skill : Regression
        Of a :class:`Robot`, with :class:`Canonical` and position and orientation operators in
        the base frame or an object's, none in tangent space.
    n_robots : int, default=1
        One or several.
    backend : str, default="inductor"
        AOTInductor, which needs a C++ compiler; others are those of ``torch.compile``.

    Raises
    ------
    DependencyError
        If there is no C++ compiler.
    DataError
        If the skill is of another kind.
    """
    if backend == "inductor":
        _check_compiler("compile_skill")
    compiled = _wrap(skill, "compile_skill", backend)
    like = skill.kinematics.lower
    batch = () if n_robots == 1 else (n_robots,)
    here = Frame(like.new_zeros(*batch, 3))
    time = like.new_tensor(skill.begin if math.isfinite(skill.begin) else 0.0)
    start = like.new_zeros(*batch, len(like))
    compiled.estimate(time, start, dict.fromkeys(skill.frame_names, here))
    return compiled


def export_estimate(skill: Regression, path: str | Path) -> None:
    """Write the estimate of a skill for one robot as a package for C++.

    AOTInductor's package (.pt2) maps the time (), joints (n_joints,) and poses of objects
    (F, 7), as positions and quaternions (w, x, y, z), to mean (n_joints,) and covariance
    (n_joints, n_joints), all float64. Its metadata are ``n_joints``, ``n_frames``,
    ``joint_names`` and ``frame_names``, joined by commas, and ``begin`` and ``end`` [s].
    Running it needs no compiler, the version of PyTorch that wrote it, and a processor of the
    same kind. The mean may leave the limits of position.

    Parameters
    ----------
    skill : Regression
        As for :func:`compile_skill`, on a CPU, in float64.
    path : str or Path
        A file, replaced in one step.

    Raises
    ------
    DependencyError
        If there is no C++ compiler.
    DataError
        If the skill is of another kind.
    """
    _check_compiler("export_estimate")
    like = skill.kinematics.lower
    if like.device.type != "cpu" or like.dtype != torch.float64:
        raise DataError(
            f"export_estimate() takes a skill in float64 on the CPU, got {like.dtype} on "
            f"{like.device}: fit the model with dtype='float64', device='cpu'"
        )
    names = _wrap(skill, "export_estimate").frame_names
    contents = {
        "n_joints": len(like),
        "n_frames": len(names),
        "joint_names": ",".join(skill.kinematics.joint_names),
        "frame_names": ",".join(names),
        "begin": skill.begin,
        "end": skill.end,
    }
    with _tracing(), replacing(path) as file:
        examples = like.new_zeros(()), torch.zeros_like(like), like.new_ones(len(names), 7)
        program = _trace(_OneRobot(skill), examples)
        package = file.with_name("estimate.pt2")  # PyTorch wants this ending
        torch._inductor.aoti_compile_and_package(
            program,
            package_path=str(package),
            inductor_configs={
                "aot_inductor.metadata": {key: str(value) for key, value in contents.items()}
            },
        )
        package.rename(file)


@dataclass(frozen=True, eq=False)
class CompiledRegression(Regression):
    """A regression whose estimates at one time run as one graph; see :func:`compile_skill`.

    Parameters
    ----------
    backend : str
        ``"inductor"`` compiles ahead of time; others are those of ``torch.compile``.
    """

    backend: str = "inductor"

    def estimate(
        self,
        time: Tensor,
        state: Tensor | RobotState,
        frames: Frames,
        bounds: Bounds = None,
        *,
        candidates: bool = False,
    ) -> Estimate:
        """Gaussian of the joints; see :meth:`Regression.estimate`."""
        found = None
        if isinstance(state, Tensor) and self._serves(time, state, frames):
            found = self._run_graph(time, state, [frames[name] for name in self.frame_names])
        if found is None:
            return super().estimate(time, state, frames, bounds)
        return keep_within(found, bounds)

    def _run_graph(self, time: Tensor, joints: Tensor, poses: list[Frame]) -> Estimate | None:
        """Estimate by the graph; None if not finite, of which the plain one says why."""
        like = self.kinematics.lower
        batch = gaussians.common_shape(joints.shape[:-1], *(pose.batch_shape for pose in poses))
        if batch.numel() == 0:
            return None
        rows = [joints, *(pose.position for pose in poses)]
        rows += [pose.orientation for pose in poses]
        # a graph takes one dtype
        rows = [row.to(like).expand(*batch, -1).reshape(batch.numel(), -1) for row in rows]
        components = self._components_at(time)
        [conditionals] = components.conditionals
        shared = [time.to(like), *vars(components.marginals).values()]
        shared += vars(conditionals).values()
        results = [self._run([*part, *shared]) for part in _split(rows)]
        mean, covariance = (
            torch.cat(parts)[: batch.numel()].view(*batch, *parts[0].shape[1:])
            for parts in list(zip(*results, strict=True))[:2]
        )
        if not math.isfinite(mean.sum().item()):
            return None
        return Estimate(mean, covariance, results[0][2] @ components.places)

    def _serves(self, time: Tensor, joints: Tensor, frames: Frames) -> bool:
        """Check that the graph serves: few components, no gradients, all frames."""
        differentiated = torch.is_grad_enabled() and joints.requires_grad
        if time.ndim or differentiated or joints.shape[-1:] != self.kinematics.lower.shape:
            return False
        few = len(self._components_at(time).index) <= self._largest
        return few and all(name in frames for name in self.frame_names)

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the graphs, which are compiled again."""
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
        """Return the graph for inputs of such shapes."""
        with _tracing():
            examples = tuple(torch.empty_like(x).copy_(x) for x in inputs)
            program = _trace(_Fusion(self), examples)
            if self.backend != "inductor":
                graph = torch.compile(program.module(), backend=self.backend, fullgraph=True)
                return lambda inputs: graph(*inputs)
            with tempfile.TemporaryDirectory() as folder:
                path = torch._inductor.aoti_compile_and_package(
                    program, package_path=f"{folder}/estimate.pt2"
                )
                return torch._inductor.aoti_load_package(path).loader.run

    @cached_property
    def _largest(self) -> int:
        """Number of components that a graph takes."""
        return len(self.log_weights) if self._active is None else self._active.largest

    def _select(self, active: tuple[int, ...]) -> Components:
        """Select as many in all windows: components that are added have no weight."""
        spare = active[:1] * (self._largest - len(active))
        components = super()._select((*active, *spare))
        components.marginals.log_peak[len(active) :] = -torch.inf
        return components


def _split(rows: list[Tensor]) -> Iterator[tuple[Tensor, ...]]:
    """Split rows of many robots into contiguous parts of one size, filled up with the first."""
    count = len(rows[0])
    size = PART if count > 1 and not rows[0].is_cuda else count
    if spare := -count % size:
        rows = [torch.cat((row, row[:1].expand(spare, -1))) for row in rows]
    return zip(*(row.contiguous().split(size) for row in rows), strict=True)


class _Fusion(torch.nn.Module):
    """:meth:`Regression.fuse` of tensors: joints, poses of objects, time and components."""

    def __init__(self, regression: Regression) -> None:
        super().__init__()
        self._regression = regression

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        names = self._regression.frame_names
        joints, poses = inputs[0], inputs[1 : 1 + 2 * len(names)]
        pairs = zip(names, poses[: len(names)], poses[len(names) :], strict=True)
        frames = {name: Frame.from_checked(*pose) for name, *pose in pairs}
        time, *parts = inputs[1 + 2 * len(names) :]
        marginals, conditionals = TimeMarginals(*parts[:3]), Conditionals(*parts[3:])
        robot = self._regression.kinematics
        assert isinstance(robot, Robot)
        state = RobotState(joints, robot.links, *robot.forward_kinematics(joints))
        components = Components(joints, joints, marginals, (conditionals,))
        return self._regression.fuse(components, time, state, frames)


class _OneRobot(torch.nn.Module):
    """Mean and covariance from time, joints and poses (F, 7), with all components."""

    def __init__(self, regression: Regression) -> None:
        super().__init__()
        self._fusion = _Fusion(regression)
        components = regression.components
        [conditionals] = components.conditionals
        parts = (*vars(components.marginals).values(), *vars(conditionals).values())
        self._parts = [part.detach() for part in parts]

    def forward(self, time: Tensor, joints: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
        turns = poses[:, 3:] / torch.linalg.vector_norm(poses[:, 3:], dim=-1, keepdim=True)
        rows = (*poses[:, None, :3].unbind(), *turns[:, None].unbind())  # a batch of one
        mean, covariance, _ = self._fusion(joints[None], *rows, time, *self._parts)
        return mean[0], covariance[0]


def _trace(
    module: torch.nn.Module, examples: tuple[Tensor, ...]
) -> torch.export.ExportedProgram:
    module(*examples)  # caches must hold tensors, not what a trace puts in their place
    # traced, not interpreted: the default of later versions, not of PyTorch 2.7
    return torch.export.export(module, examples, strict=False)


@contextlib.contextmanager
def _tracing() -> Iterator[None]:
    """For tensors that serve with and without gradients; PyTorch's own warnings are ignored."""
    with torch.inference_mode(False), torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _wrap(skill: Regression, purpose: str, backend: str = "inductor") -> CompiledRegression:
    """Return the skill with graphs, if it is of a kind that these serve."""
    settings = {field.name: getattr(skill, field.name) for field in fields(Regression)}
    compiled = CompiledRegression(**settings, backend=backend)
    links, task = skill.kinematics.links, compiled._update and compiled._update.task
    if (
        not isinstance(skill.kinematics, Robot)
        or not task
        or not all(_is_fixed(leaf, links) for leaf in task.leaves)
    ):
        raise DataError(
            f"{purpose}() serves models with robot=Robot.from_urdf(...), Canonical() and "
            "position and orientation operators (geometry='quaternion') in the base frame or "
            "an object's, fusion='information', activation='time'; this one has "
            f"{skill.kinematics!r} and {list(skill.operators)}: use it as it is"
        )
    return compiled


def _is_fixed(operator: Operator, links: Sequence[str]) -> bool:
    """Check that an operator is about one link, seen from what no joint moves."""
    about, *things = operator.links()
    refers = set(things) | set(operator.references())
    seen_from_link = bool(refers & set(links)) or bool(things) or about not in links
    return not seen_from_link and not operator.rotation_vector_starts(None)


def _check_compiler(purpose: str) -> None:
    names = (os.environ.get("CXX"), "g++", "clang++", "c++")
    if not any(name and shutil.which(name) for name in names):
        raise DependencyError(
            f"{purpose}() needs a C++ compiler, and there is none (g++, clang++, or what CXX "
            "names): install one, or use the skill as it is; the results are the same"
        )

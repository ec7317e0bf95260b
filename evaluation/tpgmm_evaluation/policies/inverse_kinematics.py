"""Joints for wanted poses of links, by mink: for key poses, and to generate demonstrations.

mink solves a quadratic programme at each step within the limits of position and speed. It works
on a MuJoCo model, which is built here from what the robot's kinematics are, so that tools,
bases and locked joints count.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import (
    DataError,
    DependencyError,
    PlausibilityWarning,
    ShapeError,
    UnknownNameError,
)
from tpgmm_torch.robots.robot import Robot

#: How much a posture counts beside a pose, per radian and metre. More pulls links off their
#: poses by a millimetre, much less leaves the null space to rounding.
POSTURE_COST = 1e-3
#: Steps after which a pose that is not reached counts as out of reach, and how many a second.
MOST_STEPS, RATE = 300, 20.0


def follow_poses(
    robot: Robot,
    poses: Mapping[str, Frame],
    start: Any,
    *,
    rate: float,
    posture: Any = None,
    orientations: bool = True,
    tolerance: float = 0.01,
) -> Tensor:
    """Find joints with which links follow poses, shape (T, n_joints), as near as they can.

    Parameters
    ----------
    robot : Robot
        With the links, and limits of its joints.
    poses : mapping of str to Frame
        By link, T poses each in the robot's base frame. The first are those at the start.
    start : array-like of shape (n_joints,)
        Outside the limits of position, the nearest posture within is the first.
    rate : float
        Poses per second; joints keep within their limits of position and speed.
    posture : array-like of shape (n_joints,) or (T, n_joints), optional
        Posture that joints seek slowly where poses leave them free; by default the start. Of T
        postures each goes with a pose, and is sought at once.
    orientations : bool, default=True
        False lets links turn as they like.
    tolerance : float, default=0.01
        How far from its poses a link may be before a PlausibilityWarning [m and rad].

    Raises
    ------
    DependencyError, UnknownNameError, DataError, ShapeError
        Without mink (of the extra ``ik``) or such a link, for joints that follow others, if
        the rate is not positive, the poses are too far to compute with, or poses and postures
        are not T each.

    Warns
    -----
    PlausibilityWarning
        If poses are missed, or the start is outside the limits.

    Examples
    --------
    >>> from tpgmm_datasets.robots import upper_body_urdf
    >>> robot = Robot.from_urdf(upper_body_urdf(), links=["l_hand"], joints="l_*")
    >>> start = [0.5, 0.5, -0.3, -1.5, 0.0, 0.0, 0.0]
    >>> here = robot.state(start).pose("l_hand")
    >>> way = torch.linspace(0, 0.05, 50)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    >>> wanted = Frame(here.position + way.double(), here.orientation.expand(50, 4))
    >>> follow_poses(robot, {"l_hand": wanted}, start, rate=50).shape
    torch.Size([50, 7])
    """
    shapes = {tuple(frame.batch_shape) for frame in poses.values()}
    if list(map(len, shapes)) != [1] or (0,) in shapes:
        raise ShapeError(f"each link needs the same number of poses, got {sorted(shapes)}")
    [(length,)] = shapes
    solver = _Solver(robot, poses, start, rate, orientations)
    postures = robot.joint_tensor(solver.joints if posture is None else posture)
    if postures.ndim == 1:
        postures = postures.expand(length, -1)
    else:
        solver.posture.gain = 1.0  # each is sought at once
    if len(postures) != length:
        raise ShapeError(f"{length} poses need as many postures, or one; got {len(postures)}")
    joints = [solver.joints]
    for step in range(1, length):
        wanted = {link: frame[step] for link, frame in poses.items()}
        joints.append(solver.step(wanted, postures[step]))
    found = robot.joint_tensor(torch.stack(joints))
    if missed := _describe_misses(robot, found, poses, orientations, tolerance):
        warnings.warn(
            f"the poses are missed: {missed}. They are out of reach, faster than the joints "
            "may move, or far from the start",
            PlausibilityWarning,
            stacklevel=2,
        )
    return found


def reach(
    robot: Robot,
    poses: Mapping[str, Frame],
    start: Any,
    *,
    posture: Any = None,
    orientations: bool = True,
    tolerance: float = 1e-4,
) -> Tensor:
    """Find joints at which links have given poses, shape (n_joints,), from a start.

    Parameters
    ----------
    robot : Robot
        With the links, and limits of its joints.
    poses : mapping of str to Frame
        By link, one pose each in the robot's base frame.
    start : array-like of shape (n_joints,)
        Where the search begins, or outside the limits of position at the nearest posture
        within; it ends in a posture near it.
    posture : array-like of shape (n_joints,), optional
        Posture that joints seek where poses leave them free; by default the start.
    orientations : bool, default=True
        False lets links turn as they like.
    tolerance : float, default=1e-4
        How far from a pose is near enough [m and rad].

    Raises
    ------
    DependencyError, UnknownNameError, ShapeError
        As for :func:`follow_poses`.
    DataError
        If a pose is out of reach from there, or as for :func:`follow_poses`.

    Warns
    -----
    PlausibilityWarning
        If the start is outside the limits.
    """
    for link, frame in poses.items():
        if frame.batch_shape:
            raise ShapeError(f"{link!r} needs one pose, got {tuple(frame.batch_shape)} of them")
    solver = _Solver(robot, poses, start, RATE, orientations)
    rest = robot.joint_tensor(solver.joints if posture is None else posture)
    for _ in range(MOST_STEPS):
        missed = _describe_misses(robot, solver.joints, poses, orientations, tolerance)
        if not missed:
            return robot.joint_tensor(solver.joints)
        solver.step(poses, rest)
    raise DataError(
        f"the poses are not reached from this start: {missed}. Start nearer, ask for positions "
        "alone (orientations=False), or for poses within reach"
    )


def _describe_misses(
    robot: Robot,
    joints: Tensor,
    poses: Mapping[str, Frame],
    orientations: bool,
    tolerance: float,
) -> str:
    """Describe the largest distance of links from their poses, if beyond a tolerance."""
    joints = robot.joint_tensor(joints)
    state, texts = robot.state(joints), []
    for link, pose in poses.items():
        away = (pose.position.to(joints) - state.position(link)).norm(dim=-1)
        turn = quaternions.product(
            pose.orientation.to(joints), quaternions.conjugate(state.orientation(link))
        )
        angle = quaternions.log(turn).norm(dim=-1) * float(orientations)
        errors = torch.stack((away, angle), -1).reshape(-1, 2)
        if bool(errors.max() <= tolerance):
            continue
        worst = int(errors.amax(-1).argmax())
        which = f" from pose {worst} of {len(errors)}" if len(errors) > 1 else ""
        metres, radians = errors[worst].tolist()
        degrees = math.degrees(radians)
        texts.append(f"{link!r} is {1e3 * metres:.1f} mm, {degrees:.1f} deg away{which}")
    return ", ".join(texts)


class _Solver:
    """mink on a model of the robot, and where the joints are."""

    def __init__(
        self,
        robot: Robot,
        poses: Mapping[str, Frame],
        start: Any,
        rate: float,
        orientations: bool,
    ) -> None:
        try:
            import mink
        except ImportError as error:
            raise DependencyError(
                "inverse kinematics needs mink: pip install 'tpgmm-torch[ik]'"
            ) from error
        for link in poses:
            if link not in robot.links:
                raise UnknownNameError("link", link, "the robot", robot.links)
        if not 0 < rate < math.inf:
            raise DataError(f"rate is a positive number of poses per second, got {rate}")
        self.mink, self.period = mink, 1 / rate
        model, self.columns = _model(robot)
        self.joints = _within_limits(robot, start, self.columns).cpu().double()
        self.configuration = mink.Configuration(model, self.joints[self.columns].numpy())
        cost = 1.0 if orientations else 0.0
        self.tasks = {n: mink.FrameTask(f"link {n}", "body", 1.0, cost) for n in poses}
        # a gain of one period: the posture is sought slowly, not within one step
        self.posture = mink.PostureTask(model, POSTURE_COST, gain=min(self.period, 1.0))
        speeds = zip(self.columns, robot.velocity[self.columns].tolist(), strict=True)
        limited = {robot.joint_names[i]: v for i, v in speeds if math.isfinite(v)}
        self.limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, limited)]

    def step(self, poses: Mapping[str, Frame], posture: Tensor) -> Tensor:
        """Move the joints for one period towards the poses and the posture."""
        self.posture.set_target(posture[self.columns].cpu().double().numpy())
        for link, pose in poses.items():
            orientation, position = pose.orientation.cpu().numpy(), pose.position.cpu().numpy()
            target = self.mink.SE3(np.concatenate((orientation, position)))
            self.tasks[link].set_target(target)
        tasks = [*self.tasks.values(), self.posture]
        options: dict[str, Any] = {"damping": 1e-9, "limits": self.limits}
        arguments = self.configuration, tasks, self.period, "daqp"
        with np.errstate(over="ignore", invalid="ignore"), suppress(self.mink.MinkError):
            velocity = self.mink.solve_ik(*arguments, **options)
            self.configuration.integrate_inplace(velocity, self.period)
            found = torch.from_numpy(self.configuration.q.copy())
            if found.isfinite().all():
                self.joints = self.joints.index_copy(0, torch.tensor(self.columns), found)
                return self.joints
        places = {link: pose.position.tolist() for link, pose in poses.items()}
        raise DataError(f"no step leads towards {places}: ask for poses within reach")


def _within_limits(robot: Robot, start: Any, columns: list[int]) -> Tensor:
    """Return the start, with joints that are beyond a limit at that limit."""
    joints = robot.joint_tensor(start)
    if joints.ndim != 1:
        raise ShapeError(f"one start is needed, got {tuple(joints.shape)}")
    nearest = joints.clone()
    nearest[columns] = joints.clamp(robot.lower, robot.upper)[columns]
    # a little is measured so, and needs no word
    if moved := (~nearest.isclose(joints, atol=1e-4)).nonzero().flatten().tolist():
        places = ", ".join(
            f"{robot.joint_names[i]!r} at {joints[i]:.4g} begins at its limit {nearest[i]:.4g}"
            for i in moved
        )
        warnings.warn(
            f"the start is outside the robot's limits: {places}",
            PlausibilityWarning,
            stacklevel=4,
        )
    return nearest


def _model(robot: Robot) -> tuple[Any, list[int]]:
    """Build a MuJoCo model of the robot; return it and its joints, in its order."""
    import mujoco

    spec = mujoco.MjSpec()
    bodies = [spec.worldbody]
    columns: list[int] = []
    links = iter(robot.links)
    for one in robot.tree[1:]:
        if one.joint is None:
            bodies.append(_add(bodies[one.parent], f"link {next(links)}", one.pose))
            continue
        name = robot.joint_names[one.joint]
        if one.joint in columns or (one.multiplier, one.shift) != (1.0, 0.0):
            raise DataError(
                f"joint {name!r} moves several links by mimicry, which inverse kinematics does "
                "not know: lock it, locked={...}, or name links that do not need it"
            )
        columns.append(one.joint)
        slide = mujoco.mjtJoint.mjJNT_SLIDE if one.slides else mujoco.mjtJoint.mjJNT_HINGE
        body = _add(bodies[one.parent], f"frame {len(columns)}", one.pose)
        body.add_joint(name=name, type=slide, axis=(0.0, 0.0, 1.0))
        bodies.append(body)
    model = spec.compile()
    names = [model.joint(i).name for i in range(model.njnt)]
    columns = [robot.joint_names.index(name) for name in names]
    ranges = torch.stack((robot.lower, robot.upper), -1)[columns].cpu().double()
    # only now, as the compiler takes no range of one point
    model.jnt_limited[:] = ranges.isfinite().all(-1).numpy()
    model.jnt_range[:] = ranges.nan_to_num(0.0, 0.0, 0.0).numpy()
    return model, columns


def _add(parent: Any, name: str, pose: Array) -> Any:
    turn = quaternions.from_matrix(torch.from_numpy(pose[:3, :3].copy())).numpy()
    # the mass has no effect here, but MuJoCo requires one of what moves
    body = parent.add_body(name=name, pos=pose[:3, 3], quat=turn, mass=1.0, inertia=np.ones(3))
    body.explicitinertial = True
    return body

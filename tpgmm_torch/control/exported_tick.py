"""A tick of one robot with the state of its controller: tensors in, tensors out.

What :class:`~tpgmm_torch.control.controller.Controller` does with ``trust=None``, without
Python: clock, components, kinematics, update, mixing, blend and bounds of motion are one graph
for ``torch.export``. A wanted posture becomes the reference wherever
:class:`~tpgmm_torch.motion.follower.Follower` takes it exactly. Elsewhere a joint moves with
the constant jerk that lets it come to rest at what is wanted, if it can be stopped within
all bounds after that; else it is stopped. Because stopping keeps the bounds, and what follows
a part of a stop is the rest of it, every tick keeps them.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import torch
from torch import Tensor

from tpgmm_torch.atomic import replacing
from tpgmm_torch.control.clocks import Clock
from tpgmm_torch.control.command import Status
from tpgmm_torch.control.compiled_tick import CompiledRegression, Tick, check_compiler
from tpgmm_torch.control.exported import FORMAT, here
from tpgmm_torch.control.exported_clock import exported_clock
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.motion.follower import CRUISE, MEMORY, ROUNDING
from tpgmm_torch.motion.minimum_jerk import fading_time, minimum_jerk
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.robots.robot import Robot

__all__ = ["BrakingLaw", "ExportedTick", "export"]

#: Numbers of a state that are not of a joint: progress, status, whether it has begun, the last
#: tick's duration, time since the robot went on, time in which its gap fades.
SCALARS = 6
#: Numbers of each joint: position, velocity and acceleration of the motion, first and second
#: difference of the references, the wanted posture and its drift, whether the joint is behind
#: it, the gap that fades. Behind them are the last covariance and what the clock remembers.
ROWS = 9
#: Bounds that are not there.
ENDLESS = 1e9
#: Into how many parts the span of jerks is divided, and how often.
PARTS, ROUNDS = 16, 3

Motion = tuple[Tensor, Tensor, Tensor]


class ExportedTick(torch.nn.Module):
    """``forward(state, dt, joints, frames) -> state, reference, velocity, covariance``.

    Parameters
    ----------
    regression : Regression
        Of a model that the compiled tick serves.
    names : sequence of str
        Its frames, in order.
    begin, end, blend : float
        As for the controller [s].
    bounds : MotionBounds
    clock : Clock
        One that :func:`.exported_clock` knows.
    """

    def __init__(
        self,
        regression: Regression,
        names: Sequence[str],
        begin: float,
        end: float,
        blend: float,
        bounds: MotionBounds,
        clock: Clock,
    ) -> None:
        super().__init__()
        self._tick, self._like = Tick(regression, names), regression.kinematics.lower
        assert isinstance(regression.kinematics, Robot)
        self._robot, self._names = regression.kinematics, tuple(names)
        self._gripping = self._robot.gripping()
        self._begin, self._end, self._blend = begin, end, blend
        self._brakes = BrakingLaw(bounds)
        self._all = regression._components
        self._edges, self._table, self._peaks = regression.windows(begin, end)
        self._clock = exported_clock(
            clock, regression, names, begin, end, self._seen, self._estimate
        )

    @property
    def size(self) -> int:
        """How many numbers a state has; zeros begin the skill where the robot stands."""
        joints = len(self._like)
        return SCALARS + ROWS * joints + joints**2 + self._clock.size

    def program(self) -> torch.export.ExportedProgram:
        """The graph, which keeps constants of its own."""
        count, double = len(self._like), torch.float64
        self._clock.trace(len(self._names))
        inputs = (
            torch.zeros(self.size, dtype=double),
            torch.tensor(0.001, dtype=double),
            torch.zeros(count, dtype=double),
            torch.zeros(len(self._names), 7, dtype=double),
        )
        return torch.export.export(self, inputs, strict=False)

    def forward(
        self, state: Tensor, dt: Tensor, joints: Tensor, frames: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """One tick.

        Parameters
        ----------
        state : Tensor of shape (size,)
            What the last tick returned.
        dt : Tensor of shape ()
            Seconds since then.
        joints : Tensor of shape (n_joints,)
            Measured [rad or m].
        frames : Tensor of shape (F, 7)
            Positions and quaternions (w, x, y, z) of objects.
        """
        timely, heard = (dt > 0) & dt.isfinite(), joints.isfinite().all()
        norms = torch.linalg.vector_norm(frames[:, 3:], dim=-1, keepdim=True)
        heard = heard & frames.isfinite().all() & (norms > 0).all()
        before, _, begun, last_dt, since, lasting = state[:SCALARS].unbind()
        begun = begun > 0
        count = len(joints)
        rows, last, memory = state[SCALARS:].split(
            (ROWS * count, count * count, self._clock.size)
        )
        rows, last = rows.view(ROWS, count), last.view(count, count)
        measured = torch.where(heard, joints, rows[0])
        rows = torch.where(begun, rows, _standing(measured))
        before = torch.where(begun, before, self._begin)
        memory = torch.where(begun, memory, self._clock.start(measured))
        if self._gripping is not None:  # what it holds keeps a gripper from its reference
            measured = torch.where(self._gripping, rows[0], measured)
        unit = torch.eye(7, dtype=frames.dtype, device=frames.device)[3]
        poses = torch.where(heard, frames / torch.cat((norms.new_ones(1, 3).expand(
            len(frames), 3), norms.expand(-1, 4)), 1), unit)  # fmt: skip
        goes = begun & heard & timely
        passed = torch.where(goes, dt, 0.0)
        time, remembered, moved = self._clock(
            memory, before, passed, rows[0], measured, last, poses
        )
        time, memory = torch.where(goes, time, before), torch.where(goes, remembered, memory)
        moved = goes & moved
        # where a robot was brought, its reference begins anew
        rows = torch.where(moved, _standing(measured), rows)
        ended = begun & (before >= self._end) & (time >= self._end)

        mean, covariance = self._estimate(time, rows[0], poses)
        mean = torch.clamp(mean, self._brakes.lower, self._brakes.upper)
        fades = begun & ~moved
        gap = torch.where(fades, rows[8], rows[0] - mean)
        since = torch.where(fades, since + passed, 0.0)
        wanted = mean
        if self._blend > 0:
            faster = torch.where(moved, fading_time(gap, self._blend), lasting)
            lasting = torch.where(begun, faster, self._blend)
            wanted = mean + (1 - minimum_jerk(since / lasting)) * gap
        wanted = torch.where(ended, rows[5], wanted)
        known = wanted.isfinite().all()
        moves = heard & known
        # what cannot be known brings the robot to rest
        step = torch.where(timely, dt, 1.0)
        followed = self._brakes.follow(rows, torch.where(moves, wanted, rows[5]), moves, step,
                                       last_dt)  # fmt: skip
        status = torch.where(
            moves & (timely | ~begun),
            torch.where(ended, float(Status.FINISHED.code), float(Status.RUNNING.code)),
            float(Status.HOLDING.code),
        )
        covariance = torch.where(moves & ~ended, covariance, last)
        # the first reference is where the robot stands; nothing moves in no time
        after = torch.where(begun, followed, rows[:8]).flatten()
        starts = heard & known & ~begun
        after_dt = torch.where(begun, dt, 0.0)
        began = (begun | starts).to(time)
        scalars = torch.stack((time, status, began, after_dt, since, lasting))
        gap = torch.where(known, gap, 0.0)
        new = torch.cat((scalars, after, gap, covariance.flatten(), memory))
        halted = torch.cat((state[:1], status[None], state[2:]))
        # who has not begun begins anew
        new = torch.where((begun & timely) | starts, new, halted)
        position, velocity = new[SCALARS : SCALARS + 2 * count].view(2, count)
        reference = torch.where(new[2] > 0, position, joints)
        return new, reference, velocity.clone(), covariance

    def _seen(self, joints: Tensor, poses: Tensor) -> tuple[RobotState, dict[str, Frame]]:
        """The robot at some joints, and the objects, as a batch of one."""
        robot, joints, poses = self._robot, joints.to(self._like)[None], poses.to(self._like)
        frames = {
            name: Frame._from(pose[None, :3], pose[None, 3:])
            for name, pose in zip(self._names, poses, strict=True)
        }
        return RobotState(joints, robot.links, *robot.forward_kinematics(joints)), frames

    def _estimate(self, time: Tensor, joints: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
        """The model's mean (n,) and covariance (n, n)."""
        window = torch.bucketize(time[None], self._edges, right=True)
        index = self._table.index_select(0, window)[0]
        marginals, [conditionals] = self._all.marginals, self._all.conditionals
        parts = [
            self._peaks.index_select(0, window)[0],
            marginals.mean[index],
            marginals.precision[index],
        ]
        parts += [tensor[index] for tensor in vars(conditionals).values()]
        poses = poses.to(self._like)
        rows = [joints.to(self._like)[None], *(pose[None, :3] for pose in poses)]
        rows += [pose[None, 3:] for pose in poses]
        mean, covariance, _ = self._tick(*rows, time.to(self._like), *parts)
        return mean[0].to(time), covariance[0].to(time)


def _standing(joints: Tensor) -> Tensor:
    """The rows of a joint state that stands."""
    rows = joints.new_zeros(ROWS, len(joints))
    rows[0], rows[5] = joints, joints
    return rows


def export(
    regression: Regression,
    path: str | Path,
    *,
    begin: float,
    end: float,
    blend: float,
    bounds: MotionBounds,
    clock: Clock,
) -> None:
    """Write what ``load_exported`` reads; atomically.

    Parameters
    ----------
    regression : Regression
    path : str or Path
    begin, end, blend : float
        As for the controller [s].
    bounds : MotionBounds
    clock : Clock

    Raises
    ------
    DependencyError
        If there is no C++ compiler.
    DataError
        If the model or the clock is of another kind than a graph serves.
    """
    check_compiler("inductor", "export")
    settings = {field.name: getattr(regression, field.name) for field in fields(Regression)}
    regression = CompiledRegression(**settings)
    names = regression.served_frames
    tick = ExportedTick(regression, names, begin, end, blend, bounds, clock)
    count = regression.kinematics.n_joints
    contents = {
        **here(),
        "format": FORMAT,
        "state_size": tick.size,
        "joints": regression.kinematics.joint_names,
        "frames": names,
        "begin": begin,
        "end": end,
        "clock": repr(clock),
        "bounds": {
            field.name: getattr(bounds, field.name).tolist() for field in fields(MotionBounds)
        },
    }
    # numbers by themselves, for who reads no JSON
    sizes = {"state_size": tick.size, "n_joints": count, "n_frames": len(names)}
    told = {"tpgmm": json.dumps(contents), **{key: str(size) for key, size in sizes.items()}}
    with (
        torch.inference_mode(False),
        torch.no_grad(),
        warnings.catch_warnings(),
        replacing(path) as file,
    ):
        warnings.simplefilter("ignore")  # of what torch asks of itself
        program = tick.program()
        package = file.with_name("tick.pt2")  # the name that it must have
        torch._inductor.aoti_compile_and_package(
            program,
            package_path=str(package),
            inductor_configs={"aot_inductor.metadata": told},
        )
        package.rename(file)


class BrakingLaw:
    """The bounds of a motion, and what moves within them."""

    def __init__(self, bounds: MotionBounds) -> None:
        limits = bounds.arrays
        names = "lower", "upper", "velocity", "acceleration", "jerk"
        for name in names:
            tensor = torch.from_numpy(getattr(limits, name)).double().clamp(-ENDLESS, ENDLESS)
            setattr(self, name, tensor)

    lower: Tensor
    upper: Tensor
    velocity: Tensor
    acceleration: Tensor
    jerk: Tensor

    def follow(
        self, rows: Tensor, wanted: Tensor, moves: Tensor, dt: Tensor, last_dt: Tensor
    ) -> Tensor:
        """The rows of a state that are of the motion, a tick later: (8, n_joints)."""
        position, velocity, acceleration, slope, bend, before, drift, behind = rows[:8]
        ago = torch.where(last_dt > 0, last_dt, dt)
        last = torch.where(last_dt > 0, last_dt, 0.0)
        # what stands outside its limits may stay as far out as it is, and come back
        low, high = torch.minimum(self.lower, position), torch.maximum(self.upper, position)
        target = torch.clamp(wanted, low, high)
        exact_slope = (target - position) / dt
        exact_bend = (exact_slope - slope) * (2 / (dt + torch.where(last > 0, last, dt)))
        exact = target, exact_slope + exact_bend * (dt / 2), exact_bend  # (F1)
        change = (exact_bend - bend).abs()
        fits = (exact_bend.abs() <= self.acceleration) & (
            change <= self.jerk * ((dt + 2 * ago) / 3)
        )
        is_behind, moved = behind > 0, (target - before) / dt
        exact_drift = torch.where(is_behind, moved, exact_slope)
        joining, onset = (exact_drift - exact_slope) / dt, self.jerk * dt
        keeps = joining.abs() <= torch.minimum(self.acceleration, onset)
        keeps = keeps & ((joining - exact_bend).abs() <= onset)
        fits = fits & (exact_slope.abs() <= self.velocity * (1 + ROUNDING))
        fits = fits & (keeps | ~is_behind) & self._stops(exact, low, high) & moves

        # as in Moment.generated: believed to move on little by little, to have stopped at once
        slower = torch.where(drift * moved < 0, 0.0, moved)
        rising = drift + (dt / MEMORY).clamp(max=1.0) * (moved - drift)
        drift = torch.where(slower.abs() < rising.abs(), slower, rising)
        drift = torch.clamp(drift, -CRUISE * self.velocity, CRUISE * self.velocity)
        start = position, velocity, acceleration
        towards = self._towards(start, target, drift, dt, low, high)
        braked = self._braked(start, dt)
        safe = self._stops(towards, low, high) & moves
        safe = safe & ((towards[0] - position).abs() <= self.velocity * dt * (1 + ROUNDING))
        chosen = [
            torch.where(fits, x, torch.where(safe, y, z))
            for x, y, z in zip(exact, towards, braked, strict=True)
        ]
        slope_now = (chosen[0] - position) / dt
        bend_now = (slope_now - slope) * (2 / (dt + torch.where(last > 0, last, dt)))
        drift = torch.where(fits, exact_drift, torch.where(moves, drift, 0.0))
        rest = slope_now, bend_now, target, drift, (~fits).to(target)
        return torch.stack((*chosen, *rest))

    def _towards(
        self,
        start: Motion,
        target: Tensor,
        drift: Tensor,
        dt: Tensor,
        low: Tensor,
        high: Tensor,
    ) -> Motion:
        """With a constant jerk to where a stop ends at the target, which moves on."""
        # more jerk ends further on: the most that does not end too far, by trying many at once
        least, part = -self.jerk, 2 * self.jerk / PARTS
        tried = torch.arange(1, PARTS + 1, dtype=target.dtype).unsqueeze(-1)
        for _ in range(ROUNDS):
            jerk = torch.minimum(least + tried * part, self.jerk)
            moved = _moved(start, jerk, dt)
            position, velocity, acceleration = moved
            lowest, highest = self._range(moved)
            peak = self._peak(moved)
            relative = position, velocity - drift, acceleration
            ahead = self._braked(relative, None)[0] > target
            mean = (position - start[0]) / dt  # half-way it may have been faster
            fast = (acceleration > self.acceleration) | (peak.maximum(mean) > self.velocity)
            slow = (acceleration < -self.acceleration) | (peak.minimum(mean) < -self.velocity)
            down = fast | (highest > high) | (ahead & ~slow & (lowest >= low))
            least = torch.minimum(least + (~down).sum(0) * part, self.jerk)
            part = part / PARTS
        return _moved(start, least, dt)

    def _peak(self, motion: Motion) -> Tensor:
        """The speed when the acceleration is given up."""
        _, velocity, acceleration = motion
        return velocity + acceleration * acceleration.abs() / (2 * self.jerk)

    def _stops(self, motion: Motion, low: Tensor, high: Tensor) -> Tensor:
        """Whether it can be stopped within all bounds."""
        lowest, highest = self._range(motion)
        speed = torch.maximum(motion[1].abs(), self._peak(motion).abs())
        within = (lowest >= low - ROUNDING) & (highest <= high + ROUNDING)
        slow = speed <= self.velocity * (1 + ROUNDING)
        gentle = motion[2].abs() <= self.acceleration * (1 + ROUNDING)
        return within & slow & gentle

    def _phases(self, motion: Motion) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
        """The fastest stop: its side, its greatest deceleration, and how long it takes what.

        With v, a >= 0 on its side the jerk is -J until the acceleration is -m, 0, and J, where
        ``m^2 = J v + a^2 / 2`` if that is within A.
        """
        side = torch.where(self._peak(motion) < 0, -1.0, 1.0)
        velocity, acceleration = side * motion[1], side * motion[2]
        lost = (velocity + acceleration.square() / (2 * self.jerk)).clamp(min=0.0)
        most = torch.minimum(
            (self.jerk * lost).sqrt(), torch.maximum(self.acceleration, -acceleration)
        )
        held = (lost - most.square() / self.jerk) / most.clamp(min=1e-12)
        phases = (acceleration + most) / self.jerk, held, most / self.jerk
        return side, most, tuple(phase.clamp(min=0.0) for phase in phases)  # type: ignore[return-value]

    def _braked(self, motion: Motion, dt: Tensor | None) -> Motion:
        """A part of the fastest stop, or all of it."""
        side, _, phases = self._phases(motion)
        left, signs = dt, (-1.0, 0.0, 1.0)
        for phase, sign in zip(phases, signs, strict=True):
            now = phase if left is None else torch.minimum(phase, left)
            motion = _moved(motion, sign * side * self.jerk, now)
            left = None if left is None else left - now
        if left is None:
            return motion
        over = left > 0  # it stands: no crumb of rounding moves it
        position, velocity, acceleration = motion
        return (
            position,
            torch.where(over, 0.0, velocity),
            torch.where(over, 0.0, acceleration),
        )

    def _range(self, motion: Motion) -> tuple[Tensor, Tensor]:
        """The lowest and the highest position of the fastest stop."""
        side, _, _ = self._phases(motion)
        position, velocity, acceleration = motion[0], side * motion[1], side * motion[2]
        # who still moves the other way turns
        root = (acceleration.square() + 2 * self.jerk * velocity).clamp(min=0.0).sqrt()
        turning = torch.where(velocity < 0, (acceleration - root) / self.jerk, 0.0)
        turned = _moved(motion, -side * self.jerk, turning.clamp(min=0.0))[0]
        end = self._braked(motion, None)[0]
        lowest = torch.minimum(torch.minimum(position, turned), end)
        return lowest, torch.maximum(torch.maximum(position, turned), end)


def _moved(motion: Motion, jerk: Tensor, dt: Tensor) -> Motion:
    """A constant jerk for a while."""
    position, velocity, acceleration = motion
    return (
        position + dt * (velocity + dt * (acceleration / 2 + dt * (jerk / 6))),
        velocity + dt * (acceleration + dt * (jerk / 2)),
        acceleration + dt * jerk,
    )

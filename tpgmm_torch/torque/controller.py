"""A running skill for robots with torque control: forces, poses and postures in one product.

A tick is that of a :class:`~tpgmm_torch.Controller`, whose inputs, clock, held objects and
status are the same, and one stage more, *drive*: the torque at the measured state, how it
fades in and out, and its limits.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.contact import Admittance
from tpgmm_torch.control.command import Command, Status
from tpgmm_torch.control.controller import Controller
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, ShapeError, TPGMMError
from tpgmm_torch.motion.follower import Follower
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.operators.wrench import ExpectedForce, Wrench
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.skills.skill import Skill
from tpgmm_torch.torque.dynamics import Dynamics
from tpgmm_torch.torque.gains import TorqueGains
from tpgmm_torch.torque.rows import (
    LocalGaussians,
    Mechanics,
    fastest,
    force_axes,
    force_row,
    fused_torque,
    jacobians,
)

__all__ = ["TorqueCommand", "TorqueController"]

#: Time in which the torque of the skill fades when a state is not known [s]: ticks that are
#: lost do nothing, and an arm of 1 rad/s moves by less than 3 degrees.
FADING_TIME = 0.05
#: Fastest pace of a skill's time that is fed forward: a clock that catches up goes no faster.
FASTEST_PACE = 2.0
#: Longest tick, in units of the shortest time constant of the damping: sampled and held,
#: damping is of no use at 1 and unstable at 2, and contact takes half of the margin.
LONGEST_TICK = 0.5

NO_WRENCH = (
    "the skill expects forces, and the first step has no wrench: forces are not corrected by "
    "what is measured. Give wrenches={link: (..., 6)}, or TorqueGains(integral=0)"
)
NO_JOINTS = "joints were not read at this step"
NO_VELOCITIES = "velocities are missing or not finite: step(dt, joints, velocities=...)"
NO_TORQUE = "there was no finite torque (inertia, bias or frames)"
LONG_TICK = (
    "a tick is longer than the {:.2g} ms that the damping allows: run at {:.0f} Hz or more, or "
    "with lower TorqueGains"
)


@dataclass(frozen=True, eq=False)
class TorqueCommand(Command):
    """What is sent to robots with torque control.

    Parameters
    ----------
    reference, velocity, time, estimate, codes, reasons, impedance, compute_novelty
        As for :class:`~tpgmm_torch.control.command.Command`. Where forces are expected, the
        reference is where the robot is.
    relocalized, offset
        Likewise.
    torque : Tensor of shape (..., n_joints)
        Of each joint, gravity and the bias of the motion included [N m or N].
    """

    torque: Tensor = field(kw_only=True)


@dataclass(frozen=True, eq=False)
class Drive:
    """What is remembered of the last tick; immutable.

    Parameters
    ----------
    joints : Tensor of shape (..., n_joints)
        Last known ones.
    sent : Tensor of shape (..., n_joints)
        Torque beside the bias, before limits.
    offset : Tensor of shape (..., n_joints)
        Difference from what the skill asked for, when robots began or went on.
    since : Tensor of shape (...)
        Time since then [s].
    stopped : Tensor of bool of shape (...)
        Robots that are held.
    bias : Tensor of shape (..., n_joints)
    rate : Tensor of shape (...)
        The fastest of the damping [1/s].
    lost : Tensor of bool of shape (...)
        Robots without a finite torque.
    time : Tensor of shape (...)
        In the skill [s].
    dt : Tensor of shape (...)
        Duration of the last tick that had one [s].
    integrals : mapping of Wrench to Tensor of shape (..., n_axes)
        Of the errors of forces [N].
    """

    joints: Tensor
    sent: Tensor
    offset: Tensor
    since: Tensor
    stopped: Tensor
    bias: Tensor
    rate: Tensor
    lost: Tensor
    time: Tensor
    dt: Tensor
    integrals: Mapping[Wrench, Tensor] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Found:
    """Torques at a state.

    Parameters
    ----------
    fused, bias, held : Tensor of shape (..., n_joints)
        Of the skill beside the bias, the bias, and of a robot that is held, beside the bias.
    rate : Tensor of shape (...)
        The fastest of the damping [1/s].
    estimate : Estimate
        Where forces are expected, postures to which the springs of the joints alone would
        pull with the skill's torque.
    forces : sequence of (ExpectedForce, Tensor of shape (..., n_axes, 3))
        With their axes in the base frame.
    """

    fused: Tensor
    bias: Tensor
    held: Tensor
    rate: Tensor
    estimate: Estimate
    forces: Sequence[tuple[ExpectedForce, Tensor]] = ()


class TorqueController(Controller):
    """A batch of robots with torque control that run a skill.

    Where the skill expects forces (:class:`~tpgmm_torch.operators.Wrench`), all its operators
    speak of torques, and their product decides, joint by joint and instant by instant, between
    posture, pose and force. A skill without forces is followed with the stiffness of
    :class:`~tpgmm_torch.impedance.stiffness.Impedance`, firm where demonstrations agree.

    Torques begin as those that carry the robot, and the skill fades in. Without a measured
    state, or with a tick that is too long for the damping, they fade to gravity and damping,
    with a reason in the command. They are within the limits of effort, and finite.

    Where forces are expected, robots are where they are pushed to: no clock waits for one that
    is held back, which pulls with its stiffness to where it should be by then.

    Parameters
    ----------
    skill : Skill
    joints : array-like of shape (..., n_joints)
        The start postures.
    frames : mapping of str to Frame, optional
    dynamics : Dynamics
        Inertia and bias: a :class:`~tpgmm_torch.torque.MujocoDynamics`, or a function.
    gains : TorqueGains, optional
    effort : array-like of shape (n_joints,), optional
        Largest torques [N m or N]; by default those of the dynamics.
    **settings
        As for :class:`~tpgmm_torch.Controller`, of which ``trust`` is needed; ``blend`` is
        also how long the difference between the first torque and the skill's fades.

    Raises
    ------
    DataError, ShapeError
        If the skill has operators without rows of torques, the dynamics or limits do not fit
        the robot, or as for :class:`~tpgmm_torch.Controller`.
    """

    def __init__(
        self,
        skill: Skill,
        joints: Any,
        frames: Mapping[str, Frame] | None = None,
        *,
        dynamics: Dynamics,
        gains: TorqueGains = TorqueGains(),  # noqa: B008  (frozen)
        effort: Any = None,
        **settings: Any,
    ) -> None:
        if settings.get("obstacles") is not None:
            raise DataError("torques do not keep clear of obstacles: Controller does")
        super().__init__(skill, joints, frames, **{"admittance": None} | settings)
        if self._inputs is None:
            raise DataError("trust=None follows every reading: torques need trust=Trust(...)")
        self._dynamics, self._gains = dynamics, gains
        self._blend = float(settings.get("blend", 1.0))
        start, zero = self.reference, torch.zeros_like(self.reference)
        self._gaussians, self._bodies = None, {}
        if self._skill.expected_forces(self.time):
            if not isinstance(self._skill, Regression):
                raise DataError(
                    f"torques of a {type(skill).__name__} that expects forces: there are those "
                    "of one fitted skill, model.skill; run its skills one after the other"
                )
            self._gaussians = LocalGaussians(self._skill, gains)
            self._bodies = self._gaussians.bodies
        n = start.shape[-1]
        effort = getattr(dynamics, "effort", None) if effort is None else effort
        self._effort = _checked_effort(math.inf if effort is None else effort, start)
        inertia, bias = dynamics(start, zero)
        if inertia.shape != (*start.shape, n) or bias.shape != start.shape:
            raise ShapeError(
                f"dynamics give an inertia {(*start.shape, n)} and a bias {tuple(start.shape)}"
                f", got {tuple(inertia.shape)} and {tuple(bias.shape)}"
            )
        at = jacobians(self._bodies, self._state(start), self.holding.frames)
        first = Mechanics.at(inertia, at, zero, gains)
        self._stiffness = gains.joint_stiffness(inertia), gains.link_stiffness(first.mobility)
        none, time = zero.sum(-1), self.time + zero.sum(-1)
        self._drive = Drive(
            start, zero, zero, none, none == 0, bias, first.rate, none > 0, time, none
        )
        self._tick: Any = None

    def step(
        self,
        dt: float | Tensor,
        joints: Any = None,
        frames: Mapping[str, Any] | None = None,
        *,
        velocities: Any = None,
        holds: Mapping[str, str | None] | None = None,
        ages: Mapping[str, float] | None = None,
        wrenches: Mapping[str, Any] | None = None,
    ) -> TorqueCommand:
        """Find the next torque.

        Parameters
        ----------
        dt : float or Tensor of shape (...)
            Seconds since the last step.
        joints : array-like of shape (..., n_joints)
            Measured [rad or m]. Robots without them are held.
        frames : mapping of str to Frame, optional
        velocities : array-like of shape (..., n_joints)
            Measured [rad/s or m/s]. Robots without them are held.
        holds, ages, wrenches
            As for :meth:`Controller.step`.

        Returns
        -------
        TorqueCommand

        Raises
        ------
        ShapeError, UnknownNameError
            As for :meth:`Controller.step`.
        """
        if self.command is None and self._bodies and self._gains.integral and not wrenches:
            warnings.warn(NO_WRENCH, PlausibilityWarning, stacklevel=2)
        speeds, given = self._numbers(velocities, "velocities"), self._numbers(joints, "joints")
        self._tick, late = None, {**(ages or {}), **self._faults(dt, given, speeds)}
        command = super().step(dt, joints, frames, holds=holds, ages=late, wrenches=wrenches)
        known = torch.full_like(speeds, torch.nan)
        if self._tick is not None and self._tick.joints is not None:
            known = self._tick.joints
            if self._gripping is not None:
                known = torch.where(self._gripping, given, known)
        self.command = driven = self._driven(command, known, speeds)
        return driven

    def _faults(self, dt: Any, given: Tensor, speeds: Tensor) -> dict[str, Any]:
        """Why robots are held, with infinite ages: what is missing, and ticks too long."""
        seconds = dt if isinstance(dt, float | int | Tensor) else 0.0
        late = self._drive.rate * torch.nan_to_num(torch.as_tensor(seconds).to(speeds))
        longest = LONGEST_TICK / float(self._drive.rate.max().clamp_min(1e-9))
        faults = {
            NO_VELOCITIES: ~speeds.isfinite().all(-1),
            NO_JOINTS: ~given.isfinite().all(-1),
            NO_TORQUE: self._drive.lost,
            LONG_TICK.format(1e3 * longest, 1 / longest): late > LONGEST_TICK,
        }
        return {
            reason: np.where(robots.numpy(force=True), np.inf, 0.0)
            for reason, robots in faults.items()
            if bool(robots.any())
        }

    # Stages that are others where forces are expected: robots are where they are pushed to

    def _estimate(self, tick: Any) -> Estimate:
        if self._gaussians is None or self.command is None:
            return super()._estimate(tick)
        return self.command.estimate

    def _reach(self, tick: Any, found: Estimate) -> tuple[Estimate, Tensor, Follower | None]:
        if self._gaussians is None:
            return super()._reach(tick, found)
        return found, self._postures(tick, measured=True), None

    def _follow(
        self, tick: Any, found: Estimate, wanted: Tensor, fitting: Follower | None
    ) -> None:
        if self._gaussians is None:
            super()._follow(tick, found, wanted, fitting)
            return
        self._found, passed = found, torch.as_tensor(tick.seconds).to(wanted).unsqueeze(-1)
        velocity = (wanted - self.reference) / passed
        self._following = replace(
            self._following, reference=wanted, wanted=wanted, velocity=velocity, lost=None
        )

    def _send(self, tick: Any) -> Command:
        self._tick = tick
        return super()._send(tick)

    def _numbers(self, values: Any, name: str) -> Tensor:
        """Numbers (..., n_joints), which need not be finite."""
        like = self.reference
        if values is None:
            return torch.full_like(like, torch.nan)
        given = torch.as_tensor(values).to(like)
        if given.shape != like.shape:
            raise ShapeError(f"{name} have shape {tuple(like.shape)}, got {tuple(given.shape)}")
        return given

    # Stage drive

    def _driven(self, command: Command, joints: Tensor, velocities: Tensor) -> TorqueCommand:
        """The command with torques."""
        last, stopped, dt = self._drive, command.of(Status.HOLDING), self._drive.dt
        if self._tick is not None:
            dt = torch.as_tensor(self._tick.seconds).to(dt).expand_as(dt)
        stopped = stopped | joints.isnan().any(-1)
        joints = torch.where(joints.isnan(), last.joints, joints)
        velocities = torch.nan_to_num(velocities, 0.0, 0.0, 0.0)
        found = self._torques(command, joints, velocities, dt)
        finite = (found.fused + found.bias + found.held).isfinite().all(-1)
        stopped, rate = stopped | ~finite, torch.where(finite, found.rate, last.rate)
        bias = torch.where(finite.unsqueeze(-1), found.bias, last.bias)
        held = torch.where(finite.unsqueeze(-1), found.held, 0.0)
        left = (1 - dt / FADING_TIME).clamp_min(0.0).unsqueeze(-1)
        at_rest = held + left * (last.sent - held)
        # what is sent goes on where it was: the difference fades, as that of postures does
        begins = last.stopped & ~stopped
        offset = torch.where(begins.unsqueeze(-1), found.fused - last.sent, last.offset)
        since = torch.where(begins, 0.0, last.since + dt)
        share = since / self._blend if self._blend > 0 else torch.ones_like(since)
        left = 1 - minimum_jerk(share).unsqueeze(-1)
        sent = torch.where(stopped.unsqueeze(-1), at_rest, found.fused - left * offset)
        torque = (bias + sent).clamp(-self._effort, self._effort)
        free = torch.where(~stopped & (bias + sent == torque).all(-1), dt, 0.0)
        self._drive = Drive(
            joints, sent, offset, since, stopped, bias, rate, ~finite,
            command.time.expand_as(dt), dt, self._integrated(found, free, dt),
        )  # fmt: skip
        values = {one.name: getattr(command, one.name) for one in fields(Command)}
        return TorqueCommand(**values | {"estimate": found.estimate}, torque=torque)

    def _torques(
        self, command: Command, joints: Tensor, velocities: Tensor, dt: Tensor
    ) -> Found:
        """Torques at a state; not a number where there are none."""
        inertia, bias = self._dynamics(joints, velocities)
        try:
            state = self._state(joints)
            at = jacobians(self._bodies, state, self.holding.frames)
            mechanics = Mechanics.at(inertia, at, velocities, self._gains, self._stiffness)
            held, rate = mechanics.held, mechanics.rate
            found = Found(held, bias, held, rate, command.estimate)
            if self._bodies:
                return self._pressed(command, state, mechanics, dt, found)
            assert self._impedance is not None
            stiffness = command.stiffness_matrix
            damping = self._impedance.joints.damping(stiffness, inertia)
            pull = stiffness @ (command.reference - joints).unsqueeze(-1)
            fused = pull + damping @ (command.velocity - velocities).unsqueeze(-1)
            rate = torch.maximum(rate, fastest(torch.linalg.solve(inertia, damping)))
            return replace(found, fused=fused.squeeze(-1), rate=rate)
        except TPGMMError:
            if not bool(self._drive.dt.any()):  # the first step
                raise
        lost = torch.full_like(joints, torch.nan)
        return Found(lost, bias, lost, self._drive.rate, command.estimate)

    def _pressed(
        self,
        command: Command,
        state: RobotState,
        mechanics: Mechanics,
        dt: Tensor,
        found: Found,
    ) -> Found:
        """The product of all rows."""
        time, frames, last = command.time, self.holding.frames, self._drive
        assert self._gaussians is not None
        pace = torch.where(dt > 0, (time - last.time) / dt, 0.0).clamp(0.0, FASTEST_PACE)
        rows = [self._gaussians.rows(time, pace, state, frames, mechanics)]
        rates, forces = [found.rate], []
        for one in self._skill.expected_forces(time):
            axes = force_axes(one.operator, state, frames)
            body = list(self._bodies).index((one.operator.link, None, False))
            integral = last.integrals.get(one.operator, torch.zeros_like(one.force))
            rows.append(force_row(one, axes, integral, body, mechanics, self._gains))
            rates.append(rows[-1].rate)
            forces.append((one, axes))
        fused, covariance = fused_torque(rows, mechanics)
        compliance = torch.linalg.inv(self._stiffness[0])
        estimate = Estimate(
            state.joints + (compliance @ fused.unsqueeze(-1)).squeeze(-1),
            compliance @ covariance @ compliance,
            self._gaussians.skill.weights_at(time),
        )
        rate = torch.stack(rates).amax(0)
        return replace(found, fused=fused, rate=rate, estimate=estimate, forces=forces)

    def _integrated(self, found: Found, passed: Tensor, dt: Tensor) -> dict[Wrench, Tensor]:
        """Integrals of the errors of forces in contact, at most as large as the forces.

        Where there is no contact they fade as the offsets of an admittance do.
        """
        values = {}
        for one, axes in found.forces:
            reading = self._wrenches.readings.get(one.operator.link)
            if reading is None:
                continue
            force = torch.as_tensor(reading.value[..., :3, None]).to(passed)
            error = one.force - (axes @ force).squeeze(-1)
            fresh = torch.from_numpy(reading.fresh).to(passed.device)
            counts = torch.where(fresh & (one.share > 0.5), passed, 0.0).unsqueeze(-1)
            left = torch.exp(-(1 - one.share) * dt / Admittance.release).unsqueeze(-1)
            value = self._drive.integrals.get(one.operator, torch.zeros_like(error)) * left
            most = one.force.norm(dim=-1, keepdim=True)
            value = value + self._gains.integral * counts * error
            values[one.operator] = value.clamp(-most, most)
        return values


def _checked_effort(effort: Any, start: Tensor) -> Tensor:
    """The largest torque of each joint, or of all."""
    given, n = torch.as_tensor(effort).to(start), start.shape[-1]
    if given.shape not in ((), (n,)) or not bool((given > 0).all()):
        raise DataError(f"effort has a torque above 0 for each of {n} joints: {effort!r}")
    return given

"""A running skill for robots with torque control: forces, poses and postures in one product.

A tick is that of a :class:`~tpgmm_control.Controller`, whose inputs, clock, held objects and
status are the same, and one stage more, *drive*: the torque at the measured state, how it
fades in and out, and its limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_control.contact import Admittance
from tpgmm_control.loop.command import Command, Status
from tpgmm_control.loop.controller import Controller
from tpgmm_control.loop.reach import Fade
from tpgmm_control.torque.dynamics import Dynamics
from tpgmm_control.torque.gains import TorqueGains
from tpgmm_control.torque.rows import (
    LocalGaussians,
    Mechanics,
    fastest,
    force_row,
    fused_torque,
)
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, ShapeError, TPGMMError
from tpgmm_torch.operators.wrench import ExpectedForce, Wrench
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.skills.skill import Skill

__all__ = ["TorqueController"]

#: Time in which the torque of the skill fades when a state is not known [s]: ticks that are
#: lost do nothing, and an arm of 1 rad/s moves by less than 3 degrees.
FADING_TIME = 0.05
#: Fastest pace of a skill's time that is fed forward: a clock that catches up goes no faster.
FASTEST_PACE = 2.0
#: Longest tick, in units of the shortest time constant of the damping: sampled and held,
#: damping is of no use at 1 and unstable at 2, and contact takes half of the margin.
LONGEST_TICK = 0.5

LONG_TICK = (
    "a tick is longer than the {:.2g} ms that the damping allows: run at {:.0f} Hz or more, or "
    "with lower TorqueGains"
)


@dataclass(frozen=True, eq=False)
class Drive:
    """Memory of the last tick; immutable.

    Parameters
    ----------
    joints : Tensor of shape (..., n_joints)
        Last known ones.
    sent : Tensor of shape (..., n_joints)
        Torque beside the bias, before limits.
    fade : Fade
        Of the difference from what the skill asked for, when robots began or went on.
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
    fade: Fade
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
    :class:`~tpgmm_control.impedance.stiffness.Impedance`, firm where demonstrations agree.

    Torques begin as those that carry the robot, and the skill fades in. Without a measured
    state, or with a tick that is too long for the damping, they fade to gravity and damping,
    with a reason in the command. They are within the limits of effort, and finite.

    Where forces are expected, robots are where they are pushed to, and so are references: no
    clock waits for one that is held back, which pulls with its stiffness to where it should be
    by then.

    Parameters
    ----------
    skill : Skill
    joints : array-like of shape (..., n_joints)
        The start postures.
    frames : mapping of str to Frame, optional
    dynamics : Dynamics
        Inertia and bias: a :class:`~tpgmm_control.torque.MujocoDynamics`, or a function.
    gains : TorqueGains, optional
    effort : array-like of shape (n_joints,), optional
        Largest torques [N m or N]; by default those of the dynamics.
    **settings
        As for :class:`~tpgmm_control.Controller`, of which ``trust`` is needed; ``blend`` is
        also how long the difference between the first torque and the skill's fades.

    Raises
    ------
    DataError, ShapeError
        If the skill has operators without rows of torques, the dynamics or limits do not fit
        the robot, or as for :class:`~tpgmm_control.Controller`.
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
        start, zero = self.reference, torch.zeros_like(self.reference)
        self._local, self._tick, self._stiffness, n = None, None, None, start.shape[-1]
        if self._skill.expected_forces(self.time):
            if not isinstance(self._skill, Regression):
                raise DataError(
                    f"torques of a {type(skill).__name__} that expects forces: there are those "
                    "of one fitted skill, model.skill; run its skills one after the other"
                )
            self._local = LocalGaussians(self._skill, gains)
            self._needs_wrench = gains.integral > 0
        effort = getattr(dynamics, "effort", math.inf) if effort is None else effort
        self._effort = torch.as_tensor(effort).to(start)
        if self._effort.shape not in ((), (n,)) or not bool((self._effort > 0).all()):
            raise DataError(f"effort has a torque above 0 for each of {n} joints: {effort!r}")
        inertia, bias = dynamics(start, zero)
        if inertia.shape != (*start.shape, n) or bias.shape != start.shape:
            raise ShapeError(
                f"dynamics give an inertia {(*start.shape, n)} and a bias {tuple(start.shape)}"
                f", got {tuple(inertia.shape)} and {tuple(bias.shape)}"
            )
        first, none = self._mechanics(self._state(start), inertia, zero), zero.sum(-1)
        self._stiffness = first.stiffness
        self._compliance = torch.linalg.inv(first.stiffness[..., :n, :n])
        self._drive = Drive(
            start, zero, Fade.start(zero, float(settings.get("blend", 1.0))), none == 0, bias,
            first.rate, none > 0, self.time + none, none,
        )  # fmt: skip

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
    ) -> Command:
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
        Command
            With a ``torque``.

        Raises
        ------
        ShapeError, UnknownNameError
            As for :meth:`Controller.step`.
        """
        speeds, given = self._numbers(velocities, "velocities"), self._numbers(joints, "joints")
        self._tick, late = None, {**(ages or {}), **self._faults(dt, given, speeds)}
        command = super().step(dt, joints, frames, holds=holds, ages=late, wrenches=wrenches)
        known = torch.full_like(speeds, torch.nan)
        if self._tick is not None and self._tick.joints is not None:
            known = self._tick.joints
            if self._gripping is not None:
                known = torch.where(self._gripping, given, known)
        self.command = self._driven(command, known, speeds)
        return self.command

    def _faults(self, dt: Any, given: Tensor, speeds: Tensor) -> dict[str, Any]:
        """Why robots are held, with infinite ages: what is missing, and ticks too long."""
        seconds = dt if isinstance(dt, float | int | Tensor) else 0.0
        late = self._drive.rate * torch.nan_to_num(torch.as_tensor(seconds).to(speeds))
        longest = LONGEST_TICK / float(self._drive.rate.max().clamp_min(1e-9))
        faults = {
            "velocities are missing or not finite: step(dt, joints, velocities=...)":
                ~speeds.isfinite().all(-1),
            "joints were not read at this step": ~given.isfinite().all(-1),
            "there was no finite torque (inertia, bias or frames)": self._drive.lost,
            LONG_TICK.format(1e3 * longest, 1 / longest): late > LONGEST_TICK,
        }  # fmt: skip
        return {
            reason: np.where(robots.numpy(force=True), np.inf, 0.0)
            for reason, robots in faults.items()
            if bool(robots.any())
        }

    def _move(self, tick: Any) -> None:
        """Where forces are expected, references are where robots are pushed to."""
        self._tick = tick
        if self._local is None:
            super()._move(tick)
            return
        wanted = self._postures(tick, measured=True)
        passed = torch.as_tensor(tick.seconds).to(wanted).unsqueeze(-1)
        velocity = (wanted - self.reference) / passed
        self._found = self._estimate(tick) if self.command is None else self.command.estimate
        self._following = replace(
            self._following, reference=wanted, wanted=wanted, velocity=velocity, lost=None
        )

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

    def _driven(self, command: Command, joints: Tensor, velocities: Tensor) -> Command:
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
        fade = last.fade.again(last.stopped & ~stopped)
        left_over, fade = fade.advance(last.sent, found.fused, dt, first=True)
        fused = found.fused if left_over is None else found.fused + left_over
        sent = torch.where(stopped.unsqueeze(-1), at_rest, fused)
        torque = (bias + sent).clamp(-self._effort, self._effort)
        free = torch.where(~stopped & (bias + sent == torque).all(-1), dt, 0.0)
        self._drive = Drive(
            joints, sent, fade, stopped, bias, rate, ~finite,
            command.time.expand_as(dt), dt, self._integrated(found, free, dt),
        )  # fmt: skip
        return replace(command, estimate=found.estimate, torque=torque)

    def _mechanics(self, state: RobotState, inertia: Tensor, velocities: Tensor) -> Mechanics:
        """Of joints and, where forces are expected, links; at first with a new stiffness."""
        jacobian = inertia[..., :0, :]
        if self._local is not None:
            jacobian = self._local.jacobian(state)
        return Mechanics.at(inertia, jacobian, velocities, self._gains, self._stiffness)

    def _torques(
        self, command: Command, joints: Tensor, velocities: Tensor, dt: Tensor
    ) -> Found:
        """Torques at a state; NaN where nothing gives one."""
        inertia, bias = self._dynamics(joints, velocities)
        try:
            state = self._state(joints)
            at = self._mechanics(state, inertia, velocities)
            found = Found(at.held, bias, at.held, at.rate, command.estimate)
            if self._local is not None:
                return self._pressed(command, state, at, dt, found)
            assert self._impedance is not None
            stiffness = command.stiffness_matrix
            damping = self._impedance.joints.damping(stiffness, inertia)
            pull = stiffness @ (command.reference - joints).unsqueeze(-1)
            fused = pull + damping @ (command.velocity - velocities).unsqueeze(-1)
            rate = torch.maximum(found.rate, fastest(at.mobility @ damping))
            return replace(found, fused=fused.squeeze(-1), rate=rate)
        except TPGMMError:
            if not bool(self._drive.dt.any()):  # the first step
                raise
        lost = torch.full_like(joints, torch.nan)
        return Found(lost, bias, lost, self._drive.rate, command.estimate)

    def _pressed(
        self, command: Command, state: RobotState, at: Mechanics, dt: Tensor, found: Found
    ) -> Found:
        """The product of all rows."""
        time, frames, last, local = command.time, self.holding.frames, self._drive, self._local
        assert local is not None
        pace = torch.where(dt > 0, (time - last.time) / dt, 0.0).clamp(0.0, FASTEST_PACE)
        rows, rates = [local.rows(time, pace, state, frames, at)], [found.rate]
        forces = list[tuple[ExpectedForce, Tensor]]()
        for one in self._skill.expected_forces(time):
            operator, integral = one.operator, last.integrals.get(one.operator, 0.0)
            axes, first = operator.directions(state, frames), local.first_row(operator.link)
            row, rate = force_row(one, axes, integral, first, at, self._gains)
            rows, rates = [*rows, row], [*rates, rate]
            forces.append((one, axes))
        fused, covariance = fused_torque(rows, at)
        step = (self._compliance @ fused.unsqueeze(-1)).squeeze(-1)
        estimate = Estimate(
            state.joints + step,
            self._compliance @ covariance @ self._compliance,
            local.skill.weights_at(time),
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
            value = left * self._drive.integrals.get(one.operator, 0.0)
            most = one.force.norm(dim=-1, keepdim=True)
            value = value + self._gains.integral * counts * error
            values[one.operator] = value.clamp(-most, most)
        return values

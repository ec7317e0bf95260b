"""Stage *avoid*: references that keep clear of obstacles, in the last step before the command.

As long as the ordinary reference keeps its distances, and can be stopped before it does not, it
is sent as it is. Elsewhere a robot is *led*: one convex problem decides where each joint would
come to rest if it braked after this tick, and so where it is then
(:mod:`~tpgmm_control.motion.braking`). The ways x to rest are those of ::

    minimise  sum over hands of |J_p x - e_p|^2 / P^2 + |J_o x - e_o|^2 / O^2
              + |x - e|^2 / Q^2 + |x - r|^2 / C^2
    such that n^T J x >= -(d - d_min) / 2,   n^T J x' >= -(d - d_min)   and   r_0 <= x <= r_1,

where e are the ways to where the ordinary reference would come to rest, r are those by which
the sent one stays as far from it as it is, x' is the way of this tick, which x decides (B1),
and distances d and their derivatives n^T J are those at the last reference. Half of the room is
for braking, as nearest points jump from edge to edge. Rows give way, as little as can be, only
where nothing else is possible.

The skill knows nothing of it: the ordinary reference goes on beside the one that is sent, and a
led robot joins it as soon as the bounds of motion let it. Nothing plans: a robot that cannot go
on stays, and time waits for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import daqp
import numpy as np
import torch
from torch import Tensor

from tpgmm_control.motion.braking import Braking, rest
from tpgmm_control.motion.follower import Follower, Mask
from tpgmm_control.obstacles.distances import Near, Placed
from tpgmm_control.obstacles.scene import Scene
from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.robots.kinematics import RobotState

#: How exactly hands are led [m, rad], and joints, which are free to give way.
HAND, TURN, JOINT = 0.005, 0.05, 0.5
#: How much joints change their way around in a tick [rad or m]: less where the ordinary
#: reference is slower than this [rad/s or m/s], so that a robot that is blocked stands.
CALM, STANDING, SLOW = 0.05, 0.01, 1e-3
#: Share of the room to an obstacle that is used up before a robot could stand still.
SHARE = 0.5
#: Speed at which a robot leaves what it is too near to [m/s].
LEAVING = 0.1
#: The ordinary reference is ahead of a hand by this at most: a hand and what it goes around
#: have passed each other by then [m].
LEAD = 0.2
#: From the wrist to the tips of fingers, which a turn moves [m].
FINGERS = 0.1
#: Hands that are nearer to where they should be are there, when something is taken or put [m].
THERE = 0.01
#: How much a robot is held up that is blocked: its time runs half as fast at most.
BLOCKED = 0.75
#: Distances are kept up to this [m].
ROUNDING = 1e-6
#: The solver's words: rows that may give way, and a solution that was found.
SOFT, FOUND = 8, 1
#: No bound, and a row that is none.
ENDLESS, NOTHING = 1e30, 1e-9


@dataclass(frozen=True, eq=False)
class Avoidance:
    """References that are sent among obstacles, beside the ordinary ones; immutable.

    Parameters
    ----------
    scene : Scene
    led : ndarray of bool, of shape (B,)
        Robots whose references are not the ordinary ones.
    lead : ndarray of shape (B,)
        How far the ordinary reference is ahead of a hand of theirs [m].
    pairs : tuple of str, of length B
        What was in the way last, "l_forearm / table".
    sent : Follower, optional
        The references of all robots; None while they are the ordinary ones.
    """

    scene: Scene
    led: Mask
    lead: Array
    pairs: tuple[str, ...]
    sent: Follower | None = None

    @classmethod
    def start(
        cls, scene: Scene, kinematics: Any, bounds: MotionBounds | None, batch: int
    ) -> Self:
        """Before ``batch`` robots of a skill move.

        Parameters
        ----------
        scene : Scene
        kinematics : Kinematics
            Of the skill.
        bounds : MotionBounds, optional
        batch : int

        Raises
        ------
        DataError
            If the scene is of another robot, or there are no bounds.
        """
        if scene.robot.joint_names != tuple(kinematics.joint_names):
            raise DataError(
                f"the obstacles are around a robot with the joints {scene.robot.joint_names}, "
                f"the skill is of {kinematics.joint_names}: Scene(skill.kinematics, ...)"
            )
        if bounds is None:
            raise DataError("obstacles need bounds of motion, to stop in time: bounds='robot'")
        return cls(scene, np.zeros(batch, bool), np.zeros(batch), ("",) * batch)

    def obstruction(self, time: Array, soon: Array, stops: Sequence[float]) -> Array:
        """How much obstacles hold robots up (B,): 0 not at all, from 1 on time stands.

        Parameters
        ----------
        time, soon : ndarray of shape (B,)
            In the skill, now and after this tick [s].
        stops : sequence of float
            Times that are not passed before hands are where they should be [s].
        """
        ahead = np.array([*stops, np.inf])
        due = soon >= ahead[ahead.searchsorted(time, "right")]
        waits = self.led & due & (self.lead > THERE)
        return np.where(waits, 1.0, np.where(self.led, self.lead / LEAD, 0.0))

    def reasons(self, obstruction: Array) -> dict[int, tuple[bool, str]]:
        """Of robots that are not where they should be: whether time waits, and why.

        Parameters
        ----------
        obstruction : ndarray of shape (B,)
            As of :meth:`obstruction` at this tick.
        """
        found = {}
        for row in np.flatnonzero(self.led & (self.lead > THERE)).tolist():
            waits, pair = bool(obstruction[row] >= BLOCKED), self.pairs[row]
            kept = f"kept {1e3 * self.lead[row]:.0f} mm off by {pair}"
            found[row] = waits, f"blocked by {pair}" if waits else kept
        return found

    def advance(
        self, last: Follower, ordinary: Follower, state: RobotState | None,
        frames: Mapping[str, Frame], halted: Mask, late: Mask,
    ) -> Self:  # fmt: skip
        """The references that are sent after a tick.

        Parameters
        ----------
        last, ordinary : Follower
            Without obstacles, before and after the tick.
        state : RobotState, optional
            Of the last references, with the objects that robots hold.
        frames : mapping of str to Frame
            Poses of the objects.
        halted, late : ndarray of bool, of shape (B,)
            Robots that come to rest, and robots for which no time has passed.
        """
        before, shape = self.sent or last, ordinary.reference.shape
        tick = _Tick.of(self.scene, before, last, ordinary, state, frames)
        after, joins = self._joined(before, ordinary)
        ways = np.stack((after.moment.motion[0], rest(after))).reshape(2, *tick.here.shape)
        moved = np.abs(ways - tick.here).max(0)
        if self.led.any():  # they are led again, most often
            moved = np.maximum(moved, np.where(self.led[:, None], tick.reach, 0.0))
        near, rows = tick.near(moved)
        kept = np.einsum("nj,knj->kn", rows, (ways - tick.here)[:, near.robot])
        bad = self.led & ~joins
        bad[near.robot[(kept < tick.least(near) - ROUNDING).any(0)]] = True
        bad &= ~(halted | late)
        if not (bad | self.led).any():
            return self
        pairs = list(self.pairs)
        if bad.any():
            if (bad & ~self.led).any():
                near, rows = tick.near(np.where(bad[:, None], tick.reach, -1.0))
            motion = after.moment.motion.copy()
            motion.reshape(3, *tick.here.shape)[:, bad] = tick.solved(bad, near, rows, pairs)
            after = after.redirected(before, motion, bad.reshape(shape[:-1]))
        after = _still(after, before, halted & self.led, late)
        apart = (after.moment.motion != ordinary.moment.motion).any(0).any(-1).reshape(-1)
        led = (self.led | bad) & apart
        lead = np.zeros(len(led))
        if led.any():
            one, other = (x.reference.reshape(tick.here.shape) for x in (after, ordinary))
            lead[led] = [_lead(error) for _, error in tick.hands(one, other, led)]
        sent = after if led.any() else None
        return replace(self, led=led, lead=lead, pairs=tuple(pairs), sent=sent)

    def _joined(self, before: Follower, ordinary: Follower) -> tuple[Follower, Mask]:
        """The ordinary reference, of led robots too; and which of these can be there."""
        if not self.led.any():
            return ordinary, self.led
        where = self.led.reshape(ordinary.reference.shape[:-1])
        exact = before.moment.taken(ordinary.moment.motion[0], ordinary.moment.dt)
        joins = before.moment.allows(exact, before.bounds).all(-1).reshape(-1)
        moment = exact.choose(where[..., None], ordinary.moment)
        return replace(ordinary, moment=moment), joins


def _still(after: Follower, before: Follower, halted: Mask, late: Mask) -> Follower:
    """The follower after a tick, in which some robots brake, and others are as they were."""
    for robots, instead in ((halted, None), (late, before)):
        if robots.any():
            where = torch.from_numpy(robots.reshape(after.reference.shape[:-1]))
            after = after.undone(where, instead or before.braked(after))
    return after


@dataclass(frozen=True, eq=False)
class _Tick:
    """One tick of B robots.

    Parameters
    ----------
    scene : Scene
    before, last, ordinary : Follower
        What was sent last, and what would be sent without obstacles, last and now.
    here : ndarray of shape (B, n_joints)
        The last references.
    placed : Placed
        Solids there.
    """

    scene: Scene
    before: Follower
    last: Follower
    ordinary: Follower
    here: Array
    placed: Placed

    @classmethod
    def of(
        cls, scene: Scene, before: Follower, last: Follower, ordinary: Follower,
        state: RobotState | None, frames: Mapping[str, Frame],
    ) -> Self:  # fmt: skip
        postures = before.reference.detach().reshape(-1, before.reference.shape[-1])
        objects = scene.objects(state, frames, len(postures))
        placed = scene.geometry.place(postures, objects)
        here = as_array(postures).astype(np.float64)
        return cls(scene, before, last, ordinary, here, placed)

    def near(self, moved: Array) -> tuple[Near, Array]:
        """Pairs that could come too near where joints move by so much (B, n_joints), and rows.

        Robots of which that is negative are left out.
        """
        geometry = self.scene.geometry
        reach = geometry.reach(self.placed, np.maximum(moved, 0.0))
        one, other = geometry.carrier[geometry.pairs.T]
        within = reach[:, one] + reach[:, other] + self.scene.needed
        near = geometry.near(self.placed, np.where(moved[:, :1] < 0, -np.inf, within))
        rows = geometry.rows(self.placed, near)
        keep = np.abs(rows).max(1, initial=0.0) > NOTHING
        return Near(*(part[keep] for part in near)), rows[keep]

    def least(self, near: Near) -> Array:
        """How much distances have to grow (2, N): until the next tick, and until rest."""
        room = near.distance - self.scene.needed[near.pair]
        dt = np.broadcast_to(np.ravel(self.ordinary.moment.dt), len(self.here))[near.robot]
        leaving = np.minimum(-room, LEAVING * dt)
        return np.stack((-np.maximum(room, 0.0), np.where(room < 0, leaving, -SHARE * room)))

    @cached_property
    def braking(self) -> Braking:
        """Where the robots can be after the tick."""
        return Braking.of(self.before, self.ordinary)

    @property
    def reach(self) -> Array:
        """How far joints can get at most (B, n_joints)."""
        return np.abs(self.braking.rests.reshape(3, *self.here.shape) - self.here).max(0)

    def solved(self, robots: Mask, near: Near, rows: Array, pairs: list[str]) -> Array:
        """Motions (3, N, n_joints) of N robots; what is in their way goes into the pairs."""
        shape, here, braking = self.here.shape, self.here, self.braking
        low, stop, high = braking.rests.reshape(3, *shape) - here
        first, braked, second = braking.states[:, 0].reshape(3, *shape) - here
        wide = high - low
        slope = np.where(wide > 0, (second - first) / np.where(wide > 0, wide, 1.0), 0.0)
        least, goal = self.least(near), rest(self.ordinary).reshape(shape)
        as_far = stop + goal - rest(self.last).reshape(shape)
        speed = np.abs(self.ordinary.moment.motion[1].reshape(shape)).max(1)
        calm = np.where(speed < SLOW, STANDING, CALM) ** -2
        ends, chosen = (torch.from_numpy(here), torch.from_numpy(goal)), here.copy()
        for row, (jacobian, error) in zip(
            np.flatnonzero(robots).tolist(), self.hands(*ends, robots), strict=True
        ):
            own = near.robot == row
            own &= np.minimum(rows * low[row], rows * high[row]).sum(1) < least.max(0)
            # the way of this tick is about linear in the way to rest, and exact where it brakes
            start = rows[own] @ (braked[row] - slope[row] * stop[row])
            posture = (goal[row] - here[row]) / JOINT**2 + as_far[row] * calm[row]
            way, weights = _nearest(
                jacobian.T @ jacobian + np.eye(shape[1]) * (1 / JOINT**2 + calm[row]),
                jacobian.T @ error + posture,
                np.concatenate((rows[own] * slope[row], rows[own])),
                np.concatenate((least[0, own] - start, least[1, own])),
                (low[row], high[row]),
            )
            chosen[row] += way
            if weights.any():
                at = near.pair[own][int(weights.reshape(2, -1).max(0).argmax())]
                pairs[row] = self.scene.label(int(at))
        motion = braking.state(chosen.reshape(braking.rests.shape[1:]))
        return motion.reshape(3, *shape)[:, robots]

    def hands(
        self, postures: Tensor, ends: Tensor, robots: Mask
    ) -> Iterator[tuple[Array, Array]]:
        """Jacobian of the hands of some robots, and their ways to the ends, in units."""
        where = torch.from_numpy(robots)
        with torch.inference_mode():
            state = self.scene.robot.state(torch.stack((postures[where], ends[where])))
            back = quaternions.conjugate(state.orientations[0])
            turns = quaternions.log(quaternions.product(state.orientations[1], back))
            unit = turns.new_tensor([HAND] * 3 + [TURN] * 3)
            error = torch.cat((state.positions.diff(dim=0)[0], turns), -1) / unit
            jacobians = state.jacobians[0] / unit[:, None]
        each = jacobians.flatten(1, 2).double(), error.flatten(1).double()
        return zip(*(x.numpy(force=True) for x in each), strict=True)


def _lead(error: Array) -> float:
    """The longest way of a hand in an error, where a turn moves the tips of fingers."""
    ways = np.linalg.norm(error.reshape(-1, 2, 3), axis=-1) * (HAND, TURN * FINGERS)
    return float(ways.max())


def _nearest(
    precision: Array, vector: Array, rows: Array, least: Array, box: tuple[Array, Array]
) -> tuple[Array, Array]:
    """The minimum of ``x^T precision x / 2 - vector^T x`` in a box with ``rows x >= least``.

    Where there is none, rows give way. Returns the multipliers of the rows as well.
    """
    unit = 1 / np.sqrt(np.diag(precision))
    scaled = rows * unit
    size = np.maximum(np.linalg.norm(scaled, axis=1), NOTHING)
    n, count = len(unit), len(rows)
    problem = (
        precision * unit * unit[:, None],
        -vector * unit,
        np.ascontiguousarray(scaled / size[:, None]),
        np.concatenate((box[1] / unit, np.full(count, ENDLESS))),
        np.concatenate((box[0] / unit, least / size)),
    )
    for sense in (0, SOFT):
        kinds = np.concatenate((np.zeros(n), np.full(count, sense))).astype(np.int32)
        x, _, flag, info = daqp.solve(*problem, kinds, primal_tol=1e-9)
        if flag >= FOUND:
            return np.clip(x * unit, *box), np.abs(info["lam"][n:])
    return np.clip(0.0, *box), np.zeros(count)

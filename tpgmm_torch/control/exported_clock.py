"""Clocks of one robot for a graph: the formulas of :mod:`.clocks`, tensors in, tensors out.

What a clock remembers is one vector, and what :mod:`.clocks` asks of the robots of a batch by
masks is asked of one by ``where``. Robots that are told to have been pushed are the
controller's, which looks for them only with ``trust``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from tpgmm_torch.control.clocks import (
    ELSEWHERE,
    EVIDENCE,
    GRACE,
    HURRY,
    JUMP,
    NOTHING,
    PATIENCE,
    PAUSE,
    RESTART,
    RETURNING,
    STILL,
    WIDTH,
    Clock,
    EvenClock,
    LocalizingClock,
    WaitingClock,
)
from tpgmm_torch.control.localization import MODE, SPREAD, Localizer
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators import Operator
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import RobotState

__all__ = ["ExportedClock", "exported_clock"]

Memory = dict[str, Tensor]
#: Numbers before the belief, of what a look finds.
FOUND = 4
#: ``seen(joints, poses)``: the robot's state, and the objects.
Seen = Callable[[Tensor, Tensor], tuple[RobotState, dict[str, Frame]]]
#: ``estimated(time, joints, poses)``: the model's mean and covariance.
Estimated = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


class ExportedClock(torch.nn.Module):
    """``forward(memory, now, dt, reference, measured, covariance, poses)``.

    It gives the time, what is remembered, and whether time has moved elsewhere; this one runs
    evenly, as :class:`EvenClock`.

    Parameters
    ----------
    clock : EvenClock or WaitingClock
    n_joints : int
    begin, end : float
        Of the skill [s].

    Attributes
    ----------
    shapes : dict of str to tuple of int
        What is remembered, in order.
    """

    def __init__(
        self, clock: EvenClock | WaitingClock, n_joints: int, begin: float, end: float
    ) -> None:
        super().__init__()
        self._speed, self._begin, self._end = clock.speed, begin, end
        self.shapes: dict[str, tuple[int, ...]] = {}

    @property
    def size(self) -> int:
        """How many numbers are remembered."""
        return sum(_count(shape) for shape in self.shapes.values())

    def start(self, measured: Tensor) -> Tensor:
        """What is remembered (size,) of a robot that stands at joints (n,) at the beginning."""
        return self._packed(self._first(measured))

    def forward(
        self,
        memory: Tensor,
        now: Tensor,
        dt: Tensor,
        reference: Tensor,
        measured: Tensor,
        covariance: Tensor,
        poses: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See the class; of shapes (size,), (), (), (n,), (n,), (n, n) and (F, 7)."""
        known = self._unpacked(memory)
        deviation = covariance.diagonal().sqrt()
        time, new, moved = self._advanced(known, now, dt, reference, measured, deviation, poses)
        return time, self._packed(new), moved

    def trace(self, n_frames: int) -> None:
        """Prepare what a graph computes only when it is needed, before it is made."""

    def _first(self, measured: Tensor) -> Memory:
        return {}

    def _advanced(
        self,
        known: Memory,
        now: Tensor,
        dt: Tensor,
        reference: Tensor,
        measured: Tensor,
        deviation: Tensor,
        poses: Tensor,
    ) -> tuple[Tensor, Memory, Tensor]:
        return self._until(now, self._speed * dt), {}, torch.zeros_like(now, dtype=torch.bool)

    def _until(self, now: Tensor, step: Tensor) -> Tensor:
        time = now + step
        return torch.where(time > self._end - 1e-6 * step, self._end, time)

    def _unpacked(self, memory: Tensor) -> Memory:
        parts = memory.split([_count(shape) for shape in self.shapes.values()])
        return {
            name: part.view(shape)
            for part, (name, shape) in zip(parts, self.shapes.items(), strict=True)
        }

    def _packed(self, parts: Memory) -> Tensor:
        flat = [parts[name].double().reshape(-1) for name in self.shapes]
        return torch.cat(flat) if flat else torch.empty(0, dtype=torch.float64)


class _Waiting(ExportedClock):
    """:class:`WaitingClock`."""

    def __init__(self, clock: WaitingClock, n_joints: int, begin: float, end: float) -> None:
        super().__init__(clock, n_joints, begin, end)
        self._clock = clock
        self._stops = torch.tensor([*clock.arrivals, torch.inf], dtype=torch.float64)
        self.shapes = {"rate": (), "expected": (n_joints,)}

    def _first(self, measured: Tensor) -> Memory:
        return {"rate": measured.new_ones(()), "expected": measured}

    def _advanced(
        self,
        known: Memory,
        now: Tensor,
        dt: Tensor,
        reference: Tensor,
        measured: Tensor,
        deviation: Tensor,
        poses: Tensor,
    ) -> tuple[Tensor, Memory, Tensor]:
        time, new, _ = self._waited(known, now, dt, reference, measured, deviation)
        return time, new, torch.zeros_like(now, dtype=torch.bool)

    def _waited(
        self,
        known: Memory,
        now: Tensor,
        dt: Tensor,
        reference: Tensor,
        measured: Tensor,
        deviation: Tensor,
    ) -> tuple[Tensor, Memory, Tensor]:
        """Time, rate and where a servo would be, and the error."""
        clock = self._clock
        expected = reference + torch.exp(-dt / clock.lag) * (known["expected"] - reference)
        away = (measured - reference).abs()
        usual = (reference - expected).abs() + clock.floor
        error = (away / usual).amax()
        excess = (away / (usual + deviation)).amax() / clock.tolerance - 1
        excess = excess.clamp(0, 1)
        follows = self._rate(1 - excess**2 * (3 - 2 * excess), known, now)
        rate = torch.where(error > clock.tolerance, follows, 1.0)
        rate = torch.minimum(rate, known["rate"] + dt / RESTART)
        time = self._until(now, clock.speed * dt * rate)
        if clock.arrivals:
            stop = torch.where(self._stops >= now, self._stops, torch.inf).amin()
            late = away.amax() > clock.floor
            time = torch.where(late, torch.minimum(time, stop), time)
        return time, {"rate": rate, "expected": expected}, error

    def _rate(self, following: Tensor, known: Memory, now: Tensor) -> Tensor:
        return following


class _Look(torch.nn.Module):
    """A function as a module."""

    def __init__(self, look: Callable[..., Tensor]) -> None:
        super().__init__()
        self._look = look

    def forward(self, *given: Tensor) -> Tensor:
        return self._look(*given)


class _Localizing(_Waiting):
    """:class:`LocalizingClock`, from the beginning."""

    def __init__(
        self,
        clock: LocalizingClock,
        regression: Regression,
        names: Sequence[str],
        begin: float,
        end: float,
        seen: Seen,
        estimated: Estimated,
    ) -> None:
        kinematics = regression.kinematics
        n = kinematics.n_joints
        super().__init__(clock, n, begin, end)
        self._seen, self._estimated = seen, estimated
        gripping = kinematics.gripping()
        arms = torch.ones(n, dtype=torch.bool) if gripping is None else ~gripping
        self._arms = arms.nonzero().squeeze(-1)
        self._look: torch.nn.Module | None = None
        localizer = Localizer(regression, begin, end)
        self._instants, self._step = torch.from_numpy(localizer.instants), localizer.step
        at = localizer.at(frozenset((*names, *kinematics.links)))
        self._heaviest = torch.from_numpy(at.heaviest)
        elapsed = torch.from_numpy(at.elapsed)
        curvature = torch.from_numpy(at.curvature)[self._heaviest]
        constant = torch.from_numpy(at.constant)[self._heaviest]
        self._elapsed = elapsed
        self._base = torch.from_numpy(at.log_h) + constant - 0.5 * elapsed**2 * curvature
        self._parts: list[tuple[Operator, Tensor, Tensor, Tensor, Tensor]] = [
            (
                operator,
                torch.from_numpy(part.mean),
                torch.from_numpy(part.white),
                torch.from_numpy(part.rate),
                torch.from_numpy(part.blocks),
            )
            for operator, part in at.parts
        ]
        scalars = "since", "before", "reached", "strayed", "localized", "lost", "place", "sure"
        self.shapes |= dict.fromkeys((*scalars, "rested", "stalled", "returned"), ())
        self.shapes |= dict.fromkeys(("stood", "rest", "told"), (n,))
        self.shapes["weights"] = (len(self._instants),)

    def _first(self, measured: Tensor) -> Memory:
        zero = measured.new_zeros(())
        begins = zero + self._begin
        return {
            **dict.fromkeys(self.shapes, zero),
            **super()._first(measured),
            **dict.fromkeys(("before", "reached", "place", "rested"), begins),
            **dict.fromkeys(("stood", "rest", "told"), measured),
            "returned": zero - torch.inf,
            "weights": torch.zeros_like(self._instants),
        }

    def _rate(self, following: Tensor, known: Memory, now: Tensor) -> Tensor:
        ahead = known["place"] - now
        behind = torch.clamp(2 + ahead / GRACE, 0, 1)
        hurry = torch.clamp(2 * ahead / GRACE, 0, HURRY)
        rate = torch.maximum(torch.minimum(following, behind), hurry)
        found = (known["localized"] > 0) & ~(known["lost"] > 0)
        return torch.where(found, rate, following)

    def _advanced(
        self,
        known: Memory,
        now: Tensor,
        dt: Tensor,
        reference: Tensor,
        measured: Tensor,
        deviation: Tensor,
        poses: Tensor,
    ) -> tuple[Tensor, Memory, Tensor]:
        clock, start = self._clock, now
        now, new, error = self._waited(known, now, dt, reference, measured, deviation)
        stalled, localized = known["stalled"] > 0, known["localized"] > 0
        now = torch.where(stalled, start, now)
        new["rate"] = torch.where(stalled, 0.0, new["rate"])
        astray = error > clock.tolerance
        since = known["since"] + dt
        due = since > (1 - 1e-6) * self._step
        left = (measured - known["rest"]).abs()[self._arms].amax() > STILL
        late = now > known["rested"] + PAUSE
        told = (reference - known["told"]).abs().amax()
        stopped = late & (told > clock.tolerance * clock.floor)
        back = late & left & stalled & (astray | localized)
        back = back & ((known["rested"] - known["returned"]).abs() > JUMP)
        new |= {
            "since": torch.where(due, 0.0, since),
            "before": torch.where(due | ~astray, now, known["before"]),
            "reached": torch.where(astray, known["reached"], now),
            "stood": torch.where(astray, known["stood"], measured),
            "strayed": torch.where(due, error, known["strayed"]),
            "localized": (localized & astray).to(now),
            "lost": known["lost"],
            "place": known["place"],
            "sure": torch.where(astray, known["sure"], 0.0),
            "rest": torch.where(left, measured, known["rest"]),
            "rested": torch.where(left, now, known["rested"]),
            "told": torch.where(left, reference, known["told"]),
            "stalled": ((stalled | stopped) & astray & ~left).to(now),
            "returned": torch.where(back, known["rested"], known["returned"]),
            "weights": known["weights"],
        }
        looks = due & astray & ~back
        given = self._packed(known), now, since, error, measured, poses
        if self._look is None:
            found = self.look(*given)
        else:
            found = torch.cond(looks, self._look, self._unseen, given)
        (place, sure, lost, moves), weights = found[:FOUND].unbind(), found[FOUND:]
        for name, value in (
            ("place", place),
            ("sure", sure),
            ("lost", lost),
            ("localized", torch.ones_like(now)),
            ("weights", weights),
        ):
            new[name] = torch.where(looks, value, new[name])
        new["localized"] = torch.where(back, 0.0, new["localized"])
        # moved elsewhere, from where it stands on
        moved = back | (looks & (moves > 0))
        to = torch.where(back, known["rested"], new["place"])
        for names, value in (
            (("before", "reached", "place", "rested"), to),
            (("stood", "expected", "rest", "told"), measured),
            (("rate", "sure"), torch.zeros_like(now)),
        ):
            new |= {name: torch.where(moved, value, new[name]) for name in names}
        return torch.where(moved, to, now), new, moved

    def trace(self, n_frames: int) -> None:
        """The look, which most ticks do without, as a graph by itself."""
        (n,), double = self.shapes["rest"], torch.float64
        scalar = torch.zeros((), dtype=double)
        given = (
            torch.zeros(self.size, dtype=double),
            *(scalar.clone() for _ in range(3)),
            torch.zeros(n, dtype=double),
            torch.zeros(n_frames, 7, dtype=double),
        )
        program = torch.export.export(_Look(self.look), given, strict=False)
        for name, constant in program.constants.items():
            program.constants[name] = constant.clone()  # which may not share their memory
        module = program.module()  # without its hooks, which PyTorch 2.7 does not trace
        self._look = torch.fx.GraphModule(module, module.graph)

    def look(
        self,
        memory: Tensor,
        now: Tensor,
        since: Tensor,
        error: Tensor,
        measured: Tensor,
        poses: Tensor,
    ) -> Tensor:
        """Place, for how long it is another one, lost, whether time moves there, and belief.

        Of a robot that does not follow; the vector's numbers are ``FOUND``, then the instants'.
        """
        known = self._unpacked(memory)
        clock, localized = self._clock, known["localized"] > 0
        shift = (now - known["before"]).clamp(min=0.0) / self._step
        belief = self._moved(known["weights"], shift, SPREAD * since / self._step**2)
        belief = torch.where(localized, belief, self._near(known["before"]))
        lost = localized & (known["lost"] > 0)
        belief = torch.where(lost, 0.9 * belief + 0.1 * self._anywhere(now), belief)
        log_belief = belief.log() + EVIDENCE * since * self._log_likelihood(measured, poses)
        log_belief = log_belief - log_belief.amax()
        belief = _normalized(torch.where(log_belief > NOTHING, log_belief.exp(), 0.0))
        highest = self._instants.index_select(0, belief.argmax()[None])
        inside = torch.where((self._instants - highest).abs() <= MODE, belief, 0.0)
        place = inside @ self._instants / inside.sum()
        mean, covariance = self._estimated(place, measured, poses)
        usual = clock.floor + covariance.diagonal().sqrt()
        explained = ((mean - measured).abs() / usual).amax() <= clock.tolerance
        place = torch.clamp(place + clock.lag * clock.speed, self._begin, self._end)
        reached, sure = known["reached"], known["sure"]
        left = (measured - known["stood"]).abs().amax() > 2 * clock.tolerance * clock.floor
        place = torch.where(left, place, torch.minimum(place, reached))
        slow = (place > reached - JUMP) & (place < now + JUMP)
        elsewhere = explained & left & ~slow & (error > 2 * clock.tolerance)
        returns = localized & (sure == 0) & (error < RETURNING * known["strayed"])
        elsewhere = elsewhere & ~returns
        surer = torch.where(elsewhere, sure + since, 0.0)
        moves = elsewhere & (sure > 0) & (surer > PATIENCE)
        found = torch.stack((place, surer, (~explained).to(now), moves.to(now)))
        return torch.cat((found, belief))

    def _unseen(self, memory: Tensor, *given: Tensor) -> Tensor:
        """What stands for :meth:`look` where nobody reads it."""
        return memory.new_zeros(FOUND + len(self._instants))

    def _log_likelihood(self, joints: Tensor, poses: Tensor) -> Tensor:
        """Of all instants (G,), up to a constant; see :mod:`.localization`."""
        state, frames = self._seen(joints, poses)
        square = slope = self._base.new_zeros(())
        for operator, mean, white, rate, blocks in self._parts:
            local = operator.coordinates(state, frames).double().view(1, -1)
            if len(blocks):
                flips = ((local * mean) @ blocks.mT < 0).to(local)
                local = local * (1 - 2 * flips @ blocks)
            residual = (white @ (local - mean).unsqueeze(-1)).squeeze(-1)
            square, slope = (
                square + residual.square().sum(-1),
                slope + (rate * residual).sum(-1),
            )
        exponent = self._base - 0.5 * square[self._heaviest]
        total = torch.logsumexp(exponent + self._elapsed * slope[self._heaviest], -1)
        return torch.where(total.isfinite().all(), total, 0.0)

    def _moved(self, belief: Tensor, shift: Tensor, spread: Tensor) -> Tensor:
        """:func:`.localization.move`."""
        aside, last = spread.clamp(max=0.5) / 2, len(belief) - 1
        first = shift.floor()
        places = torch.arange(len(belief)) + first.long()
        moved = torch.zeros_like(belief)
        for offset in range(-1, 3):
            apart = first + offset - shift
            kernel = sum(
                share * (1 - (apart - side).abs()).clamp(min=0.0)
                for side, share in ((-1, aside), (0, 1 - 2 * aside), (1, aside))
            )
            moved = moved.index_add(0, (places + offset).clamp(0, last), kernel * belief)
        return moved

    def _near(self, now: Tensor) -> Tensor:
        lag = self._clock.lag * self._clock.speed
        apart = (self._instants - (now - lag).clamp(min=self._begin)) / WIDTH
        return _normalized(torch.where(apart.abs() < 3, torch.exp(-0.5 * apart**2), 0.0))

    def _anywhere(self, now: Tensor) -> Tensor:
        apart = self._instants - now
        return _normalized(torch.exp(-torch.maximum(2 * apart, -apart) / ELSEWHERE) + 0.01)


def exported_clock(
    clock: Clock,
    regression: Regression,
    names: Sequence[str],
    begin: float,
    end: float,
    seen: Seen,
    estimated: Estimated,
) -> ExportedClock:
    """The clock for a graph.

    Parameters
    ----------
    clock : Clock
    regression : Regression
        The skill.
    names : sequence of str
        Its frames.
    begin, end : float
        When it begins and ends [s].
    seen : callable
        ``seen(joints, poses)`` gives the robot's state and the frames, as a batch of one.
    estimated : callable
        ``estimated(time, joints, poses)`` gives the model's mean (n,) and covariance (n, n).

    Raises
    ------
    DataError
        If the clock is of another kind than those of the library, or does not start at the
        beginning.
    """
    n_joints = regression.kinematics.n_joints
    if type(clock) is EvenClock:
        return ExportedClock(clock, n_joints, begin, end)
    if type(clock) is WaitingClock:
        return _Waiting(clock, n_joints, begin, end)
    if type(clock) is LocalizingClock and clock.initial == "beginning":
        return _Localizing(clock, regression, names, begin, end, seen, estimated)
    raise DataError(
        "export() serves EvenClock, WaitingClock, and LocalizingClock that starts at the "
        f"beginning, got {clock!r}: run other clocks with controller()"
    )


def _count(shape: tuple[int, ...]) -> int:
    return shape[0] if shape else 1


def _normalized(belief: Tensor) -> Tensor:
    return belief / belief.sum()

"""A model of each joint's servo: how late it is, and how far its readings are off.

Seen from the controller a joint is a servo of unknown lag, read with an unknown offset (sag,
payload, an encoder that slipped):

    x_k = (1 + p lag_k / 2)^-2 r          for a bank of lags, exact over ticks of any length
    y   = x_k + b + g_k                   b: offset, a random walk

r is the reference that was sent, p the derivative over time, y the reading, and g_k the gap
that a lag and the offset leave. A gap is judged against the readings' noise, what is not known
of the offset, and a share of the servo's own gap, whatever the rate of the loop. Of the lags
that are possible each may explain it: a joint does not follow if none does. The
shortest one bounds how far the reference may lead.

A robot that does not follow must not be explained by a long lag or by an offset: lags are
learned while gaps are usual and the joint moves, offsets while gaps are usual.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.data.arrays import Array

Flags = NDArray[np.bool_]
#: Lags of position servos, from stiff industrial drives to soft hobby servos [s].
LAGS = np.geomspace(0.01, 0.64, 7)[:, None]
#: A gap that means nothing: friction, backlash, compliance [rad or m].
FLOOR = 0.02
#: Share of the servo's own gap by which the model of its lag may be wrong.
MODEL_ERROR = 0.3
#: Standard deviations of an offset beforehand, and of what servos do beside it all [rad or m].
OFFSET_STD, SERVO_STD = 0.05, FLOOR / 2
#: Time in which offsets drift, and after which motion counts no longer [s].
DRIFT, WASH_OUT = 2.0, 1.0
#: Time in which readings show that a joint stands [s].
STANDSTILL = 0.1
#: Share of the likeliest lag's probability from which on a lag is possible.
POSSIBLE = 0.1


@dataclass(frozen=True, eq=False)
class LagBank:
    """Simulated servos of each lag, and how likely each lag is.

    Parameters
    ----------
    first, second : array of shape (K, n_joints)
        Positions of servos of first and of second order [rad or m].
    slow : array of shape (K, n_joints)
        Low pass of ``second``: motion is what is beside it.
    score : array of shape (K, n_joints)
        Logarithm of the likelihood of the lags, up to a constant.
    weight : array of shape (K, n_joints)
        Posterior of the lags.
    """

    first: Array
    second: Array
    slow: Array
    score: Array
    weight: Array

    @classmethod
    def start(cls, posture: Array, score: Array) -> Self:
        """Begin at rest in a posture (n_joints,)."""
        bank = np.broadcast_to(posture, score.shape)
        return cls(bank, bank, bank, score, _compute_weight(score))

    def advance(self, reference: Array, dt: float) -> Self:
        """Let the servos run towards a reference (n_joints,) for a time [s]."""
        moved = 2 * dt / LAGS
        left, behind = np.exp(-moved), self.first - reference
        second = reference + left * (self.second - reference + moved * behind)
        slow = self.slow + (1 - np.exp(-dt / WASH_OUT)) * (second - self.slow)
        return replace(self, first=reference + left * behind, second=second, slow=slow)


@dataclass(frozen=True, eq=False)
class Readings:
    """Measurements of the joints.

    Parameters
    ----------
    last : array of shape (3, n_joints)
        The last ones [rad or m].
    median : array of shape (n_joints,)
        Their median: without single outliers.
    slow, near : array of shape (n_joints,)
        Low passes, a long one beside which there is motion, and a short one: a joint that is
        there stands.
    noise : array of shape (n_joints,)
        Variance.
    """

    last: Array
    median: Array
    slow: Array
    near: Array
    noise: Array

    @property
    def resting(self) -> Array:
        """Readings of joints that stand, averaged; of those that move, as they are."""
        stands = np.abs(self.median - self.near) <= 3 * np.sqrt(self.noise)
        return np.where(stands, self.near, self.median)

    def advance(self, reading: Array, dt: float, noise: Array) -> Self:
        """Take in a reading (n_joints,), a time [s] after the last."""
        last = np.concatenate((self.last[1:], reading[None]))
        wash, soon = 1 - np.exp(-dt / WASH_OUT), 1 - np.exp(-dt / STANDSTILL)
        slow = self.slow + wash * (reading - self.slow)
        near = self.near + soon * (reading - self.near)
        return type(self)(last, _take_median(last), slow, near, noise)

    def jump(self, reading: Array, shift: Array) -> Self:
        """Begin again at a reading (n_joints,); the way there (n_joints,) is no motion."""
        last = np.broadcast_to(reading, self.last.shape)
        return replace(self, last=last, slow=self.slow + shift, near=self.near + shift)


@dataclass(frozen=True, eq=False)
class Offset:
    """Sag, payload, slipped encoders: what readings exceed positions by.

    Parameters
    ----------
    mean, variance : array of shape (n_joints,)
        Estimate [rad or m], and its variance.
    """

    mean: Array
    variance: Array


@dataclass(frozen=True, eq=False)
class Gaps:
    """What lags and the offset do not explain.

    Parameters
    ----------
    last : array of shape (3, K, n_joints), optional
        The last readings less the positions of the bank; None before the first reading.
    each : array of shape (K, n_joints)
        The gap beside each lag, smoothed over half a lag [rad or m].
    mean : array of shape (n_joints,)
        Their mean.
    """

    last: Array | None
    each: Array
    mean: Array

    def less(self, step: Array) -> Self:
        """Return the gaps without a part (n_joints,) that is explained."""
        return replace(self, each=self.each - step, mean=self.mean - step)


@dataclass(frozen=True, eq=False)
class Judgement:
    """How unusual the gaps are.

    Parameters
    ----------
    usual : array of shape (n_joints,)
        Size that gaps usually have at most [rad or m].
    excess : array of shape (n_joints,)
        Distance from what some possible lag explains, in units of what is usual: at 1 a joint
        does not follow.
    lead : array of shape (n_joints,)
        Size of the gap for the shortest lag that is possible, in units of what is usual then:
        how far the reference leads.
    """

    usual: Array
    excess: Array
    lead: Array


@dataclass(eq=False)
class Servo:
    """Model of the servos of one robot; made by :meth:`start`, changed by each tick.

    Its parts are replaced, never changed, so that a copy is cheap.

    Parameters
    ----------
    bank : LagBank
    readings : Readings
    offset : Offset
    gaps : Gaps
    judgement : Judgement
    expected, lag : array of shape (n_joints,)
        Expected positions without offsets [rad or m], and means of the lags [s].
    floor : array of shape (n_joints,)
        Half the gap that means nothing: friction, backlash, what contact is known to leave.
    """

    bank: LagBank
    readings: Readings
    offset: Offset
    gaps: Gaps
    judgement: Judgement
    expected: Array
    lag: Array
    floor: Array

    @classmethod
    def start(cls, posture: Array) -> Self:
        """Begin at rest at a reference (n_joints,)."""
        zero, one = np.zeros_like(posture), np.ones_like(posture)
        none = np.zeros((len(LAGS), *posture.shape))
        last = np.broadcast_to(posture, (3, *posture.shape))
        return cls(
            LagBank.start(posture, none),
            Readings(last, posture, posture, posture, 1e-6 * one),
            Offset(zero, 16 * OFFSET_STD**2 * one),
            Gaps(None, none, zero),
            Judgement(one, zero, zero),
            posture,
            LAGS.mean() * one,
            FLOOR * one,
        )

    def copy(self) -> Self:
        """Copy the model as it is now."""
        return copy.copy(self)

    @property
    def position(self) -> Array:
        """Positions of the joints (n_joints,): readings less offsets."""
        return self.readings.median - self.offset.mean

    @property
    def std(self) -> Array:
        """Standard deviations of the readings (n_joints,)."""
        return np.sqrt(self.readings.noise)

    def measure_asked(self, bank: Array) -> Array:
        """Measure how far joints of any lag were to move since ``bank.second`` was that."""
        return np.abs(self.bank.second - bank).min(0)

    def advance(
        self, reference: Array, reading: Array, dt: float, jumped: bool, learns: bool
    ) -> None:
        """Take in what was measured at a tick.

        Parameters
        ----------
        reference : array of shape (n_joints,)
            What was sent a tick ago.
        reading : array of shape (n_joints,)
            What is measured now; NaN where nothing is.
        dt : float
            Duration of the tick [s].
        jumped : bool
            Whether readings have jumped: what was before does not smooth them.
        learns : bool
            Whether motion teaches lags and offsets.
        """
        before, weight = self.bank, self.bank.weight
        self.bank = bank = before.advance(reference, dt)
        self.expected, self.lag = (weight * bank.second).sum(0), (weight * LAGS).sum(0)
        known, offset, gap = np.isfinite(reading), self.offset.mean, self.gaps.mean
        y = np.where(known, reading, self.expected + offset + gap)
        if jumped or self.gaps.last is None:
            jumped = True
            self.readings = self.readings.jump(y, y - self.expected - offset - gap)
            last = np.broadcast_to(y - bank.second, (3, *bank.second.shape))
        else:
            last = np.concatenate((self.gaps.last[1:], (y - bank.second)[None]))
        slow, noise = self.readings.slow, self._estimate_noise(last, weight, known, dt)
        # readings without noise need no smoothing, which would be late
        noisy = np.minimum(3 * np.sqrt(noise) / FLOOR, 1.0)
        smooth = np.maximum(0.5 * self.lag * noisy, dt / 4)
        share = 1.0 if jumped else 1 - np.exp(-dt / smooth)
        each = self.gaps.each + share * (_take_median(last) - offset - self.gaps.each)
        each = np.where(known, each, 0.0)
        self.gaps = Gaps(last, each, (weight * each).sum(0))
        self.readings = self.readings.advance(y, dt, noise)
        self._judge(reference, weight, noise * np.minimum(1.0, dt / (2 * smooth)))
        learning = known & learns & (self.judgement.excess < 1)
        motion, ran = before.second - before.slow, self.readings.median - slow
        self._learn_lags(motion, ran, dt, learning)  # medians are a tick late
        self._learn_offsets(reference, dt, learning)

    def _estimate_noise(self, gaps: Array, weight: Array, known: Flags, dt: float) -> Array:
        """Estimate the variance of readings from how the last three gaps bend."""
        noise = self.readings.noise
        bend = (weight * (gaps[2] - 2 * gaps[1] + gaps[0])).sum(0) ** 2 / 6
        bend = np.minimum(bend, 9 * noise + 1e-6) - noise
        return noise + min(dt / WASH_OUT, 1.0) * known * bend

    def _judge(self, reference: Array, weight: Array, noise: Array) -> None:
        """Judge how large the gaps are, beside their noise and what is not known."""
        offset, each = self.offset, self.gaps.each
        # a part of an offset may be friction, which changes sides where a joint turns back
        floor = 2 * self.floor + np.minimum(np.abs(offset.mean), FLOOR)
        floor = floor + 2 * np.sqrt(noise + offset.variance)
        usual = floor + MODEL_ERROR * np.abs(reference - self.expected)
        possible = weight > POSSIBLE * weight.max(0)
        least = each.min(0, where=possible, initial=np.inf)
        most = each.max(0, where=possible, initial=-np.inf)
        beyond = np.maximum(np.maximum(least, -most), 0.0)
        shortest = (possible.argmax(0), np.arange(len(reference)))
        own = np.abs(reference - self.bank.second[shortest])
        lead = np.abs(each[shortest]) / (floor + MODEL_ERROR * own)
        self.judgement = Judgement(usual, beyond / usual, lead)

    def _learn_lags(self, motion: Array, ran: Array, dt: float, learns: Flags) -> None:
        """Learn lags from motion beside the slow one, in which offsets are gone.

        Joints teach that have been asked to move lately, have moved, and do so now.
        """
        bank, noise = self.bank, self.readings.noise
        mean = motion.sum(0) / len(LAGS)
        moves = learns & (np.abs(mean) > FLOOR) & (np.abs(ran) > FLOOR / 2)
        now = np.abs(self.readings.median - self.readings.near)
        moves &= now > FLOOR / 10 + 0.5 * self.std
        if moves.any():
            variance = (SERVO_STD / 2) ** 2 + noise + (0.1 * mean) ** 2
            error = np.minimum((ran - motion) ** 2 / (2 * variance), 8.0)
            score = bank.score - moves * (dt / np.maximum(2 * self.lag, dt)) * error
            score = np.maximum(score - score.max(0), -10.0)
            self.bank = replace(bank, score=score, weight=_compute_weight(score))

    def _learn_offsets(self, reference: Array, dt: float, learns: Flags) -> None:
        """Learn offsets by a Kalman filter to which the servo's own motion is noise."""
        own = (MODEL_ERROR * (reference - self.expected)) ** 2
        noise = (SERVO_STD**2 + self.readings.noise + own) * self.lag
        before = np.minimum(self.offset.variance + noise * dt / DRIFT**2, OFFSET_STD**2)
        gain = learns * before * dt / (before * dt + noise)
        step = gain * self.gaps.mean
        self.offset = Offset(self.offset.mean + step, (1 - gain) * before)
        self.gaps = self.gaps.less(step)

    def take_offsets(self, joints: Flags) -> None:
        """Take the gaps of some joints (n_joints,) for offsets."""
        self.forget_motion(joints)
        step = np.where(joints, self.gaps.mean, 0.0)
        variance = np.where(joints, FLOOR**2, self.offset.variance)
        self.offset = Offset(self.offset.mean + step, variance)
        self.gaps = self.gaps.less(step)

    def forget_motion(self, joints: Flags) -> None:
        """Let the motion of some joints (n_joints,) teach from now on, not what was before."""
        motion = (self.bank.weight * (self.bank.second - self.bank.slow)).sum(0)
        slow = np.where(joints, self.readings.median - motion, self.readings.slow)
        self.readings = replace(self.readings, slow=slow)

    def restart_here(self) -> None:
        """Let references begin where the robot was put to."""
        here, reading, score = self.position, self.readings.median, self.bank.score
        last = np.broadcast_to(self.offset.mean, (3, *score.shape))
        self.bank = LagBank.start(here, score)
        self.readings = replace(self.readings, slow=reading, near=reading)
        self.gaps = Gaps(last, np.zeros(score.shape), np.zeros_like(here))
        self.expected = here


def _compute_weight(score: Array) -> Array:
    """Compute the posterior of the lags (K, n_joints); a joint's others are its prior."""
    alone = np.exp(score)
    alone /= alone.sum(0)
    weight: Array = alone * alone.sum(-1, keepdims=True)
    return weight / weight.sum(0)


def _take_median(three: Array) -> Array:
    low, high = np.minimum(three[0], three[1]), np.maximum(three[0], three[1])
    return np.maximum(low, np.minimum(high, three[2]))

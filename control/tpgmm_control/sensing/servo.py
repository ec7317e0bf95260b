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

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_control.sensing.states import replace_fields
from tpgmm_torch.data.arrays import Array

Flags = NDArray[np.bool_]
#: Lags of position servos, from stiff industrial drives to soft hobby servos [s].
LAGS = np.geomspace(0.01, 0.64, 7)[:, None, None]
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
class Servo:
    """Lags, offsets and unexplained gaps of the joints of B robots; immutable.

    Parameters
    ----------
    first, second : array of shape (K, B, n_joints)
        The bank: servos of each lag, of first and of second order.
    slow : array of shape (K, B, n_joints)
        Low pass of ``second``: motion is what is beside it.
    slow_reading, near_reading : array of shape (B, n_joints)
        The same of the readings, and with a shorter time: a joint that is there stands.
    score : array of shape (K, B, n_joints)
        Logarithm of the likelihood of the lags, up to a constant.
    readings : array of shape (3, B, n_joints)
        The last ones.
    gaps : array of shape (3, K, B, n_joints)
        The same less the positions of the bank; NaN before the first.
    reading : array of shape (B, n_joints)
        Their median: without single outliers.
    noise : array of shape (B, n_joints)
        Variance of the readings.
    offset, variance : array of shape (B, n_joints)
        Estimate of the offset, and its variance.
    each, gap : arrays of shape (K, B, n_joints) and (B, n_joints)
        What each lag and the offset do not explain, smoothed over half a lag; their mean.
    expected, lag : array of shape (B, n_joints)
        Expected position without offset, mean of the lag [s].
    floor : array of shape (B, n_joints)
        Half the gap that means nothing: friction, backlash, what contact is known to leave.
    usual : array of shape (B, n_joints)
        Size that gaps usually have at most.
    excess : array of shape (B, n_joints)
        Distance from what some possible lag explains, in units of what is usual: at 1 a joint
        does not follow.
    lead : array of shape (B, n_joints)
        Size of the gap for the shortest lag that is possible, in units of what is usual then:
        how far the reference leads.
    """

    first: Array
    second: Array
    slow: Array
    slow_reading: Array
    near_reading: Array
    score: Array
    readings: Array
    gaps: Array
    reading: Array
    noise: Array
    offset: Array
    variance: Array
    each: Array
    gap: Array
    expected: Array
    lag: Array
    floor: Array
    usual: Array
    excess: Array
    lead: Array

    @classmethod
    def at_rest(cls, posture: Array) -> Self:
        """Robots that stand at their references (B, n_joints)."""
        bank = np.broadcast_to(posture, (len(LAGS), *posture.shape))
        zero, one = np.zeros_like(posture), np.ones_like(posture)
        none = np.full((3, *bank.shape), np.nan)
        return cls(
            bank, bank, bank, posture, posture, np.zeros(bank.shape),
            none[:, 0], none, posture, 1e-6 * one, zero,
            16 * OFFSET_STD**2 * one, 0 * bank, zero, posture, LAGS.mean() * one, FLOOR * one,
            one, zero, zero,
        )  # fmt: skip

    @property
    def corrected(self) -> Array:
        """Where the joints are: readings less offsets."""
        return self.reading - self.offset

    @property
    def resting(self) -> Array:
        """Readings of joints that stand, averaged; of those that move, as they are."""
        stands = np.abs(self.reading - self.near_reading) <= 3 * np.sqrt(self.noise)
        return np.where(stands, self.near_reading, self.reading)

    @property
    def weight(self) -> Array:
        """Posterior of the lags (K, B, n_joints); the robot's other joints are a prior."""
        alone = np.exp(self.score)
        alone /= alone.sum(0)
        weight: Array = alone * alone.sum(-1, keepdims=True)
        return weight / weight.sum(0)

    def update(
        self, reference: Array, reading: Array, dt: Array, jumped: Flags, learns: Flags
    ) -> Self:
        """The model after a tick.

        Parameters
        ----------
        reference : array of shape (B, n_joints)
            What was sent a tick ago.
        reading : array of shape (B, n_joints)
            What is measured now; NaN where nothing is.
        dt : array of shape (B, 1)
            Duration of the tick [s].
        jumped : bool array of shape (B, 1)
            Robots whose readings have jumped: what was before does not smooth them.
        learns : bool array of shape (B, 1)
            Robots whose motion teaches lags and offsets.
        """
        moved = 2 * dt / LAGS
        left, behind = np.exp(-moved), self.first - reference
        second = reference + left * (self.second - reference + moved * behind)
        weight = self.weight
        expected = (weight * second).sum(0)
        known = np.isfinite(reading)
        y = np.where(known, reading, expected + self.offset + self.gap)
        readings = np.concatenate((self.readings[1:], y[None]))
        gaps = np.concatenate((self.gaps[1:], (y - second)[None]))
        jumped = jumped | np.isnan(gaps[1, 0])
        slow, near = self.slow_reading, self.near_reading
        if jumped.any():
            gaps, readings = (np.where(jumped, x[2], x) for x in (gaps, readings))
            shift = np.where(jumped, y - expected - self.offset - self.gap, 0.0)  # is no motion
            slow, near = slow + shift, near + shift
        bend = (weight * (gaps[2] - 2 * gaps[1] + gaps[0])).sum(0) ** 2 / 6
        bend = np.minimum(bend, 9 * self.noise + 1e-6) - self.noise
        noise = self.noise + np.minimum(dt / WASH_OUT, 1) * known * bend
        lag = (weight * LAGS).sum(0)
        # readings without noise need no smoothing, which would be late
        noisy = np.minimum(3 * np.sqrt(noise) / FLOOR, 1.0)
        smooth = np.maximum(0.5 * lag * noisy, dt / 4)
        share = np.where(jumped, 1.0, 1 - np.exp(-dt / smooth))
        each = self.each + share * (_median(gaps) - self.offset - self.each)
        each = np.where(known, each, 0.0)
        wash, soon = 1 - np.exp(-dt / WASH_OUT), 1 - np.exp(-dt / STANDSTILL)
        new = replace_fields(
            self,
            first=reference + left * behind,
            second=second,
            slow=self.slow + wash * (second - self.slow),
            slow_reading=slow + wash * (y - slow),
            near_reading=near + soon * (y - near),
            readings=readings,
            gaps=gaps,
            reading=_median(readings),
            noise=noise,
            each=each,
            gap=(weight * each).sum(0),
            expected=expected,
            lag=lag,
        )
        noise = noise * np.minimum(1.0, dt / (2 * smooth))
        new = new._judged(reference, weight, noise)
        motion, ran = self.second - self.slow, new.reading - slow  # medians are a tick late
        return new._learned(reference, motion, ran, dt, known & learns)

    def _judged(self, reference: Array, weight: Array, noise: Array) -> Self:
        """How large the gaps are, beside their noise and what is not known."""
        # a part of an offset may be friction, which changes sides where a joint turns back
        floor = 2 * self.floor + np.minimum(np.abs(self.offset), FLOOR)
        floor = floor + 2 * np.sqrt(noise + self.variance)
        usual = floor + MODEL_ERROR * np.abs(reference - self.expected)
        possible = weight > POSSIBLE * weight.max(0)
        least = np.where(possible, self.each, np.inf).min(0)
        most = np.where(possible, self.each, -np.inf).max(0)
        beyond = np.maximum(np.maximum(least, -most), 0.0)
        shortest = possible.argmax(0)
        own = np.abs(reference - shortest.choose(self.second))
        lead = np.abs(shortest.choose(self.each)) / (floor + MODEL_ERROR * own)
        return replace_fields(self, usual=usual, excess=beyond / usual, lead=lead)

    def _learned(
        self, reference: Array, motion: Array, ran: Array, dt: Array, learns: Flags
    ) -> Self:
        """Lags and offsets of joints whose gaps are usual."""
        learns = learns & (self.excess < 1)
        # lags: from motion beside the slow one, in which offsets are gone, of joints that have
        # been asked to move lately, have moved, and do so now
        mean = motion.sum(0) / len(LAGS)
        moves = learns & (np.abs(mean) > FLOOR) & (np.abs(ran) > FLOOR / 2)
        now = np.abs(self.reading - self.near_reading)
        moves &= now > FLOOR / 10 + 0.5 * np.sqrt(self.noise)
        score = self.score
        if moves.any():
            variance = (SERVO_STD / 2) ** 2 + self.noise + (0.1 * mean) ** 2
            error = np.minimum((ran - motion) ** 2 / (2 * variance), 8.0)
            score = score - moves * (dt / np.maximum(2 * self.lag, dt)) * error
            score = np.maximum(score - score.max(0), -10.0)
        # offsets: a Kalman filter to which the servo's own motion is noise
        own = (MODEL_ERROR * (reference - self.expected)) ** 2
        noise = (SERVO_STD**2 + self.noise + own) * self.lag
        before = np.minimum(self.variance + noise * dt / DRIFT**2, OFFSET_STD**2)
        gain = learns * before * dt / (before * dt + noise)
        step = gain * self.gap
        return replace_fields(
            self,
            score=score,
            offset=self.offset + step,
            each=self.each - step,
            gap=self.gap - step,
            variance=(1 - gain) * before,
        )

    def with_offsets(self, joints: Flags) -> Self:
        """The gaps of some joints (B, n_joints) are offsets."""
        return replace_fields(
            self.moving_on(joints),
            offset=np.where(joints, self.offset + self.gap, self.offset),
            each=np.where(joints, self.each - self.gap, self.each),
            gap=np.where(joints, 0.0, self.gap),
            variance=np.where(joints, FLOOR**2, self.variance),
        )

    def asked(self, bank: Array) -> Array:
        """How far joints of any lag have been asked to move since ``second`` was this bank."""
        return np.abs(self.second - bank).min(0)

    def put(self, robots: Flags) -> Self:
        """Some robots (B, 1) were put to where they are."""
        here = {name: self.corrected for name in ("first", "second", "slow", "expected")}
        here |= dict.fromkeys(("slow_reading", "near_reading"), self.reading)
        here |= {"gaps": self.offset, "each": 0 * self.gap, "gap": 0 * self.gap}
        return replace_fields(
            self, **{n: np.where(robots, value, getattr(self, n)) for n, value in here.items()}
        )

    def moving_on(self, joints: Flags) -> Self:
        """The motion of some joints (B, n_joints) teaches from now on, not what was before."""
        motion = (self.weight * (self.second - self.slow)).sum(0)
        slow = np.where(joints, self.reading - motion, self.slow_reading)
        return replace_fields(self, slow_reading=slow)


def _median(three: Array) -> Array:
    low, high = np.minimum(three[0], three[1]), np.maximum(three[0], three[1])
    return np.maximum(low, np.minimum(high, three[2]))

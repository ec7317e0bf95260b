"""A model of each joint's servo: how late it is, and how far its readings are off.

Seen from the controller a joint is a servo of unknown lag, read with an unknown offset (sag,
payload, an encoder that slipped):

    x_k = (1 + p lag_k / 2)^-2 r          for a bank of lags, exact over ticks of any length
    y   = sum_k w_k x_k + b + g           w_k: posterior of the lag; b: offset, a random walk

r is the reference that was sent, p the derivative over time, y the reading, and g the gap that
neither lag nor offset explains. Its standard deviation is that of the readings' noise, of the
bank, and of the offset: as long as the lag is not known, nothing is concluded from a gap that
some lag explains. Gaps count in units of what is usual for this joint, whatever the rate of the
loop.

A robot that does not follow must not be explained by a long lag or by an offset: lags are
learned while gaps are usual and the joint moves, offsets as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.data.arrays import Array

__all__ = ["Servo"]

#: Lags of position servos, from stiff industrial drives to soft hobby servos [s].
LAGS = np.geomspace(0.01, 0.64, 7)[:, None, None]
#: A gap that means nothing: friction, backlash, compliance [rad or m].
FLOOR = 0.02
#: Share of the servo's own gap by which the model of its lag may be wrong.
MODEL_ERROR = 0.3
#: Share of what is usual up to which a gap is certain to be the servo's own, and teaches its
#: lag.
CERTAIN = 0.5
#: Standard deviations of an offset beforehand, and of what servos do beside it all [rad or m].
OFFSET_STD, SERVO_STD = 0.05, 0.01
#: Time in which offsets drift, and after which motion counts no longer [s].
DRIFT, WASH_OUT = 2.0, 1.0


@dataclass(frozen=True, eq=False)
class Servo:
    """Lags, offsets and unexplained gaps of the joints of B robots; immutable.

    Parameters
    ----------
    first, second : array of shape (K, B, n_joints)
        The bank: servos of each lag, of first and of second order.
    previous : array of shape (K, B, n_joints)
        ``second`` a tick ago.
    slow : array of shape (K, B, n_joints)
        Low pass of ``second``: motion is what is beside it.
    slow_reading : array of shape (B, n_joints)
        The same of the readings.
    score : array of shape (K, B, n_joints)
        Logarithm of the posterior of the lags, up to a constant.
    readings : array of shape (3, B, n_joints)
        The last ones.
    gaps : array of shape (3, B, n_joints)
        Between these and the expected positions.
    noise : array of shape (B, n_joints)
        Variance of the readings.
    offset, variance : array of shape (B, n_joints)
        Estimate of the offset, and its variance.
    gap : array of shape (B, n_joints)
        What neither lag nor offset explains, smoothed over half a lag.
    expected, lag, spread : array of shape (B, n_joints)
        Expected position without offset, mean of the lag [s], variance of that position.
    usual : array of shape (B, n_joints)
        Size that gaps usually have at most.
    lead : array of shape (B, n_joints)
        How far a joint is from the servo of the shortest lag that is possible, in units of what
        is usual if it has that lag.
    near_reading : array of shape (B, n_joints)
        Low pass of the readings over a tenth of a second: a joint that is there stands.
    """

    first: Array
    second: Array
    previous: Array
    slow: Array
    slow_reading: Array
    score: Array
    readings: Array
    gaps: Array
    noise: Array
    offset: Array
    variance: Array
    gap: Array
    expected: Array
    lag: Array
    spread: Array
    usual: Array
    lead: Array
    near_reading: Array

    @classmethod
    def at_rest(cls, posture: Array) -> Self:
        """Robots that stand at their references (B, n_joints)."""
        bank = np.broadcast_to(posture, (len(LAGS), *posture.shape))
        zero, one = np.zeros_like(posture), np.ones_like(posture)
        return cls(
            bank, bank, bank, bank, posture, np.zeros(bank.shape), np.stack([posture] * 3),
            np.full((3, *posture.shape), np.nan), 1e-6 * one, zero, OFFSET_STD**2 * one, zero,
            posture,
            LAGS.mean() * one, zero, (2 * FLOOR + 2 * OFFSET_STD) * one, zero, posture,
        )  # fmt: skip

    @property
    def weight(self) -> Array:
        """Posterior of the lags: other joints of the robot are a prior."""
        alone = np.exp(self.score)
        alone = alone / alone.sum(0)
        weight = alone * alone.mean(-1, keepdims=True)
        return weight / weight.sum(0)

    @property
    def reading(self) -> Array:
        """The readings without single outliers: medians of three."""
        return np.median(self.readings, 0)

    @property
    def corrected(self) -> Array:
        """Where the joints are: readings less offsets."""
        return self.reading - self.offset

    @property
    def excess(self) -> Array:
        """Size of the gaps in units of what is usual: above 1, a joint does not follow."""
        return np.abs(self.gap) / self.usual

    @property
    def moves(self) -> NDArray[np.bool_]:
        """Joints that have been asked to move lately, and have moved."""
        asked = np.abs(self.expected - self.slow.mean(0)) > FLOOR
        moved = np.abs(self.reading - self.slow_reading) > FLOOR / 2
        now = np.abs(self.reading - self.near_reading) > 0.002 + 0.5 * np.sqrt(self.noise)
        return asked & moved & now

    def update(
        self,
        reference: Array,
        reading: Array,
        dt: Array,
        jumped: NDArray[np.bool_],
        learns: NDArray[np.bool_],
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
        left = np.exp(-moved)
        behind = self.first - reference
        second = reference + left * (self.second - reference + moved * behind)
        weight = self.weight
        expected = (weight * second).sum(0)
        spread = (weight * (second - expected) ** 2).sum(0)
        lag = (weight * LAGS).sum(0)
        known = np.isfinite(reading)
        y = np.where(known, reading, expected + self.offset + self.gap)
        gaps = np.stack((*self.gaps[1:], y - expected))
        readings = np.stack((*self.readings[1:], y))
        jumped = jumped | np.isnan(self.gaps[2])
        if jumped.any():
            gaps, readings = (np.where(jumped, x[2], x) for x in (gaps, readings))
        # readings without noise need no smoothing, which would be late
        noisy = np.minimum(3 * np.sqrt(self.noise) / FLOOR, 1.0)
        smooth = np.maximum(0.5 * lag * noisy, dt / 4)
        bend = (gaps[2] - 2 * gaps[1] + gaps[0]) ** 2 / 6
        noise = self.noise + np.minimum(dt / 0.5, 1) * known * (
            np.minimum(bend, 9 * self.noise + 1e-6) - self.noise
        )
        share = np.where(jumped, 1.0, 1 - np.exp(-dt / smooth))
        gap = self.gap + share * (np.median(gaps, 0) - self.offset - self.gap)
        wash = 1 - np.exp(-dt / WASH_OUT)
        noise_of_mean = noise * np.minimum(1.0, dt / (2 * smooth))
        own = np.abs(reference - expected)
        floor = 2 * FLOOR + np.minimum(np.abs(self.offset), FLOOR)
        usual = floor + 2 * np.sqrt(noise_of_mean + spread + self.variance)
        possible = (weight > 0.1 * weight.max(0)).argmax(0)[None]
        shortest = np.take_along_axis(second, possible, 0)[0]
        least = floor + 2 * np.sqrt(noise_of_mean + self.variance)
        least = least + MODEL_ERROR * np.abs(reference - shortest)
        lead = np.abs(expected + gap - shortest) / least
        return replace(
            self,
            first=reference + left * behind,
            second=second,
            previous=self.second,
            slow=self.slow + wash * (second - self.slow),
            slow_reading=self.slow_reading + wash * (y - self.slow_reading),
            readings=readings,
            gaps=gaps,
            noise=noise,
            gap=np.where(known, gap, 0.0),
            expected=expected,
            lag=lag,
            spread=spread,
            usual=usual + MODEL_ERROR * own,
            lead=np.where(known, lead, 0.0),
            near_reading=self.near_reading + (1 - np.exp(-dt / 0.1)) * (y - self.near_reading),
        )._learned(own, dt, known & learns)

    def _learned(self, own: Array, dt: Array, learns: NDArray[np.bool_]) -> Self:
        """Lags and offsets of joints whose gaps are usual, from their motion."""
        moves, usual = self.moves, learns & (self.excess < 1)
        # lags: from motion beside the slow one, in which offsets are gone
        motion = self.previous - self.slow  # medians are a tick late
        error = (self.reading - self.slow_reading - motion) ** 2
        variance = (SERVO_STD / 2) ** 2 + self.noise + (0.1 * motion.mean(0)) ** 2
        worth = dt / np.maximum(2 * self.lag, dt)
        score = self.score - np.where(
            learns & moves & (self.excess < 1),
            worth * np.minimum(error / (2 * variance), 8.0),
            0.0,
        )
        score = np.maximum(score - score.max(0), -10.0)
        # offsets: a Kalman filter to which the servo's own motion is noise
        noise = SERVO_STD**2 + self.noise + self.spread + (MODEL_ERROR * own) ** 2
        noise = noise * self.lag
        before = np.minimum(self.variance + noise * dt / DRIFT**2, OFFSET_STD**2)
        gain = np.where(usual, before * dt / (before * dt + noise), 0.0)
        step = gain * self.gap
        return replace(
            self,
            score=score,
            offset=self.offset + step,
            gap=self.gap - step,
            variance=(1 - gain) * before,
        )

    def with_offsets(self, joints: NDArray[np.bool_]) -> Self:
        """The gaps of some joints (B, n_joints) are offsets."""
        return replace(
            self.moving_on(joints),
            offset=np.where(joints, self.offset + self.gap, self.offset),
            gap=np.where(joints, 0.0, self.gap),
            variance=np.where(joints, FLOOR**2, self.variance),
        )

    def moving_on(self, joints: NDArray[np.bool_]) -> Self:
        """The motion of some joints (B, n_joints) teaches from now on, not what was before."""
        weight = self.weight
        motion = (weight * (self.previous - self.slow)).sum(0)
        slow = np.where(joints, self.reading - motion, self.slow_reading)
        return replace(self, slow_reading=slow)

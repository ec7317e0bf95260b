"""The rhythm of a motion: a sinusoid of least squares through a signal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from tpgmm_torch.exceptions import ShapeError


@dataclass(frozen=True)
class Sinusoid:
    """``offset + amplitude sin(2 pi frequency t + phase)``, and its residual.

    Parameters
    ----------
    frequency : float
        In hertz.
    amplitude, offset : float
        In the signal's unit.
    phase : float
        At time 0 [rad].
    residual : float
        Root mean square of the rest.
    """

    frequency: float
    amplitude: float
    offset: float
    phase: float
    residual: float


def sinusoid(time: ArrayLike, signal: ArrayLike) -> Sinusoid:
    """Fit the sinusoid of least squares through a signal.

    The frequency is searched between one period in the window and the Nyquist frequency,
    coarsely by steps of a fifth of a period in the window, then by golden sections.

    Parameters
    ----------
    time, signal : array-like of shape (T,)
        In seconds, and in any unit.

    Raises
    ------
    ShapeError
        If there are fewer than eight points, or the shapes differ.

    Examples
    --------
    >>> time = np.linspace(0, 3, 100)
    >>> fit = sinusoid(time, 0.2 + 0.5 * np.sin(2 * np.pi * 1.5 * time))
    >>> round(fit.frequency, 6), round(fit.amplitude, 6), round(fit.offset, 6)
    (1.5, 0.5, 0.2)
    """
    t = np.asarray(torch.as_tensor(time), dtype=np.float64)
    y = np.asarray(torch.as_tensor(signal), dtype=np.float64)
    if t.shape != y.shape or t.ndim != 1 or len(t) < 8:
        raise ShapeError(
            f"sinusoid needs two equal vectors of 8 or more, got {t.shape}, {y.shape}"
        )

    def fit(frequency: float) -> tuple[float, NDArray[np.float64]]:
        angle = 2 * np.pi * frequency * t
        basis = np.stack((np.sin(angle), np.cos(angle), np.ones_like(t)), axis=1)
        coefficients = np.linalg.lstsq(basis, y, rcond=None)[0]
        return float(np.sqrt(np.mean((y - basis @ coefficients) ** 2))), coefficients

    window = t[-1] - t[0]
    grid = np.arange(1, len(t) / 2, 0.2) / window
    best = int(np.argmin([fit(frequency)[0] for frequency in grid]))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    golden = (np.sqrt(5) - 1) / 2
    for _ in range(40):
        left, right = high - golden * (high - low), low + golden * (high - low)
        low, high = (low, right) if fit(left)[0] < fit(right)[0] else (left, high)
    frequency = float((low + high) / 2)
    residual, (sine, cosine, offset) = fit(frequency)
    amplitude, phase = float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))
    return Sinusoid(frequency, amplitude, float(offset), phase, residual)

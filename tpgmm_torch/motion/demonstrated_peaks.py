"""How fast demonstrations change: peaks of acceleration and jerk, robust to recording noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.signal import savgol_filter
from torch import Tensor

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration

#: Width of the windows in which polynomials are fitted [s], and in instants.
WINDOW, FEWEST = 0.25, 9
#: The share of demonstrations that are no outliers.
DEMONSTRATIONS = 0.9


def typical_peaks(peaks: Sequence[Array]) -> tuple[Tensor, Tensor]:
    """Compute the acceleration and jerk of each joint that few of the demonstrations exceed.

    A tenth of the demonstrations may be outliers.

    Parameters
    ----------
    peaks : sequence of array of shape (2, n_joints)
        :func:`joint_peaks` of each demonstration.

    Returns
    -------
    acceleration : Tensor of shape (n_joints,)
    jerk : Tensor of shape (n_joints,)
        [rad/s^2], [rad/s^3], or m; zero where demonstrations are too short to tell.

    Examples
    --------
    >>> time = np.linspace(0, 3, 301)
    >>> swing = Demonstration(time, np.sin(2 * time)[:, None], joint_names=["a"])
    >>> acceleration, jerk = typical_peaks([joint_peaks(swing)])
    >>> round(float(acceleration), 1), round(float(jerk), 1)
    (4.0, 8.0)
    """
    acceleration, jerk = np.quantile(np.stack(peaks), DEMONSTRATIONS, axis=0)
    return torch.from_numpy(acceleration), torch.from_numpy(jerk)


def joint_peaks(demonstration: Demonstration) -> Array:
    """Compute peaks (2, n_joints) of acceleration and jerk of one ``demonstration``.

    Second and third derivatives of recorded positions are mostly noise. They are taken from
    cubic polynomials in windows of 0.25 s (Savitzky and Golay, 1964).
    """
    time, joints = as_array(demonstration.time), as_array(demonstration.joints)
    if len(time) < FEWEST:
        return np.zeros((2, joints.shape[1]))
    # of even time steps, as the window needs
    even = np.linspace(time[0], time[-1], len(time))
    step = even[1] - even[0]
    joints = np.stack([np.interp(even, time, joint) for joint in joints.T], 1)
    width = min(max(FEWEST, round(WINDOW / step)), len(time)) // 2 * 2 - 1
    derivatives = [savgol_filter(joints, width, 3, n, delta=step, axis=0) for n in (2, 3)]
    # within half a window of the ends they are extrapolated
    half = min(width // 2, (len(time) - 1) // 2)
    return np.abs(np.stack(derivatives))[:, half : len(time) - half].max(1)

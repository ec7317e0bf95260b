"""How fast demonstrations change: peaks of acceleration and jerk, robust to recording noise."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import torch
from scipy.signal import savgol_filter
from torch import Tensor

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.mixture.processes import ALONE, Processes

__all__ = ["DemonstratedPeaks", "demonstrated_peaks"]

#: Width of the windows in which polynomials are fitted [s], and in instants.
WINDOW, FEWEST = 0.25, 9
#: The share of demonstrations that are no outliers.
DEMONSTRATIONS = 0.9


class DemonstratedPeaks:
    """Peaks of demonstrations that come by, batch by batch.

    Parameters
    ----------
    joint_names : sequence of str
        The joints, in their order.
    """

    def __init__(self, joint_names: Sequence[str]) -> None:
        self._names, self._peaks = tuple(joint_names), list[Array]()

    def watch(
        self, batches: Iterable[Sequence[Demonstration]]
    ) -> Iterator[Sequence[Demonstration]]:
        """The same batches, looked at as they are passed on."""
        for batch in batches:
            self._peaks += [
                _peaks(demonstration.reordered(self._names)) for demonstration in batch
            ]
            yield batch

    def result(self, processes: Processes = ALONE) -> tuple[Tensor, Tensor]:
        """Acceleration and jerk that few demonstrations exceed, of those of all processes.

        Returns
        -------
        acceleration : Tensor of shape (n_joints,)
        jerk : Tensor of shape (n_joints,)
            [rad/s^2], [rad/s^3], or m.
        """
        peaks = [one for part in processes.gather(self._peaks) for one in part]
        found = np.quantile(np.stack(peaks), DEMONSTRATIONS, axis=0)
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])


def demonstrated_peaks(
    demonstrations: Sequence[Demonstration], joint_names: Sequence[str]
) -> tuple[Tensor, Tensor]:
    """Peaks of acceleration and jerk of each joint.

    Second and third derivatives of recorded positions are mostly noise. They are taken from
    cubic polynomials in windows of 0.25 s (Savitzky and Golay, 1964); a tenth of the
    demonstrations may be outliers.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
    joint_names : sequence of str
        The joints, in their order.

    Returns
    -------
    acceleration : Tensor of shape (n_joints,)
    jerk : Tensor of shape (n_joints,)
        [rad/s^2], [rad/s^3], or m; zero where demonstrations are too short to tell.

    Examples
    --------
    >>> time = np.linspace(0, 3, 301)
    >>> swing = Demonstration(time, np.sin(2 * time)[:, None], joint_names=["a"])
    >>> acceleration, jerk = demonstrated_peaks([swing], ["a"])
    >>> round(float(acceleration), 1), round(float(jerk), 1)
    (4.0, 8.0)
    """
    peaks = DemonstratedPeaks(joint_names)
    for _ in peaks.watch([demonstrations]):
        pass
    return peaks.result()


def _peaks(demonstration: Demonstration) -> Array:
    """Acceleration and jerk, (2, n_joints)."""
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

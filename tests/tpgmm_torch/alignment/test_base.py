"""Laws of playing demonstrations on another clock, and of linear time normalisation."""

import numpy as np
import pytest
import torch

from tpgmm_torch import quaternions
from tpgmm_torch.alignment import LinearTimeNormalization
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.robots.tracked_poses import Poses


def turning(time, phase):
    """One rotating frame and one hand pose, both a function of the phase in [0, 1]."""
    angle = torch.from_numpy(2.5 * phase)
    turn = quaternions.exp(angle[:, None] * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64))
    place = np.stack((np.sin(3 * phase), phase, phase**2), 1)
    poses = torch.cat((torch.from_numpy(place), turn), 1)
    return Demonstration(
        time, poses, {"moving": Frame(place, turn)}, Poses(["hand"]).joint_names
    )


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_moving_frames_and_recorded_poses_turn_along_great_arcs(interpolation):
    coarse, fine = np.linspace(0, 2, 9), np.linspace(0, 1, 65)
    transformer = LinearTimeNormalization(
        n_steps=65, duration=1.0, robot=Poses(["hand"]), interpolation=interpolation
    )
    [aligned] = transformer.fit_transform([turning(coarse, coarse / 2)])
    exact = turning(fine, fine)
    arcs = aligned.frames["moving"].orientation
    torch.testing.assert_close(arcs, exact.frames["moving"].orientation, rtol=0, atol=1e-12)
    torch.testing.assert_close(aligned.joints[:, 3:], arcs, rtol=0, atol=1e-12)
    error = (aligned.joints[:, :3] - exact.joints[:, :3]).abs().max()
    assert error < (1e-3 if interpolation == "cubic" else 2e-2)


@pytest.mark.parametrize("duration, expected", [("mean", 2.0), ("median", 1.5), (1.0, 1.0)])
def test_linear_normalization_scales_durations_and_events(duration, expected):
    family = [
        Demonstration(
            np.linspace(5, 5 + t, 31), np.arange(31.0)[:, None], events={"half": 5 + t / 2}
        )
        for t in (1.0, 1.5, 3.5)
    ]
    for aligned in LinearTimeNormalization(duration).fit_transform(family):
        assert (float(aligned.time[0]), aligned.duration) == pytest.approx((0, expected))
        assert aligned.events["half"] == pytest.approx(expected / 2)
        assert aligned.joints[:, 0].tolist() == pytest.approx(list(range(31)))

"""Trajectories."""

import torch

from tpgmm_torch.data.trajectories import Candidate, Trajectory


def test_a_trajectory_says_what_it_is():
    eye = torch.eye(2).expand(3, 2, 2)
    candidate = Candidate(torch.zeros(3, 2), eye, torch.ones(3, 2))
    trajectory = Trajectory(
        torch.arange(3.0), torch.zeros(3, 2), eye, (candidate,), ("shoulder", "elbow")
    )
    assert len(trajectory) == 3
    assert repr(trajectory) == "Trajectory(3 steps, 2.00 s, 2 joints, 1 candidates)"

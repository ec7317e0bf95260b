"""At which time of the model the frames of episodes stand."""

import numpy as np
import torch

from lerobot_policy_tpgmm.training.clocks import Clock
from tests.support.training import FPS, WAVES, trained
from tpgmm_datasets import load_lerobot
from tpgmm_torch.alignment import DynamicTimeWarping


def test_clocks():
    episodes, steps = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 3, 0, 4])
    own = Clock({0: 5, 1: 9}, None, {}, 10.0)
    assert own(episodes, steps).tolist() == [0.0, 0.3, 0.0, 0.4]
    grid = np.linspace(0.0, 2.0, 5)
    clock = Clock({0: 5, 1: 9}, grid, {0: np.array([0.0, 2.0, 3.0, 3.5, 4.0])}, 10.0)
    assert clock(episodes, steps).tolist() == [0.0, 1.0, 0.0, 1.0]
    assert clock(episodes, steps + 9).tolist() == [2.0] * 4


def test_aligned_frames_stand_where_the_alignment_put_them(waves):
    policy = trained(waves, **WAVES)
    clock = policy._learner.clock
    demonstrations = load_lerobot(waves.root)
    aligner = DynamicTimeWarping().fit(demonstrations)
    for number, (one, path) in enumerate(zip(demonstrations, aligner.paths_, strict=True)):
        steps = torch.arange(len(one))
        found = clock(torch.full_like(steps, number), steps)
        # what the alignment plays at these times are the frames themselves
        played = FPS * np.interp(found.numpy(), aligner.time_.numpy(), path)
        np.testing.assert_allclose(played, steps.numpy(), atol=1e-9)
        assert found[-1] == aligner.time_[-1] and len(aligner.time_) / FPS > found[-1]

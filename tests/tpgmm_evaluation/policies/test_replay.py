"""The naive floor: the demonstration whose objects stood nearest, replayed."""

import math

import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from tpgmm_evaluation.policies.episodes import Episodes
from tpgmm_evaluation.policies.replay import NearestPolicy

FPS = 20


def test_the_nearest_demonstration_is_replayed_to_its_end(tmp_path):
    def pose(x, degrees):
        half = math.radians(degrees) / 2
        return torch.tensor([x, 0, 0, math.cos(half), 0, 0, math.sin(half)])

    kept = [(0.0, 0), (0.1, 0), (0.0, 90)]
    actions = [(10.0 * i + torch.arange(3 + i))[:, None].expand(-1, 2) for i in range(3)]
    parts = [
        (0 * action, pose(*at).expand(len(action), -1), action)
        for at, action in zip(kept, actions, strict=True)
    ]
    NearestPolicy.fit(Episodes.join(FPS, parts)).save_pretrained(tmp_path)
    policy = NearestPolicy.from_pretrained(tmp_path)
    # a quaternion and its negative are one orientation
    given = torch.stack((pose(0.09, 10), -pose(0.02, 70), pose(0.01, -5)))
    given[1, 0] = 0.02
    batch = {OBS_ENV_STATE: given, OBS_STATE: torch.zeros(3, 2)}
    taken = torch.stack([policy.select_action(batch)[:, 0] for _ in range(6)])
    ways = ([10, 11, 12, 13, 13, 13], [20, 21, 22, 23, 24, 24], [0, 1, 2, 2, 2, 2])
    assert taken.T.tolist() == [*ways]
    policy.reset()
    assert policy.select_action(batch)[:, 0].tolist() == [10, 20, 0]

"""Nearest-neighbour regression: what was done in the states most like this one."""

import pytest
import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from tpgmm_evaluation.policies.episodes import Episodes
from tpgmm_evaluation.policies.neighbours import NeighboursPolicy
from tpgmm_torch.exceptions import DataError

FPS = 20


def episodes(*goals, length=40):
    """One joint goes to the place of an object."""
    time = torch.arange(length)[:, None] / (length - 1)
    parts = []
    for goal in goals:
        state = goal * time
        action = torch.cat((state[1:], state[-1:]))
        parts.append((state, torch.full((length, 1), goal), action))
    return Episodes.join(FPS, parts)


def batch(state, environment):
    return {
        OBS_STATE: torch.tensor(state)[:, None],
        OBS_ENV_STATE: torch.tensor(environment)[:, None],
    }


def test_what_was_shown_is_done_at_the_policys_rate(tmp_path):
    shown = episodes(1.0, 2.0)
    policy = NeighboursPolicy.fit(shown, FPS // 2, n_neighbours=1, n_action_steps=3)
    policy.save_pretrained(tmp_path)
    policy = NeighboursPolicy.from_pretrained(tmp_path)
    (_, _, first), (_, _, second) = shown
    given = batch([float(second[9]), float(first[9])], [2.0, 1.0])
    taken = torch.stack([policy.select_action(given)[:, 0] for _ in range(3)], dim=1)
    # the last of the two rows that a step lasts, three times
    wanted = torch.stack([way[[11, 13, 15], 0] for way in (second, first)])
    torch.testing.assert_close(taken, wanted)
    alone = policy.predict_action_chunk({key: value[1:] for key, value in given.items()})
    torch.testing.assert_close(alone[0, :, 0], wanted[1])


def test_neighbours_are_weighted_by_how_near_they_are():
    # of each episode the first row alone, so that the two neighbours are of both
    shown = Episodes.join(FPS, [tuple(c[:1] for c in one) for one in episodes(1.0, 2.0)])
    policy = NeighboursPolicy.fit(shown, FPS, n_neighbours=2, n_action_steps=1)
    between = [
        float(policy.predict_action_chunk(batch([0.0], [at]))[0, 0, 0]) for at in (1.2, 1.8)
    ]
    ends = [action[0, 0].item() for _, _, action in shown]
    assert ends[0] < between[0] < between[1] < ends[1]


def test_the_time_tells_equal_states_apart():
    still = torch.zeros(30, 1)
    late = torch.arange(30)[:, None] >= 15
    shown = Episodes.join(FPS, [(still, still + 1, late.float())]).with_time()
    n_time = shown.columns[OBS_ENV_STATE].shape[1] - 1
    policy = NeighboursPolicy.fit(
        shown, FPS, n_time, n_neighbours=1, time_weight=1.0, n_action_steps=1
    )
    for row, wanted in ((5, 0.0), (25, 1.0)):
        one = {key: shown.columns[key][row : row + 1] for key in (OBS_STATE, OBS_ENV_STATE)}
        assert float(policy.predict_action_chunk(one)[0, 0, 0]) == wanted


def test_what_cannot_be_asked_for():
    with pytest.raises(DataError, match="50 neighbours are asked for, of 40 rows"):
        NeighboursPolicy.fit(episodes(1.0), FPS, n_neighbours=50)
    with pytest.raises(DataError, match="no multiple of the policy's 7"):
        NeighboursPolicy.fit(episodes(1.0), 7)

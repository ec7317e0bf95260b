"""Episodes in memory, the windows drawn from them, and the time as an observation."""

import numpy as np
import pytest
import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from tpgmm_datasets import save_lerobot
from tpgmm_evaluation.policies.episodes import Episodes, Windows
from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.exceptions import DataError

FPS = 20


def number_rows(*lengths):
    """Episodes whose values tell where they come from: 100 times the episode, plus the row."""
    parts = []
    for number, length in enumerate(lengths):
        rows = 100.0 * number + torch.arange(length)[:, None]
        parts.append((rows, rows + 0.25, rows + 0.5))
    return Episodes.join(FPS, parts)


def cut_windows(episodes, *arguments):
    return Windows(episodes.columns, episodes.bounds, *arguments)


def test_episodes_are_read_as_they_were_written(tmp_path):
    rng = np.random.default_rng(0)
    motions = [
        Demonstration(np.arange(n) / FPS, rng.normal(size=(n, 3)), {"bottle": Frame(place)})
        for n, place in zip((12, 15, 9), rng.normal(size=(3, 3)), strict=True)
    ]
    actions = [motion.joints + 1 for motion in motions]
    root = save_lerobot(motions, tmp_path / "set", fps=FPS, task="reach", actions=actions)
    episodes = Episodes.read(root)
    assert (episodes.fps, len(episodes), episodes.bounds) == (FPS, 3, (0, 12, 27, 36))
    for (state, environment, action), motion in zip(episodes, motions, strict=True):
        torch.testing.assert_close(state, motion.joints.float())
        torch.testing.assert_close(action, motion.joints.float() + 1)
        pose = torch.cat((motion.frame("bottle").position, torch.tensor([1.0, 0, 0, 0])))
        torch.testing.assert_close(environment, pose.float().expand(len(state), -1))
    assert episodes.first(2).bounds == (0, 12, 27)
    assert len(episodes.first(2).columns[OBS_STATE]) == 27
    with pytest.raises(DataError, match="4 episodes are asked for, there are 3"):
        episodes.first(4)


def test_windows_stay_in_their_episode_at_the_lower_rate():
    windows = cut_windows(number_rows(8, 6), 2, [-1, 0], [0, 1, 2])
    assert len(windows) == 14
    batch = windows.at(torch.tensor([0, 5, 8, 11]))
    # two steps, of two rows each, are seen
    seen = [[0, 0], [3, 5], [100, 100], [101, 103]]
    assert batch[OBS_STATE][..., 0].tolist() == seen
    assert (batch[OBS_ENV_STATE][..., 0] - 0.25).tolist() == seen
    # the reference at the end of each step
    wanted = [[1, 3, 5], [6, 7, 7], [101, 103, 105], [104, 105, 105]]
    assert (batch[ACTION][..., 0] - 0.5).tolist() == wanted
    assert batch["action_is_pad"].tolist() == [[False] * 3, [False, True, True]] * 2


def test_without_a_history_observations_have_no_time_axis():
    batch = cut_windows(number_rows(8), 4, None, [0]).at(torch.tensor([3]))
    assert batch[OBS_STATE].shape == (1, 1)
    assert batch[ACTION].tolist() == [[[6.5]]]


# these are alike on linear time already, and one of them is left there
@pytest.mark.filterwarnings("ignore:left on linear time")
def test_the_common_clock_removes_differences_in_time():
    def reach(duration, goal):
        steps = round(duration * FPS)
        progress = torch.linspace(0, 1, steps)
        joints = torch.stack((goal * torch.sin(3 * progress), torch.cos(4 * progress)), dim=1)
        return joints, torch.full((steps, 7), goal), joints + 0.01

    training = Episodes.join(FPS, [reach(*item) for item in ((2, 1.0), (3, 1.1), (2.5, 0.9))])
    validation = Episodes.join(FPS, [reach(2.2, 1.05)])
    training, validation = training.on_common_clock(validation)
    lengths = set(np.diff(training.bounds)) | set(np.diff(validation.bounds))
    assert len(lengths) == 1
    cosines = torch.stack([state[:, 1] for state, _, _ in (*training, *validation)])
    assert (cosines.max(0).values - cosines.min(0).values).max() < 0.1
    assert [float(rows[0, 0]) for _, rows, _ in training] == pytest.approx([1.0, 1.1, 0.9])
    state, action = training.columns[OBS_STATE], training.columns[ACTION]
    torch.testing.assert_close(action, state + 0.01, atol=1e-5, rtol=0)
    elapsed = training.elapsed_time()[: max(lengths)]
    np.testing.assert_allclose(elapsed, np.arange(max(lengths)) / FPS, rtol=1e-6)

"""Batches of whole episodes, again and again."""

import pytest

from tests.support.lerobot_sets import assert_equal, joints_of
from tpgmm_datasets import DatasetError, EpisodeBatches, load_lerobot


@pytest.mark.parametrize("size", [1, 2, 3, 16])
def test_batches_are_the_episodes_in_order_each_time(root, size):
    batches = EpisodeBatches(root, size, rate=25)
    expected = load_lerobot(root, rate=25)
    for _ in range(2):
        found = list(batches)
        assert [len(batch) for batch in found[:-1]] == [size] * (len(batches) - 1)
        episodes = [episode for batch in found for episode in batch]
        assert_equal(joints_of(episodes), joints_of(expected))


def test_options_that_do_not_fit_are_refused_when_it_is_made(root):
    with pytest.raises(DatasetError, match="at least one episode, got size=0"):
        EpisodeBatches(root, 0)
    with pytest.raises(DatasetError, match="no episodes"):
        EpisodeBatches(root, episodes=[7])
    with pytest.raises(TypeError, match="robto"):
        EpisodeBatches(root, robto=None)

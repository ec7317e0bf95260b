"""Statistics of columns: of one episode, and of two parts together."""

import numpy as np
import pytest

from tpgmm_datasets.lerobot.statistics import QUANTILES, episode_statistics, merge_statistics


def test_statistics_are_those_of_numpy():
    values = np.random.default_rng(0).normal(size=(50, 3))
    found = episode_statistics({"a": values})["a"]
    assert found["count"].tolist() == [50]
    for name in ("min", "max", "mean", "std"):
        assert found[name] == pytest.approx(getattr(np, name)(values, axis=0))
    for name, share in QUANTILES.items():
        assert found[name] == pytest.approx(np.quantile(values, share, axis=0))


@pytest.mark.parametrize("lengths", [(30, 20), (1, 1), (1, 40)])
def test_parts_merge_into_the_whole(lengths):
    rng = np.random.default_rng(1)
    parts = [rng.normal(size=(n, 2)) * (1 + i) + 10 * i for i, n in enumerate(lengths)]
    first, second = (episode_statistics({"a": part}) for part in parts)
    merged = merge_statistics(first, second)["a"]
    whole = episode_statistics({"a": np.concatenate(parts)})["a"]
    for name in ("count", "min", "max", "mean", "std"):
        assert merged[name] == pytest.approx(whole[name])
    share = lengths[1] / sum(lengths)
    for name in QUANTILES:
        mean = (1 - share) * first["a"][name] + share * second["a"][name]
        assert merged[name] == pytest.approx(mean)

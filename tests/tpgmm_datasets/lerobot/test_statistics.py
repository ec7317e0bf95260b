"""Statistics of columns: of one episode, and of two parts together."""

import json

import numpy as np
import pytest

from tpgmm_datasets.lerobot import statistics


def test_statistics_are_those_of_numpy():
    values = np.random.default_rng(0).normal(size=(50, 3))
    found = statistics.episode_statistics({"a": values})["a"]
    assert found["count"].tolist() == [50]
    for name in ("min", "max", "mean", "std"):
        assert found[name] == pytest.approx(getattr(np, name)(values, axis=0))
    for name, share in statistics.QUANTILES.items():
        assert found[name] == pytest.approx(np.quantile(values, share, axis=0))


@pytest.mark.parametrize("lengths", [(30, 20), (1, 1), (1, 40)])
def test_parts_merge_into_the_whole(lengths):
    rng = np.random.default_rng(1)
    parts = [rng.normal(size=(n, 2)) * (1 + i) + 10 * i for i, n in enumerate(lengths)]
    first, second = (statistics.episode_statistics({"a": part}) for part in parts)
    merged = statistics.merge_statistics(first, second)["a"]
    whole = statistics.episode_statistics({"a": np.concatenate(parts)})["a"]
    for name in ("count", "min", "max", "mean", "std"):
        assert merged[name] == pytest.approx(whole[name])
    share = lengths[1] / sum(lengths)
    for name in statistics.QUANTILES:
        mean = (1 - share) * first["a"][name] + share * second["a"][name]
        assert merged[name] == pytest.approx(mean)


def test_the_stated_range_is_that_of_all_episodes_in_either_layout(tmp_path):
    (tmp_path / "meta").mkdir()
    assert statistics.stated_range(tmp_path, "state", 2) is None
    extremes = [{"min": [-n, 0], "max": [1, 2 * n]} for n in range(3)]
    lines = [{"episode_index": n, "stats": {"state": x}} for n, x in enumerate(extremes)]
    text = "\n".join(map(json.dumps, lines))
    (tmp_path / "meta" / "episodes_stats.jsonl").write_text(text)
    assert statistics.stated_range(tmp_path, "state", 2).tolist() == [[-2, 0], [1, 4]]
    whole = tmp_path / "meta" / "stats.json"
    whole.write_text(json.dumps({"state": {"min": [0, -5], "max": [3, 4]}}))
    assert statistics.stated_range(tmp_path, "state", 2).tolist() == [[0, -5], [3, 4]]


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "3", '{"state": 1}', '{"state": {"min": [0], "max": [1, 2]}}',
     '{"state": {"min": [0, NaN], "max": [1, 2]}}', '{"state": {"min": "a", "max": "b"}}',
     '{"other": {"min": [0, 0], "max": [1, 2]}}', "[" * 100_000],
)  # fmt: skip
def test_what_is_not_stated_is_no_range(tmp_path, text):
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "stats.json").write_text(text)
    assert statistics.stated_range(tmp_path, "state", 2) is None

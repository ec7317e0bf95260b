"""Paired tests against scipy and values by hand, and what is paired with what."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from tests.support.comparison import result
from tpgmm_evaluation.report import significance
from tpgmm_evaluation.report.tables import episode_table
from tpgmm_torch.exceptions import DataError

P_VALUES = st.lists(st.floats(0, 1), min_size=1, max_size=8)


@pytest.mark.parametrize(
    ("one", "other", "p"),
    [
        (0, 0, 1.0),
        (7, 7, 1.0),
        (5, 0, 2 / 32),  # all five heads or all five tails
        (0, 6, 2 / 64),
        (8, 1, 2 * (1 + 9) / 512),
        (3, 1, 2 * (1 + 4) / 16),
    ],
)
def test_mcnemar_gives_what_counting_coins_does(one, other, p):
    assert significance.mcnemar(one, other) == pytest.approx(p)


@given(st.integers(0, 60), st.integers(0, 60))
def test_mcnemar_is_twice_the_smaller_tail(one, other):
    tail = 2 * binom.cdf(min(one, other), one + other, 0.5)
    assert significance.mcnemar(one, other) == pytest.approx(min(1.0, tail))
    assert significance.mcnemar(one, other) == significance.mcnemar(other, one)

    with pytest.raises(DataError, match="-1 and 2 are no numbers"):
        significance.mcnemar(-1, 2)


def test_holm_gives_the_values_of_its_definition():
    # 4 * 0.01; max(that, 3 * 0.02); 2 * 0.04; max(that, 0.045)
    corrected = significance.holm([0.04, 0.01, 0.045, 0.02])
    np.testing.assert_allclose(corrected, [0.08, 0.04, 0.08, 0.06])
    assert significance.holm([]).shape == (0,)


@given(P_VALUES)
def test_holm_rejects_what_stepping_down_does(p_values):
    corrected = significance.holm(p_values)
    for level in (0.01, 0.05, 0.3):
        rejected = set()
        for step, index in enumerate(np.argsort(p_values, kind="stable")):
            if p_values[index] * (len(p_values) - step) > level:
                break
            rejected.add(int(index))
        assert rejected == set(np.flatnonzero(corrected <= level))
    # between no correction and Bonferroni's
    assert (corrected >= np.array(p_values)).all()
    assert (corrected <= np.minimum(1, len(p_values) * np.array(p_values)) + 1e-12).all()


def test_episodes_are_paired_by_training_seed_and_evaluation_seed():
    results = [
        result("tpgmm", 5, [0, 1, 2, 3]),
        result("tpgmm", 5, [4], seed=1),
        result("act", 5, [3, 5]),
        result("act", 5, [4, 6, 7], seed=1),
        result("act", 5, 20, seed=2),  # no such training of the other
        result("act", 10, 20),
        result("nearest", 5, [], seed=1),
    ]
    table = significance.compare_pairs(episode_table(results)).set_index("policy")
    assert list(table.index) == ["act", "nearest"]
    act = table.loc["act"]
    assert (act.pairs, act.successes, act.other_successes) == (40, 5, 5)
    assert (act.only_reference, act.only_other) == (3, 3)
    assert (act.seeds_better, act.seeds_worse, act.seeds) == (1, 1, 2)
    assert (act.p, act.verdict) == (1.0, "level")
    assert (table.loc["nearest"].only_reference, table.loc["nearest"].pairs) == (1, 20)


def test_conditions_are_corrected_apart_from_what_is_nominal():
    results = [
        result("tpgmm", 5, 20),
        result("act", 5, 13),
        result("nearest", 5, 12),
        result("tpgmm", 5, 0, condition="pushes"),
        result("act", 5, 7, condition="pushes"),
    ]
    table = significance.compare_pairs(episode_table(results))
    np.testing.assert_allclose(table.p, [2 / 2**7, 2 / 2**8, 2 / 2**7])
    np.testing.assert_allclose(table.p_holm, [2 / 2**7, 2 * 2 / 2**8, 2 / 2**7])
    assert list(table.verdict) == ["better", "better", "worse"]


def test_without_others_there_is_nothing_to_compare():
    table = significance.compare_pairs(episode_table([result("tpgmm", 5, 20)]))
    assert table.empty and {"p_holm", "verdict", "env"} <= set(table)
    assert isinstance(table, pd.DataFrame)


@pytest.mark.parametrize(
    ("counts", "p", "wanted"),
    [
        ((9, 0), 0.01, "better"),
        ((3, 0), 0.25, "better, not significantly"),
        ((2, 2), 1.0, "level"),
        ((0, 1), 1.0, "worse, not significantly"),
        ((1, 20), 0.001, "worse"),
    ],
)
def test_verdicts(counts, p, wanted):
    assert significance.verdict(*counts, p) == wanted


def test_tasks_count_alike_however_many_pairs_they_have():
    ours, theirs = (20, 20, 15, 20, 10), (5, 10, 15, 5, 15)
    results = []
    for env, one, other in zip("abcde", ours, theirs, strict=True):
        results += [result("tpgmm", 5, one, env=env), result("act", 5, other, env=env)]
    results += [result(policy, 5, 20, seed=1, env="a") for policy in ("tpgmm", "act")]
    [row] = significance.compare_over_tasks(episode_table(results)).itertuples()
    # a: 40 of 40 beside 25
    assert row.differences.to_dict() == {"a": 0.375, "b": 0.5, "c": 0, "d": 0.75, "e": -0.25}
    assert row.difference == pytest.approx(row.success - row.other_success)
    assert row.difference == pytest.approx(0.275)
    assert -0.15 < row.low < 0 < row.difference < row.high < 0.65
    # of 0.25, 0.375, 0.5 and 0.75 the first is negative: 2 of 16 signs are no less one-sided
    assert row.p == pytest.approx(2 * 2 / 16)

    # level in all tasks
    results = [result(policy, 5, 9, env=env) for env in "ab" for policy in ("tpgmm", "act")]
    [row] = significance.compare_over_tasks(episode_table(results)).itertuples()
    assert (row.difference, row.low, row.high, row.p) == (0, 0, 0, 1)

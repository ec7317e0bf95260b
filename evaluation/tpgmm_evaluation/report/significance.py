"""Whether one policy is better than another on the same episodes, or was lucky."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import binomtest, wilcoxon

from lerobot_env_bimanual.disturbances import NOMINAL
from tpgmm_torch.exceptions import DataError

#: The policy with which the others are compared.
REFERENCE = "tpgmm"
#: Corrected p-values below it are called significant.
LEVEL = 0.05
#: What is counted of a comparison, as :func:`compare_pairs` describes it.
COUNTS = [
    *("pairs", "successes", "other_successes", "only_reference", "only_other"),
    *("seeds_better", "seeds_worse", "seeds"),
]
#: Draws of tasks for an interval over tasks.
DRAWS = 10_000
#: What one comparison is about, and what makes two episodes a pair.
PLACE, PAIR = ["env", "demonstrations", "condition"], ["training_seed", "evaluation_seed"]


def mcnemar(only_one: int, only_other: int) -> float:
    """Compute the exact p-value of McNemar's test, two-sided (Psychometrika 12, 1947).

    Pairs in which both succeed or both fail say nothing. Of the others, either is as likely to
    be the one that succeeds if neither is better: a sign test.

    Parameters
    ----------
    only_one, only_other : int
        Pairs in which one alone succeeds, and the other alone.

    Raises
    ------
    DataError
        If one of them is negative.

    Examples
    --------
    >>> mcnemar(5, 0)
    0.0625
    """
    if min(only_one, only_other) < 0:
        raise DataError(f"{only_one} and {only_other} are no numbers of pairs")
    if only_one == only_other:
        return 1.0
    return float(binomtest(only_one, only_one + only_other).pvalue)


def holm(p_values: Sequence[float]) -> NDArray[np.float64]:
    """Correct p-values for how many there are (Holm, Scand. J. Statist. 6, 1979).

    The probability that one or more of them are below a level though there is nothing to be
    found is at most that level, however they depend on one another.

    Parameters
    ----------
    p_values : sequence of float
        Of all tests that were made, not of those that look interesting.

    Returns
    -------
    ndarray of shape (n,)
        In the order given, at most 1.

    Examples
    --------
    >>> holm([0.01, 0.04, 0.03])
    array([0.03, 0.06, 0.06])
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    corrected = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    result = np.empty_like(p)
    result[order] = np.minimum(corrected, 1.0)
    return result


def compare_pairs(episodes: pd.DataFrame, reference: str = REFERENCE) -> pd.DataFrame:
    """Compare every other policy with the reference, wherever both were evaluated.

    Parameters
    ----------
    episodes : DataFrame
        As :func:`~tpgmm_evaluation.report.tables.episode_table` makes it.
    reference : str
        The policy that stands on one side of all comparisons.

    Returns
    -------
    DataFrame
        A row for each environment, number of demonstrations, condition and other ``policy``.
        ``pairs``: episodes of the same training seed and evaluation seed; ``successes`` and
        ``other_successes`` among them; ``only_reference`` and ``only_other``: those that one
        alone solves; ``seeds_better``, ``seeds_worse`` and ``seeds``: training seeds in which
        the reference solves more, or less, and all; ``p`` of :func:`mcnemar`; ``p_holm``,
        corrected by :func:`holm` within all nominal comparisons, and within all disturbed ones;
        ``verdict`` on the reference.
    """
    rows = []
    for place, part in episodes.groupby(PLACE, sort=False):
        ours = part[part.policy == reference]
        for policy, theirs in part[part.policy != reference].groupby("policy", sort=False):
            both = ours.merge(theirs, on=PAIR, suffixes=("", "_other"), validate="1:1")
            if both.empty:
                continue
            gain = both.success.astype(int) - both.success_other.astype(int)
            by_seed = gain.groupby(both.training_seed).sum()
            figures = (
                *(len(both), int(both.success.sum()), int(both.success_other.sum())),
                *(int((gain > 0).sum()), int((gain < 0).sum())),
                *(int((by_seed > 0).sum()), int((by_seed < 0).sum()), len(by_seed)),
            )
            rows.append((*place, policy, *figures))
    table = pd.DataFrame(rows, columns=[*PLACE, "policy", *COUNTS])
    counts = list(zip(table.only_reference, table.only_other, strict=True))
    table["p"] = np.array([mcnemar(*pair) for pair in counts], dtype=float)
    table["p_holm"] = table.p
    for family in (table.condition == NOMINAL, table.condition != NOMINAL):
        table.loc[family, "p_holm"] = holm(table.p[family].to_list())
    table["verdict"] = [verdict(*pair, p) for pair, p in zip(counts, table.p_holm, strict=True)]
    return table


def compare_over_tasks(episodes: pd.DataFrame, reference: str = REFERENCE) -> pd.DataFrame:
    """Compare every other policy with the reference, over many tasks that count alike.

    Parameters
    ----------
    episodes : DataFrame
        As of :func:`compare_pairs`; those of one condition.
    reference : str
        The policy that stands on one side of all comparisons.

    Returns
    -------
    DataFrame
        A row for each other ``policy`` and number of ``demonstrations``, of the pairs of
        episodes that :func:`compare_pairs` compares. ``differences``: a Series over tasks, the
        reference's share of successes less the other's; ``success`` and ``other_success``: the
        means over tasks; ``difference``: of them, with the 95 % interval of other tasks like
        these, ``low`` and ``high`` (percentiles of 10,000 draws of tasks); ``p``: of Wilcoxon's
        signed-rank test over tasks (Biometrics Bulletin 1, 1945), not corrected.
    """
    rows = []
    for (policy, count), part in compare_pairs(episodes, reference).groupby(
        ["policy", "demonstrations"], sort=True
    ):
        part = part.set_index("env")
        ours, theirs = part.successes / part.pairs, part.other_successes / part.pairs
        found = ours - theirs
        drawn = np.random.default_rng(0).choice(found, (DRAWS, len(found))).mean(axis=1)
        low, high = np.percentile(drawn, (2.5, 97.5))
        apart = found[found != 0]
        rows.append(
            {
                "policy": policy,
                "demonstrations": count,
                "differences": found,
                "success": ours.mean(),
                "other_success": theirs.mean(),
                "difference": found.mean(),
                "low": low,
                "high": high,
                "p": wilcoxon(apart).pvalue if len(apart) else 1.0,
            }
        )
    return pd.DataFrame(rows)


def verdict(only_reference: int, only_other: int, p: float) -> str:
    """Judge the reference in a comparison.

    Parameters
    ----------
    only_reference, only_other : int
        Pairs that one alone solves.
    p : float
        Corrected.

    Returns
    -------
    str
        "better" or "worse", with ", not significantly" behind it where that is so, or "level".
    """
    if only_reference == only_other:
        return "level"
    side = "better" if only_reference > only_other else "worse"
    return side if p < LEVEL else f"{side}, not significantly"

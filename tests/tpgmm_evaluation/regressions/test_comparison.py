"""Regressions are found where there are some, and chance and rounding are none."""

import numpy as np
import pytest

from tpgmm_evaluation.regressions.comparison import compare_cells, read_pairs, table


def verdict(kind, before, now, cells=1, name="x"):
    """Why something is worse; the first cell differs, others are equal."""
    one = {f"{kind}:{name}": np.array(before, dtype=float)}
    other = {f"{kind}:{name}": np.array(now, dtype=float)}
    [row] = compare_cells([("group", one, other), *[("group", one, one)] * (cells - 1)])
    return row.worse


SHARES = np.linspace(0.5, 1.5, 20)


@pytest.mark.parametrize(
    ("kind", "before", "now", "cells", "worse"),
    [
        ("same", SHARES, SHARES + 1e-10, 1, ""),
        ("same", SHARES, SHARES + 1e-8, 1, "changed"),
        ("same", SHARES, SHARES[:-1], 1, "not measured, or of another shape"),
        ("success", [1] * 6, [0] * 6, 1, "significantly"),
        ("success", [0] * 6, [1] * 6, 1, ""),
        ("success", [1] * 6, [0] * 6, 10, "on average, by 10.0%"),  # Holm: ten tests
        ("success", [1] * 600, [0] + [1] * 599, 1, ""),  # less than 1 %
        ("error", SHARES, 1.005 * SHARES, 1, "significantly"),
        ("error", SHARES, 0.9 * SHARES, 1, ""),
        ("error", [1.0, np.inf, 2.0], [1.0, 3.0, np.inf], 1, ""),
        ("error", [1.0], [1.02], 1, "on average, by 2.0%"),
        ("error", [0.0], [1e-12], 1, ""),
        ("score", SHARES, 0.9 * SHARES, 1, "significantly"),
        ("score", SHARES, 1.1 * SHARES, 1, ""),
        ("seconds", [1.0], [1.2], 1, ""),
        ("seconds", [1.0], [1.3], 1, "1.30 times as long"),
    ],
)
def test_what_is_worse(kind, before, now, cells, worse):
    assert verdict(kind, before, now, cells) == worse


def test_a_compiled_step_may_hardly_be_slower():
    assert verdict("seconds", [1.0], [1.2], name="step, compiled") == "1.20 times as long"


def test_a_cell_that_is_missing_is_worse_and_groups_are_folders(tmp_path):
    for folder, cells in (("before", ("a/one", "a/two", "alone")), ("now", ("a/one", "a/two"))):
        for cell in cells:
            path = tmp_path / folder / "section" / f"{cell}.npz"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, **{"success:x": np.ones(3)})
    found = compare_cells(read_pairs(tmp_path / "before", tmp_path / "now", ["section"]))
    assert [row.name for row in found] == ["section/a: x", "section/alone: x"]
    assert [row.n for row in found] == [6, 0]
    assert [bool(row.worse) for row in found] == [False, True]
    heading, missing, same, worse = table(found)
    assert "before" in heading and "WORSE: not measured" in missing
    assert (same, worse) == ("1 of 2 quantities are as they were", "1 are worse")

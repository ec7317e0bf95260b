"""Results of cells in files: read as written, in order, and refused where damaged."""

from dataclasses import replace

import pytest

from tpgmm_evaluation.cells import Cell, Results
from tpgmm_torch.exceptions import DataError

CELL = Cell("bottle_shaking", "act", 10, 0)


def test_a_cell_is_found_again_and_others_are_not(tmp_path):
    results = Results(tmp_path)
    assert results.read(CELL) is None
    results.write(CELL, {"episodes": [{"seed": 1, "success": True, "grasp_mm": float("inf")}]})
    assert results.read(CELL)["episodes"][0]["grasp_mm"] == float("inf")
    assert results.read(replace(CELL, condition="pushes")) is None
    assert [path.name for path in tmp_path.iterdir()] == [f"{CELL.key}.json"]


def test_damage_is_detected(tmp_path):
    results = Results(tmp_path)
    results.write(CELL, {"episodes": [{"seed": 1, "success": False}]})
    path = results.path(CELL)
    whole = path.read_text()
    for damaged, message in (
        (whole[: len(whole) // 2], "not the result"),
        ("[]", "not the result"),
        (whole.replace("false", "true"), "was changed"),
    ):
        path.write_text(damaged)
        with pytest.raises(DataError, match=message):
            results.read(CELL)
        said = []
        assert results.read_all(said.append) == []
        assert message in said[0]
    other = replace(CELL, seed=1)
    results.path(other).write_text(whole)
    with pytest.raises(DataError, match="another cell"):
        results.read(other)


def test_results_come_in_natural_order(tmp_path):
    results = Results(tmp_path)
    for count in (10, 5, 25):
        results.write(replace(CELL, demonstrations=count), {})
    counts = [result["cell"]["demonstrations"] for result in results.read_all(print)]
    assert counts == [5, 10, 25]


def test_settings_of_a_policy_share_a_training_and_not_a_result(tmp_path):
    given = "tpgmm --policy.control.feedback=observation --policy.units=a/b"
    policies = ("tpgmm", "tpgmm-open-loop", given)
    cells = [replace(CELL, policy=policy) for policy in policies]
    assert len({cell.training for cell in cells}) == 1
    assert len({cell.key for cell in cells}) == 3
    assert "/" not in cells[2].key and " " not in cells[2].key
    Results(tmp_path).write(cells[2], {})
    assert Results(tmp_path).read(cells[2])["cell"]["policy"] == given

"""Measurements are kept, go on where they were stopped, and say the same twice."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.support.comparison import result
from tpgmm_evaluation.cells import Cell, Results
from tpgmm_evaluation.compare import Comparison
from tpgmm_evaluation.regressions import sections
from tpgmm_evaluation.regressions.__main__ import main
from tpgmm_evaluation.regressions.goldens import GOLDENS
from tpgmm_evaluation.regressions.plan import Plan
from tpgmm_evaluation.regressions.sections import SECTIONS, measure
from tpgmm_evaluation.regressions.sensitivity import sensitivity
from tpgmm_torch.exceptions import DataError

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
#: Of the section that stands for all.
VALUE = 3.0


@pytest.fixture
def calls(monkeypatch):
    """Names of the cells that were measured, of a section that the others are replaced by."""
    taken = []

    def cell(name):
        taken.append(name)
        if name == "broken":
            raise DataError("no such thing")
        return {"score:value": np.full(8, VALUE), "seconds:time": np.ones(1)}

    names = {"good": ("a", "b"), "bad": ("c", "broken")}
    for section in list(SECTIONS):
        monkeypatch.delitem(SECTIONS, section)
    for section, cells in names.items():
        each = lambda plan, cells=cells: ((name, partial(cell, name)) for name in cells)  # noqa: E731
        monkeypatch.setitem(SECTIONS, section, each)
    return taken


def test_cells_are_measured_once_and_failures_are_reported(calls, tmp_path):
    plan = Plan(tmp_path)
    assert measure(plan, ["bad", "good"]) == ["bad: DataError: no such thing"]
    assert calls == ["c", "broken", "a", "b"]
    measure(plan, ["bad", "good"])
    assert calls[4:] == ["broken"]
    assert np.load(tmp_path / "good" / "a.npz")["score:value"].shape == (8,)


def test_the_command_compares_what_it_measured(calls, tmp_path, monkeypatch, capsys):
    command = ["--small", "--out", str(tmp_path)]
    assert main(["baseline", *command, "--only", "good"]) == 0
    assert main(["compare", *command, "--only", "good"]) == 0
    monkeypatch.setitem(globals(), "VALUE", 2.0)
    assert main(["compare", *command, "--only", "good"]) == 0  # kept
    assert main(["compare", *command, "--only", "good", "--again"]) == 1
    assert "good/a: value" in capsys.readouterr().out
    assert main(["baseline", *command]) == 1
    with pytest.raises(SystemExit):
        main(["compare", "--only", "nothing"])


@pytest.mark.filterwarnings(
    "ignore::tpgmm_torch.exceptions.PlausibilityWarning"
)  # of single steps
def test_golden_references_say_the_same_twice(tmp_path):
    plan = Plan(tmp_path, small=True, root=ROOT)
    once, again = (GOLDENS["planted"](plan) for _ in range(2))
    assert all(np.array_equal(once[name], again[name]) for name in once)
    assert once["same:references"].shape[0] == 10


def test_sections_find_what_they_measure_with(tmp_path):
    plan = Plan(tmp_path, small=True, root=ROOT, data=tmp_path)
    named = ("goldens", "mistakes", "demo", "times", "recordings", "reach")
    found = {section: [name for name, _ in SECTIONS[section](plan)] for section in named}
    assert found["recordings"] == [] and found["goldens"] == list(GOLDENS)
    assert all(found[section] for section in set(named) - {"recordings"})


def test_rollouts_are_compared_episode_by_episode(tmp_path, monkeypatch):
    def compare(settings, out, policies, counts, *_):
        for n in counts:
            for cell in (("tpgmm", "nominal"), ("nearest", "nominal"), ("tpgmm", "moved")):
                found = result(cell[0], n, n, cell[1])
                Results(out / "bottle_shaking" / "cells").write(Cell(**found["cell"]), found)
        return Comparison(2, {})

    monkeypatch.setattr(sections, "compare", compare)
    plan = Plan(tmp_path, small=True)
    cells = dict(sections.rollouts(("bottle_shaking",), ("tpgmm",), False, plan))
    assert sorted(cells) == [f"tpgmm-n{n}/bottle_shaking-s0-nominal" for n in (10, 3)]
    for n in (3, 10):
        measured = cells[f"tpgmm-n{n}/bottle_shaking-s0-nominal"]()
        assert measured["success:success"].sum() == n
        assert "error:grasp_mm" in measured and "error:lift_mm" not in measured


def test_a_constant_is_tried_at_other_values(tmp_path):
    """In a copy of its package, whatever took its value when it was loaded."""
    plan = Plan(tmp_path, root=ROOT)
    constant = "tpgmm_torch.regression.prior:PRIOR_STD"
    assert not measure(Plan(tmp_path / "usual" / "baseline-small", True, ROOT), ["mistakes"])
    [row] = sensitivity(constant, plan, ["mistakes"], [2.0])
    assert row.startswith(f"{constant} = 20 (usually 10): ") and "share +0" in row
    with pytest.raises(DataError, match="MODULE:NAME"):
        list(sensitivity("tpgmm_torch.regression.prior:prior_widths", plan, ["mistakes"]))

"""The benchmarks run and fill their table; how fast anything is, is not tested."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.obstacle_scenes import KINDS, examine_scene, summarize
from benchmarks.points import BLOCKS, Problem, motions
from benchmarks.roofline import flops_of_iteration
from benchmarks.rows import Asked, Omitted, Row, format_table
from benchmarks.settings import CASES, Settings
from benchmarks.timing import in_turns, medians, per_iteration

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


def bench(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benchmarks", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def reports(tmp_path_factory) -> dict[str, dict]:
    """What every case found at tiny sizes."""
    out = tmp_path_factory.mktemp("bench")
    done = bench("--sizes", "tiny", "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    files = {f"{name}.json" for name in CASES} | {"results.md", "cost.png"}
    assert {path.name for path in out.iterdir()} == files
    table = (out / "results.md").read_text("utf-8")
    found = {name: json.loads((out / f"{name}.json").read_text("utf-8")) for name in CASES}
    assert all(row["work"] in table for row in found["step"]["rows"])
    return found


@pytest.mark.parametrize("name", CASES)
def test_a_case_measures_finite_figures_and_says_where(reports, name):
    report = reports[name]
    assert report["rows"]
    for row in report["rows"]:
        assert "omitted" not in row, row
        assert math.isfinite(row["ours"])
        assert math.isfinite(0.0 if row["competitor"] == "" else row["theirs"])
        assert row["asked"] is None  # nothing is to be reached at such sizes
    assert report["sizes"] == "tiny"
    assert report["machine"]["threads"] == 1
    assert report["machine"]["versions"]["scikit-learn"]


def test_a_case_can_be_measured_alone_and_others_do_not_exist(tmp_path):
    done = bench("--sizes", "tiny", "--out", tmp_path, "--only", "fast")
    assert done.returncode == 2
    assert "no such case: ['fast']; there are ['import', " in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("asked", "ours", "reached"), [
    (Asked("faster", 5), 2.0, True),
    (Asked("faster", 5), 2.1, False),
    (Asked("times", 1.5), 15.0, True),
    (Asked("times", 1.5), 15.1, False),
    (Asked("most", 3), 3.0, True),
    (Asked("most", 3), 3.1, False),
    (None, 3.0, None),
])  # fmt: skip
def test_rows_say_whether_a_figure_was_reached(asked, ours, reached):
    row = Row("work", "s", ours, "other", 10.0, asked)
    assert row.is_reached is reached
    assert row.ratio == pytest.approx(10 / ours)
    mark = {None: "| |", True: "yes", False: "**no**"}[reached]
    assert mark.replace(" ", "") in format_table([row.record()]).replace(" ", "")


def test_a_ratio_needs_a_competitor():
    with pytest.raises(ValueError, match="no competitor"):
        Row("work", "s", 1.0, asked=Asked("faster", 2)).record()


def test_what_was_left_out_is_said():
    table = format_table([Omitted("this", "no such package").record()])
    assert "- not measured: this: no such package" in table


def test_an_iteration_is_the_difference_of_two_fits(monkeypatch):
    clock = iter([0.0, 5.0, 10.0, 18.0])
    monkeypatch.setattr("benchmarks.timing.perf_counter", lambda: next(clock))
    counts = []
    assert per_iteration(counts.append, 2, 5)() == 1.0
    assert counts == [2, 5]


def test_measurements_take_turns():
    order = []
    first = lambda: order.append("a") or len(order)  # noqa: E731
    second = lambda: order.append("b") or len(order)  # noqa: E731
    taken = in_turns({"a": first, "b": second}, 3, {"b": 2})
    assert "".join(order) == "ababa"
    assert medians(taken) == {"a": 3, "b": 3}


def test_the_same_mixture_is_where_all_libraries_start():
    problem = Problem.of(motions(2_600), 4)
    points, means, covariances = problem.join_blocks()
    assert points.shape == (2_600, sum(BLOCKS))
    assert means[:, :15] == pytest.approx(problem.means[0])
    assert covariances[:, 15:, 15:] == pytest.approx(problem.covariances[1])
    assert not covariances[:, :15, 15:].any()
    assert problem.weights.sum() == pytest.approx(1)


def test_shuffled_times_are_the_same_in_all_blocks():
    problem = Problem.of(motions(2_600), 4)
    shuffled = problem.shuffle_times()
    assert (shuffled.points[:, 0] == shuffled.points[:, 15]).all()
    assert sorted(shuffled.points[:, 0]) == sorted(problem.points[:, 0])
    assert (shuffled.points[:, 1:15] == problem.points[:, 1:15]).all()


def test_arithmetic_is_that_of_the_packed_features():
    assert flops_of_iteration(10, 3, BLOCKS) == 4 * 325 * 3 * 10


def test_sizes_and_rounds():
    full, tiny = Settings(True, Path()), Settings(False, Path())
    assert (full.size(9, 2), full.rounds(5)) == (9, 5)
    assert (tiny.size(9, 2), tiny.rounds(5)) == (2, 1)
    assert Settings(False, Path(), repeat=4).rounds(5) == 4


def test_scenes_in_the_way_are_drawn_and_references_keep_clear_of_them():
    found = [
        examine_scene(number, 0.04) for number in (KINDS.index("ball"), KINDS.index("carried"))
    ]
    for one in found:
        assert one["bare_mm"] < 0 < one["kept_mm"]
        assert one["bounds"] <= 1 + 1e-6
        assert one["finished"] or one["reason"].startswith("blocked by ")
    assert "2 without, 0 with" in "\n".join(summarize(found))

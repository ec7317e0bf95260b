"""The report and its pictures, from given results."""

import pytest

from tests.support.comparison import DISTURBED, RESULTS
from tpgmm_evaluation.cells import Cell
from tpgmm_evaluation.report.report import write_report
from tpgmm_evaluation.settings import Settings

SETTINGS = Settings(episodes=20, budget=120.0)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    failures = {Cell("bottle_shaking", "diffusion", 5, 0): "bad luck"}
    write_report(folder, SETTINGS, RESULTS + DISTURBED, failures)
    return (folder / "report.md").read_text()


@pytest.mark.parametrize(
    "line",
    [
        # conditions
        '- `pushes+noise`: `{"pushes": true}`. `{"noise": 1.0}`.',
        "- `stopped-3`: The drives stop, and hold the joints where they are: a protective",
        "| nominal | tpgmm | 20/20 = 100 % (84 to 100 %) | 1.0 / 1.0 |",
        "| stopped-3 | tpgmm-open-loop | 2/20 = 10 % (3 to 30 %) | inf / inf |",
        "| pushes+noise | tpgmm | 17/20 = 85 % (64 to 95 %) | 1.0 / inf |",
        "- **tpgmm --policy.control.blend=0**: tpgmm with `control.blend=0`",
        "played by the clock with what is seen at the start, as in 0.1.0",
        # criteria, at ten demonstrations
        "| act | 90 % | 100 % | 100 % | 100 % | 50 % |",
        # errors
        "| 10 | act | 1.0 / inf | ",
        # training
        "| act | 5 | 0 | 600 | 0.5 | 20.00 | 400 | it stopped falling |",
        # remarks
        "- The budget ended the training of act (10: the error fell by 67 %); in brackets",
        "- `bottle_shaking-diffusion-n5-s0-nominal`: bad luck",
        "lerobot-eval --policy.path=policies/NAME --policy.device=cpu --env.type=bottle_",
    ],
)
def test_the_report_says(report, line):
    assert line in report


def test_a_report_names_the_cells_that_failed(tmp_path):
    failed = Cell("bottle_shaking", "tpgmm", 3, 0)
    path = write_report(tmp_path, SETTINGS, [], {failed: "bad luck"})
    assert f"- `{failed.key}`: bad luck" in path.read_text()


def test_variants_stand_behind_what_they_vary(report):
    conditions = report.partition("## Conditions")[2].partition("## ")[0]
    rows = [row.split(" | ")[:2] for row in conditions.splitlines() if row.startswith("| ")]
    assert [" ".join(row).strip("| ") for row in rows if "---" not in row[0]][-4:] == [
        "stopped-3 tpgmm",
        "stopped-3 tpgmm --policy.control.blend=0",
        "stopped-3 tpgmm-open-loop",
        "pushes+noise tpgmm",
    ]

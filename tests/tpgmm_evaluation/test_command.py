"""``tpgmm compare`` as it is called."""

import pytest

from lerobot_env_bimanual.suite.names import SUITE
from tests.support.command_line import output, refusal, run
from tpgmm_evaluation import compare as module
from tpgmm_evaluation.benchmarks import BENCHMARKS
from tpgmm_evaluation.cells import Cell
from tpgmm_evaluation.compare import Comparison


def test_help_is_complete_and_mistakes_are_one_line(tmp_path):
    text = " ".join(output("compare", "--help-all").split())
    for word in ("--budget", "--conditions", "everything", "lerobot-eval", "-phase"):
        assert word in text
    for arguments, said in (
        (["--policies", "bc"], "policy 'bc' is not in the comparison"),
        (["--demonstrations", "5;6"], "numbers like 5,10,25"),
        (["--conditions", "rain"], "disturbance 'rain'"),
        (
            ["--env", "carry_and_put,moon"],
            "environment 'moon' is not in the comparison; it has ['aloha_ins",
        ),
        (["--report-only"], "holds no comparison"),
    ):
        assert said in refusal("compare", *arguments, "--out", tmp_path / "out")
    result = run("compare", "--demonstrations", "101", "--out", tmp_path / "out")
    assert result.exit_code == 2 and "offers 100 demonstrations" in result.stderr


@pytest.fixture
def called(monkeypatch):
    """The arguments of a comparison that is not made."""
    given = []

    def compare(*arguments):
        given.extend(arguments)
        return Comparison(0, {})

    monkeypatch.setattr(module, "compare", compare)
    return given


BOTH = ["--policies", "tpgmm,act"]


@pytest.mark.parametrize(
    ("arguments", "policies", "conditions"),
    [
        (BOTH, ["tpgmm", "act"], ["nominal"]),
        (
            [*BOTH, "--conditions", "nominal,stopped-3"],
            ["tpgmm", "tpgmm-open-loop", "act"],
            ["nominal", "stopped-3"],
        ),
        (["--policies", "act", "--conditions", "all"], ["act"], ["all"]),
    ],
)
def test_disturbed_policies_stand_beside_the_open_loop(
    arguments, policies, conditions, tmp_path, called
):
    assert run("compare", *arguments, "--out", tmp_path).exit_code == 0
    assert called[2] == policies and called[5] == conditions


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("carry_and_put", ["carry_and_put"]),
        ("carry_and_put,aloha_state,carry_and_put", ["carry_and_put", "aloha_state"]),
        ("suite", ["bottle_shaking", "carry_and_put", *SUITE]),
        ("suite-viperx", [f"{task}-viperx" for task in SUITE]),
        ("suite-g1", [f"{task}-g1" for task in SUITE]),
        ("aloha_state,all", ["aloha_state", *(n for n in BENCHMARKS if n != "aloha_state")]),
    ],
)
def test_environments_have_names_together(given, meant, tmp_path, called):
    arguments = ("--env", given, "--policies", "quick", "--demonstration-seed", 4)
    assert run("compare", *arguments, "--out", tmp_path).exit_code == 0
    assert [settings.env for settings in called[0]] == meant
    assert {settings.demonstration_seed for settings in called[0]} == {4}
    assert {"tpgmm", "nearest"} <= set(called[2])
    assert not {"act", "diffusion", "tpgmm-places"} & set(called[2])


def test_a_failing_cell_gives_exit_code_1(tmp_path, monkeypatch):
    failed = Comparison(1, {Cell("bottle_shaking", "tpgmm", 3, 0): "bad luck"})
    monkeypatch.setattr(module, "compare", lambda *_: failed)
    result = run("compare", "--out", tmp_path)
    assert result.exit_code == 1 and "1 cells failed" in result.stderr

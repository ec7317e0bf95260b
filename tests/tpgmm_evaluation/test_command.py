"""``tpgmm compare`` as it is called."""

import pytest

from lerobot_env_bimanual.suite.names import SUITE
from tests.support.command_line import output, refusal, run
from tpgmm_evaluation import compare as module
from tpgmm_evaluation.benchmarks import BENCHMARKS
from tpgmm_evaluation.cells import Cell
from tpgmm_evaluation.compare import Comparison


def test_help_is_complete_and_mistakes_are_one_line(tmp_path):
    text = output("compare", "--help-all")
    for word in ("--budget", "--conditions", "everything", "lerobot-eval", "-phase"):
        assert word in " ".join(text.split())
    out = ("--out", tmp_path / "out")
    assert "policy 'bc' is not in the comparison" in refusal(
        "compare", "--policies", "bc", *out
    )
    assert "numbers like 5,10,25" in refusal("compare", "--demonstrations", "5;6", *out)
    assert "disturbance 'rain'" in refusal("compare", "--conditions", "rain", *out)
    assert "environment 'moon' is not in the comparison; it has ['aloha_ins" in refusal(
        "compare", "--env", "carry_and_put,moon", *out
    )
    assert "holds no comparison" in refusal("compare", "--report-only", *out)
    result = run("compare", "--demonstrations", "101", *out)
    assert result.exit_code == 2
    assert "offers 100 demonstrations" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "policies", "conditions"),
    [
        (["--policies", "tpgmm,act"], ["tpgmm", "act"], ["nominal"]),
        (
            ["--policies", "tpgmm,act", "--conditions", "nominal,stopped-3"],
            ["tpgmm", "tpgmm-open-loop", "act"],
            ["nominal", "stopped-3"],
        ),
        (
            ["--policies", "act", "--conditions", "all"],
            ["act"],
            ["all"],
        ),
    ],
)
def test_disturbed_policies_stand_beside_the_open_loop(
    arguments, policies, conditions, tmp_path, monkeypatch
):
    called = []
    monkeypatch.setattr(
        module, "compare", lambda *given: called.extend(given) or Comparison(0, {})
    )
    assert run("compare", *arguments, "--out", tmp_path).exit_code == 0
    assert called[2] == policies
    assert called[5] == conditions


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
def test_environments_have_names_together(given, meant, tmp_path, monkeypatch):
    called = []
    monkeypatch.setattr(
        module, "compare", lambda *given: called.extend(given) or Comparison(0, {})
    )
    arguments = ("--env", given, "--policies", "quick", "--demonstration-seed", 4)
    assert run("compare", *arguments, "--out", tmp_path).exit_code == 0
    assert [settings.env for settings in called[0]] == meant
    assert {settings.demonstration_seed for settings in called[0]} == {4}
    assert {"tpgmm", "nearest"} <= set(called[2])
    assert not {"act", "diffusion", "tpgmm-places"} & set(called[2])


def test_a_failing_cell_gives_exit_code_1(tmp_path, monkeypatch):
    monkeypatch.setattr(
        module,
        "compare",
        lambda *_: Comparison(1, {Cell("bottle_shaking", "tpgmm", 3, 0): "bad luck"}),
    )
    result = run("compare", "--out", tmp_path)
    assert result.exit_code == 1
    assert "1 cells failed" in result.stderr

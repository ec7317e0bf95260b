"""``tpgmm sequence``: models joined to one, and to one policy."""

import pytest

from tests.support.command_line import output, refusal
from tests.support.fetching import skills
from tpgmm_torch import load, save


def test_models_are_joined(tmp_path):
    for name, skill in skills().items():
        save(skill, tmp_path / name)
    text = f"{tmp_path}/pick until held retry 2, {tmp_path}/home until arrived"
    out = tmp_path / "all"
    lines = output("sequence", text, "--out", out, "--timeout", 1.5).splitlines()
    assert lines[0] == "  2.00 s  end of pick: held, 2 retries" and str(out) in lines[-1]
    assert [gate.until for gate in load(out).gates] == [("held",), ("arrived",)]
    assert load(out).timeout == 1.5
    said = refusal("sequence", f"{tmp_path}/lift, {tmp_path}/home", "--out", tmp_path / "no")
    assert "lift is not a saved model" in said and not (tmp_path / "no").exists()


def test_a_sequence_is_one_policy(dataset, bottle_model, tmp_path):
    pytest.importorskip("lerobot")  # `make oldest` is without it
    from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy

    text, out = f"{bottle_model[0]} until arrived retry 1", tmp_path / "policy"
    assert "--dataset" in refusal("sequence", text, "--out", out, "--format", "lerobot")
    options = "--format", "lerobot", "--dataset", dataset, "--out", out
    output("sequence", text, *options)
    policy = TPGMMPolicy.from_pretrained(out)
    assert [gate.until for gate in policy.skill.gates] == [("arrived",)]

"""``tpgmm demo``: the experiment in small, and its table."""

import json

from tests.support.command_line import output

PNG = b"\x89PNG"


def test_demo_runs_the_experiment_and_prints_a_table_of_80_columns(tmp_path):
    out = tmp_path / "demo"
    small = ("--n-components", 12, "--n-demonstrations", 3, "--n-situations", 2, "--rate", 12)
    text = output("demo", "--out", out, *small)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["settings"]["n_components"] == 12
    assert "learning, K = 12 ...\n" in text
    for name in ("TP-GMM, K = 12", "TP-GMM, K = 10", "eqs (1), (2), 1e-06", "without orient"):
        assert name in text
    assert f"in {out}" in text
    lines = text.splitlines()
    [title] = [i for i, line in enumerate(lines) if "95th percentile" in line]
    assert max(len(line.rstrip()) for line in lines[title : title + 12]) <= 80
    commands = [line.split() for line in lines if line.startswith("  tpgmm ")]
    assert [words[1] for words in commands] == ["view", "report", "fit"]
    assert "…" not in text
    for folder in ("dataset", "model"):
        assert (out / folder).is_dir()
    assert (out / "figure_3.png").read_bytes().startswith(PNG)

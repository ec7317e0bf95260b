"""``tpgmm plot``: pictures of a model."""

import pytest

from tests.support.command_line import output, refusal


@pytest.mark.parametrize(("form", "magic"), [("png", b"\x89PNG"), ("pdf", b"%PDF")])
def test_plot_draws_each_operator_and_the_chosen_joints(form, magic, dataset, fitted, tmp_path):
    printed = output(
        "plot",
        fitted[0],
        "--dataset",
        dataset,
        "--joint",
        "l_elbow",
        "--out",
        tmp_path / "p",
        "--format",
        form,
    ).split()
    names = [f"{name}.{form}" for name in ("operator_1", "operator_2", "joint_l_elbow")]
    assert printed == [str(tmp_path / "p" / name) for name in names]
    for name in names:
        assert (tmp_path / "p" / name).read_bytes().startswith(magic)


def test_unknown_joints_are_refused(dataset, fitted, tmp_path):
    where = ("--dataset", dataset, "--out", tmp_path / "p")
    line = refusal("plot", fitted[0], "--joint", "knee", *where)
    assert "joint 'knee' is not in the model" in line

"""``tpgmm plot``: pictures of a model."""

from tests.support.command_line import output, refusal


def test_plot_draws_each_operator_and_the_chosen_joints(dataset, bottle_model, tmp_path):
    given = "--dataset", dataset, "--joint", "l_elbow", "--out", tmp_path / "p"
    printed = output("plot", bottle_model[0], *given, "--format", "pdf").splitlines()
    names = ["operator_1.pdf", "operator_2.pdf", "joint_l_elbow.pdf"]
    assert printed == [str(tmp_path / "p" / name) for name in names]
    for name in names:
        assert (tmp_path / "p" / name).read_bytes().startswith(b"%PDF")


def test_unknown_joints_are_refused(dataset, bottle_model, tmp_path):
    where = ("--dataset", dataset, "--out", tmp_path / "p")
    line = refusal("plot", bottle_model[0], "--joint", "knee", *where)
    assert "joint 'knee' is not in the model" in line

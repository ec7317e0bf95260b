"""``tpgmm plot``: pictures of a model."""

from tests.support.command_line import output, refusal

PNG = b"\x89PNG"


def test_plot_draws_each_operator_and_the_chosen_joints(dataset, fitted, tmp_path):
    printed = output(
        "plot", fitted[0], "--dataset", dataset, "--joint", "l_elbow", "--out", tmp_path / "p"
    ).split()
    names = ["operator_1.png", "operator_2.png", "joint_l_elbow.png"]
    assert printed == [str(tmp_path / "p" / name) for name in names]
    for name in names:
        assert (tmp_path / "p" / name).read_bytes().startswith(PNG)


def test_unknown_joints_are_refused(dataset, fitted, tmp_path):
    where = ("--dataset", dataset, "--out", tmp_path / "p")
    line = refusal("plot", fitted[0], "--joint", "knee", *where)
    assert "joint 'knee' is not in the model" in line

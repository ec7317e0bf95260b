"""Options made from signatures, in groups, and what their texts mean."""

import inspect

import pytest
import typer
from typer.testing import CliRunner

from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_tools.arguments import options
from tpgmm_torch import TaskParameterizedGMM


class Made:
    """Something.

    Parameters
    ----------
    share : float, default=0.5
        How much, see :func:`~tpgmm.other`. More than a help needs.
    kind, other : str
        Of both ``kinds`` [m].
    strict : bool
    """

    def __init__(self, share=0.5, kind="a", other=None, strict=False):
        pass


def test_options_follow_signature_and_docstring():
    app, given = typer.Typer(), {}

    @options.command(app, "tpgmm made", options.options_of(Made, "Made", {"other"}))
    def made(place, *, data: options.DataOptions, count_: int = 2, **settings):
        """Make one.

        Parameters
        ----------
        place : ``DIR``
            Where.
        count_ : int >= 1
            How many.
        """
        given.update(settings, place=place, count=count_, rate=data.rate, frames=data.frame)

    def run(*arguments):
        return CliRunner().invoke(app, arguments)

    assert run("out", "--share", "1e-3", "--kind", "auto", "--strict").exit_code == 0
    assert given == {
        "share": 0.001, "kind": "auto", "strict": True, "rate": None, "frames": None,
        "place": "out", "count": 2,
    }  # fmt: skip
    assert run("out", "--frame", "a", "--frame", "b", "--count", "3").exit_code == 0
    assert (given["frames"], given["count"], given["share"]) == (["a", "b"], 3, 0.5)
    assert run("out", "--count", "0").exit_code == 2
    text = " ".join(run("--help-all").output.split())
    assert "How much, see tpgmm.other. [default: 0.5]" in text
    assert "Of both kinds [m]." in text and "--other" not in text
    assert "Make one." in text and "Usage: made DIR [OPTIONS]" in text
    assert "Parameters" not in text
    short = run("--help").output
    assert "--frame NAME[=SOURCE]" in short and "--share" not in short


@pytest.mark.parametrize(
    ("text", "value"), [("auto", "auto"), ("3", 3), ("1e-4", 1e-4), ("None", None)]
)
def test_values_are_numbers_or_words(text, value):
    assert options.value(text) == value


def test_fit_has_the_estimators_defaults():
    from tpgmm_tools.cli.fit import SETTINGS, fit

    estimator = inspect.signature(TaskParameterizedGMM).parameters
    shared = {one.name: one.default for one in SETTINGS}
    shared["n_components"] = inspect.signature(fit).parameters["n_components"].default
    assert {"tol", "reg_covar", "covariance_type"} <= shared.keys()
    assert shared == {name: estimator[name].default for name in shared}


def test_robots_are_files_of_either_format_or_come_with_the_package(tmp_path):
    body = '<body name="hand"><joint name="lift"/><geom size="0.1"/></body>'
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    (tmp_path / "body.urdf").write_text(upper_body_urdf())
    read = options.RobotOptions
    assert read([str(tmp_path / "arm.xml")], ["hand"]).read().joint_names == ("lift",)
    body = read([str(tmp_path / "body.urdf")], ["l_hand"], ["l_*"], ["grip"]).read()
    assert body.joint_names[-2:] == ("l_wrist_roll", "grip")
    two = read(["left=so101@0,0.2,0", f"body={tmp_path / 'body.urdf'}@0,0,1"]).read()
    assert two.links == ("left_gripper_frame_link", "body_l_hand", "body_r_hand")
    assert read().read() is None

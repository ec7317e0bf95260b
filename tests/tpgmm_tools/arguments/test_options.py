"""Options made from signatures, in groups, and what their texts mean."""

import inspect
from dataclasses import asdict, dataclass
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_tools.arguments import options
from tpgmm_tools.cli.fit import ModelOptions
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, InformationFusion


@dataclass(frozen=True)
class Group:
    """Made.

    Parameters
    ----------
    share : float
        How much, see :func:`~tpgmm.other`. All of it.
    kind : ``KIND``
        Of both ``kinds`` [m].
    strict : bool
        Refuse more.
    """

    share: float = 0.5
    kind: Any = "a"
    strict: bool = False


def test_options_follow_signature_and_docstring():
    app, given = typer.Typer(), {}

    @options.command(app, "tpgmm made")
    def made(place, *, data: options.DataOptions, group: Group, count_: int = 2):
        """Make one.

        Parameters
        ----------
        place : ``DIR``
            Where.
        count_ : int >= 1
            How many.
        """
        given.update(vars(group), place=place, count=count_, rate=data.rate, frames=data.frame)

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
    assert "Made: --share NUMBER How much, see tpgmm.other. All of it. [default: 0.5]" in text
    assert "--kind KIND Of both kinds [m]." in text and "Parameters" not in text
    assert "Make one." in text and "Usage: made DIR [OPTIONS]" in text
    short = run("--help").output
    assert "--frame NAME[=SOURCE]" in short and "--share" not in short


@pytest.mark.parametrize(
    ("text", "value"), [("auto", "auto"), ("3", 3), ("1e-4", 1e-4), ("None", None)]
)
def test_values_are_numbers_or_words(text, value):
    assert options.value(text) == value


def test_fit_has_the_estimators_parameters_and_defaults():
    """They are stated once more, so that the help loads no estimator."""
    estimator = inspect.signature(TaskParameterizedGMM).parameters.items()
    shared = {
        name: one.default for name, one in estimator if name not in ("operators", "robot")
    }
    chosen = ("parts", "modes", "epsilon")
    stated = {name: one for name, one in asdict(ModelOptions()).items() if name not in chosen}
    made = ModelOptions().model([], None)
    assert stated == shared | {"fusion": "information", "random_state": 0}
    assert made.fusion == InformationFusion()
    covariance = ModelOptions(fusion="covariance", epsilon=0.1).model([], None).fusion
    assert covariance == CovarianceFusion(0.1)


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

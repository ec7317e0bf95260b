"""What is found by entry points: formats of models, readers, robots, tables."""

from importlib.metadata import EntryPoint

import pytest

from tests.support.command_line import refusal
from tpgmm_datasets.commands.recordings import Recordings
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_tools.cli import plugins
from tpgmm_tools.cli.options import read_robot
from tpgmm_torch.exceptions import DataError, DependencyError


def sketch(model, path, signals):
    """A format of a plugin."""


def test_plugins_add_formats(monkeypatch):
    found = [
        EntryPoint("sketch", f"{__name__}:sketch", plugins.FORMATS),
        EntryPoint("gone", f"{__name__}_gone:sketch", plugins.FORMATS),
    ]
    monkeypatch.setattr(plugins, "entry_points", lambda group: found)
    assert plugins.model_format("tpgmm") is None
    assert plugins.model_format("sketch").__doc__ == sketch.__doc__
    with pytest.raises(DependencyError, match=r"the plugin of format 'gone'.*cannot be loaded"):
        plugins.model_format("gone")
    with pytest.raises(DataError, match=r"there are \['gone', 'sketch', 'tpgmm'\]"):
        plugins.model_format("onnx")


def test_what_this_distribution_registers_is_there():
    assert {"dataset", "demo"} <= plugins.registered(plugins.COMMANDS).keys()
    assert plugins.required(plugins.READERS, "lerobot") is Recordings
    assert plugins.required(plugins.ROBOTS, "upper_body") is upper_body_urdf


def test_robots_are_files_of_either_format(tmp_path):
    body = '<body name="hand"><joint name="lift"/><geom size="0.1"/></body>'
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    (tmp_path / "body.urdf").write_text(upper_body_urdf())
    assert read_robot(str(tmp_path / "arm.xml"), ["hand"]).joint_names == ("lift",)
    body = read_robot(str(tmp_path / "body.urdf"), ["l_hand"], ["l_*"], ["grip"])
    assert body.joint_names[-2:] == ("l_wrist_roll", "grip")


def test_an_installation_that_is_older_than_the_code_is_pointed_out(monkeypatch, tmp_path):
    monkeypatch.setattr(plugins, "entry_points", lambda group: [])
    line = refusal("fit", "x", "--out", tmp_path / "y")
    assert "registers 'lerobot' in 'tpgmm.readers': install 'tpgmm-torch[cli]' again" in line
    assert "No such command 'demo'" in refusal("demo")

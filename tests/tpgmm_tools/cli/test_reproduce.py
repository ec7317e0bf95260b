"""``tpgmm reproduce``: the files that it writes."""

import json
import re

import numpy as np
import pytest
import torch

from tests.support.command_line import output, refusal, run
from tpgmm_control.loop.rollout import rollout
from tpgmm_datasets import load_lerobot
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_datasets.tables import demonstrations_from_frame, read_table
from tpgmm_torch import Situation
from tpgmm_torch.persistence import load_model


@pytest.mark.parametrize("suffix", ["parquet", "csv"])
def test_reproductions_of_a_data_set_are_those_of_the_model(
    dataset, bottle_model, tmp_path, suffix
):
    out = tmp_path / "new" / f"r.{suffix}"
    printed = output(
        "reproduce", bottle_model[0], "--dataset", dataset, "--episodes", "1:3", "--out", out
    ).splitlines()
    assert len(printed) == 3
    assert all("rad/s^2" in line and "limit" in line for line in printed[:2])
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    model = load_model(bottle_model[0])
    shown = load_lerobot(dataset, robot=model.kinematics_)[1:]
    situations = [Situation.of(one) for one in shown]
    expected = rollout(model.skill, situations, bounds="robot", blend=1.0)
    table = read_table(out)
    for found, one in zip(demonstrations_from_frame(table), expected, strict=True):
        assert set(found.frames) == {"bottle"}
        assert list(found.joint_names) == list(model.kinematics_.joint_names)
        np.testing.assert_allclose(found.joints, one.joints, atol=1e-9)
    name = f"covariance.{model.kinematics_.joint_names[0]}.{model.kinematics_.joint_names[1]}"
    entries = np.concatenate([one.covariance[:, 0, 1] for one in expected])
    np.testing.assert_allclose(table[name], entries, atol=1e-12)


def test_a_frame_that_the_data_set_does_not_tell_is_asked_for(dataset, bottle_model, tmp_path):
    said = refusal(
        "reproduce", bottle_model[0], "--dataset", dataset, "--frame", "cup=observation."
        "environment_state[0:7]", "--out", tmp_path / "r.csv",
    )  # fmt: skip
    assert "frame 'bottle' is not in" in said and "--frame bottle=LINK@EVENT" in said
    assert not (tmp_path / "r.csv").exists()


def test_reproduce_takes_situations_from_a_file(bottle_model, tmp_path):
    file, out = tmp_path / "situations.json", tmp_path / "r.csv"
    situations = BottleShaking().situations(2)
    items = []
    for one in situations:
        bottle = one.frames["bottle"]
        pose = {k: getattr(bottle, k).tolist() for k in ("position", "orientation")}
        items.append({"joints": one.joints.tolist(), "frames": {"bottle": pose}})
    file.write_text(json.dumps(items))
    output("reproduce", bottle_model[0], "--situations", file, "--out", out)
    skill = load_model(bottle_model[0]).skill
    expected = rollout(skill, situations, bounds="robot", blend=1.0)
    joints = torch.cat([trajectory.joints for trajectory in expected])
    found = read_table(out)[list(skill.kinematics.joint_names)]
    np.testing.assert_allclose(found, joints, atol=1e-12)
    items[1]["frames"] = {"cup": items[1]["frames"]["bottle"]}
    file.write_text(json.dumps(items))
    assert "bottle" in refusal("reproduce", bottle_model[0], "--situations", file, "--out", out)


def test_what_touches_an_obstacle_is_said_with_an_exit_code_of_its_own(
    dataset, bottle_model, tmp_path
):
    scene, out = tmp_path / "scene.xml", tmp_path / "r.csv"
    arguments = (
        "reproduce", bottle_model[0], "--dataset", dataset, "--episodes", "0", "--out", out,
        "--obstacles", scene,
    )  # fmt: skip
    assert "is an MJCF file" in run(*arguments).stderr
    box = "<geom name='{}' type='box' size='.2 .5 .1' pos='{}'/>"
    world = f"<mujoco><worldbody>{box}</worldbody></mujoco>"
    scene.write_text(world.format("table", "0.4 0 0.05"))
    assert "visuals=True takes these" in run(*arguments).stderr
    result = run(*arguments, "--visuals")
    assert result.exit_code == 3
    assert "allowed: l_forearm and l_wrist_2 (always overlap" in result.stdout
    assert re.search(r"   0  [lr]_\w+ \d+ mm inside table at \d\.\d s", result.stdout)
    scene.write_text(world.format("shelf", "0.4 0 -2"))
    assert output(*arguments, "--visuals").endswith("nothing touches\n")

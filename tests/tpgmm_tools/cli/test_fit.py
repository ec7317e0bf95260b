"""``tpgmm fit``: options reach the model, and the report says what was learned."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tests.support import soft_drives
from tests.support.command_line import UPPER_BODY, output, refusal, run
from tests.support.mistakes import written_arms
from tests.support.skills import waves
from tpgmm_datasets import resample, save_lerobot
from tpgmm_torch import Demonstration, Hold
from tpgmm_torch.operators.text import default_operators, format_operator
from tpgmm_torch.persistence import load_model, load_skill
from tpgmm_torch.regression.fusion_forms import CovarianceFusion
from tpgmm_torch.robots import Poses

#: Quick, and silent about two episodes and about none that are aligned.
QUICK = ("--n-components", 2, "--rate", 5, "--alignment", "none", "--plausibility", "ignore")


def test_fit_saves_a_model_and_says_what_it_learned(bottle_model):
    folder, text = bottle_model
    model = load_model(folder)
    assert (model.n_components, model.reg_covar, model.fusion) == (6, 1e-5, CovarianceFusion())
    assert list(model.operators_) == default_operators(("l_hand", "r_hand"), ("bottle",))
    printed = dict(line.split(maxsplit=1) for line in text.splitlines())
    assert printed["demonstrations"].startswith("3 of 10.65 to 15.30 s")
    assert printed["components"] == "6 (full)"
    assert {"iterations", "log-likelihood", "BIC"} <= printed.keys()
    assert printed["saved"] == str(folder)


def test_fit_takes_operators_holds_and_joints_as_text(dataset, tmp_path):
    operators = ["position:l_hand@bottle + orientation:l_hand", "canonical"]
    chosen = [word for text in operators for word in ("--operator", text)]
    robot = ("--robot", "upper_body", "--link", "l_hand", "--robot-joint", "l_*")
    hold = ("--hold", "bottle@l_hand:5-6", "--hold", "bottle@l_hand:7-")
    text = output("fit", dataset, *robot, *chosen, *hold, *QUICK, "--out", tmp_path / "model")
    model = load_model(tmp_path / "model")
    assert [format_operator(operator) for operator in model.operators_] == operators
    assert model.holds_ == (Hold("bottle", "l_hand", 5, 6), Hold("bottle", "l_hand", 7))
    assert "held             bottle@l_hand:5.0-6.0, bottle@l_hand:7.0-" in text
    assert all(name.startswith("l_") for name in model.kinematics_.joint_names)
    forgotten = refusal("fit", dataset, *QUICK, "--out", tmp_path / "x")
    assert "['bottle'] would be forgotten" in forgotten and "--operator canonical" in forgotten
    output("fit", dataset, *chosen[2:], *QUICK, "--out", tmp_path / "joints")
    [canonical] = load_model(tmp_path / "joints").operators_
    assert format_operator(canonical) == "canonical"
    line = refusal("fit", dataset, *robot[:-1], "left_*", "--out", tmp_path / "x")
    assert "joint 'left_*' is not in the movable joints of the URDF" in line


def test_fit_takes_tracked_poses_in_place_of_a_robot(tmp_path):
    kinematics, time = Poses(("left", "right")), np.arange(30) / 10
    demonstrations = []
    for shift in (0.0, 0.1, 0.2):
        poses = np.zeros((30, 14))
        poses[:, [3, 10]] = 1.0
        poses[:, [0, 7]] = np.sin(time)[:, None] + (0.0, shift)
        demonstrations.append(Demonstration(time, poses, joint_names=kinematics.joint_names))
    save_lerobot(demonstrations, tmp_path / "hands", fps=10, task="wave")
    poses = ("--poses", "left", "--poses", "right", "--n-components", 2)
    operators = ("--operator", "pose:left", "--operator", "pose:right@left")
    output("fit", tmp_path / "hands", *poses, *operators, "--out", tmp_path / "model")
    assert load_model(tmp_path / "model").kinematics_ == kinematics


@pytest.mark.filterwarnings("default:.*commands are learned beside")
def test_what_servos_need_is_learned_and_told(tmp_path):
    shown = [resample(one, 20) for one in soft_drives.demonstrations(sag=0.06)]
    path = save_lerobot(shown, tmp_path / "set", fps=20, task="fetch")
    options = "--n-components", 2, "--alignment", "none", "--plausibility", "ignore"
    given = "fit", path, "--operator", "canonical", *options, "--hold", "none"
    text = output(*given, "--out", tmp_path / "model")
    assert f"servos           {soft_drives.NAMES[1]} sags 0.06 rad\n" in text
    assert load_model(tmp_path / "model").skill.gaps is not None
    result = run(*given, "--joints", "commanded", "--out", tmp_path / "again")
    assert result.exit_code == 0 and "servos  " in result.stdout
    assert result.stderr.count("commands are learned beside measured joints now") == 1


def test_implausible_recordings_and_files_in_the_way_are_refused(dataset, tmp_path):
    strictly = (*QUICK[:-1], "error")
    joints = ("--operator", "canonical")
    result = run("fit", dataset, *joints, *strictly, "--out", tmp_path / "model")
    assert result.exit_code == 2 and "joints           17 of observation.state" in result.stdout
    assert "alignment: the demonstrations last from 10." in result.stderr
    (tmp_path / "file").write_text("")
    line = run("fit", dataset, *joints, *QUICK, "--out", tmp_path / "file").stderr
    assert "exists and is not a saved model" in line


@pytest.mark.parametrize(
    ("units", "good"),
    [
        (["lerobot"], True),
        (["deg", "*gripper=raw"], True),
        (["*gripper=raw", "deg"], True),
        (["raw"], False),
        (["deg", "*gripper=deg"], True),
        ([], False),
    ],
)
def test_check_and_fit_agree_on_the_units_of_two_arms(units, good, tmp_path):
    data = written_arms(tmp_path)
    robot = ("--robot", "left=so101@0,0.2,0", "--robot", "right=so101@0,-0.2,0")
    given = ("--plausibility", "error", *robot, *(w for u in units for w in ("--units", u)))
    checked = run("dataset", "check", "--strict", data, *given[2:])
    learned = run("fit", data, *given, "--n-components", 3, "--out", tmp_path / "model")
    assert (checked.exit_code == 0, learned.exit_code == 0) == (good, good), learned.stderr
    if good:
        printed = dict(line.split(maxsplit=1) for line in learned.stdout.splitlines()[:10])
        assert printed["links"].startswith("left_gripper_frame_link, right_gripper_frame_link")
        assert printed["frames"] == "cup (observation.environment_state)"
        assert ("left_gripper" in printed["units"]) == ("*gripper=deg" not in units)


def test_fit_finds_operators_parts_and_components_and_says_why(dataset, tmp_path):
    options = ("--operator", "auto", "--n-components", "auto", "--alignment", "linear")
    printed = output("fit", dataset, *UPPER_BODY, *QUICK, *options, "--out", tmp_path / "m")
    model = load_model(tmp_path / "m")
    assert "left out is off by" in printed and "decides there" in printed
    assert f"components       {len(model.weights_)} (full)" in printed.splitlines()
    found = ("--n-components", 8, "--parts", "auto", "--alignment", "parts")
    text = output("fit", dataset, *UPPER_BODY, *QUICK, *found, "--out", tmp_path / "parts")
    parts = load_skill(tmp_path / "parts").skills
    assert len(parts) > 1 and "because of" in text


def test_fit_finds_the_ways_of_a_skill_and_reproduce_chooses(tmp_path):
    rng, time, shown = np.random.default_rng(0), np.linspace(0, 1.95, 40), []
    for side in np.resize([1, -1], 8):
        bump = 0.3 * side * np.sin(np.pi * time / 2) + 0.01 * rng.normal()
        path = np.stack((0.4 * time, bump), axis=1)
        shown.append(Demonstration(time, path, joint_names=["forward", "sideways"]))
    data = save_lerobot(shown, tmp_path / "set", fps=20, task="pass on either side")
    given = ("--n-components", 5, *QUICK[4:], "--modes", "auto")
    text = output("fit", data, *given, "--out", tmp_path / "model")
    assert "2 ways:" in text and "  1  4 of 8 demonstrations: 1, 3, 5, 7" in text
    assert len(load_skill(tmp_path / "model").skills) == 2
    new = ("--dataset", data, "--episodes", "0", "--out", tmp_path / "new.csv")
    assert "(way 0: p = " in output("reproduce", tmp_path / "model", *new)


@pytest.mark.slow
def test_batches_and_processes_learn_the_same(tmp_path):
    shown = [
        Demonstration(np.arange(40 - i) / 20, d.joints[: 40 - i], joint_names=("a", "b", "c"))
        for i, d in enumerate(waves(5, length=40))
    ]
    data = save_lerobot(shown, tmp_path / "set", fps=20, task="wave")
    fit = ("fit", data, "--alignment", "linear", "--n-components", 4, "--tol", "1e-6")
    printed = output(*fit, "--out", tmp_path / "whole")
    assert "demonstrations   5 of 1.75 to 1.95 s" in printed
    printed = output(*fit, "--batch-episodes", 5, "--out", tmp_path / "batched")
    assert "bound of EM" in printed
    output(*fit, "--batch-episodes", 2, "--out", tmp_path / "alone")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc-per-node=2", "--no-python"]
    command += [str(Path(sys.executable).with_name("tpgmm")), *map(str, fit)]
    command += ["--batch-episodes", "2", "--out", str(tmp_path / "together")]
    options = {"env": os.environ | {"OMP_NUM_THREADS": "1"}, "timeout": 300}
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("saved ") == 1 and "processes        2" in done.stdout
    for one, other in (("batched", "whole"), ("together", "alone")):
        pair = (load_file(tmp_path / name / "model.safetensors") for name in (one, other))
        torch.testing.assert_close(*pair, rtol=1e-9, atol=1e-9)

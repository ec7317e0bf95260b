"""The command ``tpgmm``: what it writes, what it prints, and how it refuses."""

import inspect
import json
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pandas as pd
import pytest
import torch

from tests.support.command_line import output, refusal, run
from tpgmm_datasets import demonstrations_from_frame, save_lerobot
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_torch import Demonstration, Poses, TaskParameterizedGMM
from tpgmm_torch.cli.fit import fit as fit_command
from tpgmm_torch.operators.text import default_operators, format_operator

PNG = b"\x89PNG"
UPPER_BODY = ("--robot", "upper_body", "--link", "l_hand", "--link", "r_hand")


def arrays(path):
    with np.load(path) as file:
        return dict(file)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "bottle"
    demonstrations = BottleShaking(rate=20).demonstrations(3)
    save_lerobot(demonstrations, folder, fps=20, task="shake")
    return folder


@pytest.fixture(scope="module")
def fitted(dataset, tmp_path_factory):
    """Folder of a model, and what fitting it printed."""
    folder = tmp_path_factory.mktemp("fit") / "model"
    options = ("--n-components", 6, "--reg-covar", 1e-5, "--fusion", "covariance")
    return folder, output("fit", dataset, *UPPER_BODY, *options, "--out", folder)


def test_version_and_help_need_no_command():
    assert output("--version") == f"tpgmm-torch {version('tpgmm-torch')}\n"
    for arguments in ((), ("--help",)):
        text = output(*arguments)
        for name in ("demo", "fit", "reproduce", "plot", "view", "dataset"):
            assert name in text


@pytest.mark.parametrize(
    "command",
    ["demo", "fit", "reproduce", "plot", "view"]
    + [f"dataset {name}" for name in ("info", "check", "plot", "generate", "convert")],
)
def test_the_help_of_every_command_has_an_example(command):
    assert f"Example: tpgmm {command}" in output(*command.split(), "--help")


def test_the_commands_are_set_up_without_the_heavy_packages():
    script = """
import sys
import tpgmm_torch.cli.application
heavy = {"torch", "sklearn", "pandas", "pyarrow", "matplotlib", "lerobot"} & set(sys.modules)
sys.exit(f"{sorted(heavy)} are imported" if heavy else 0)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_fit_saves_a_model_and_says_what_it_learned(fitted):
    folder, text = fitted
    model = TaskParameterizedGMM.load(folder)
    assert (model.n_components, model.reg_covar, model.fusion) == (6, 1e-5, "covariance")
    assert list(model.operators_) == default_operators(("l_hand", "r_hand"), ("bottle",))
    assert model.frame_names_ == ("bottle",)
    printed = dict(line.split(maxsplit=1) for line in text.splitlines())
    assert printed["demonstrations"].startswith("3 of 10.65 to 15.30 s")
    assert printed["components"] == "6 (full)"
    assert {"iterations", "log-likelihood", "BIC"} <= printed.keys()
    assert printed["saved"] == str(folder)


def test_fit_takes_operators_as_text(dataset, tmp_path):
    operators = ["position:l_hand@bottle + orientation:r_hand@l_hand", "canonical"]
    chosen = [word for text in operators for word in ("--operator", text)]
    few = ("--n-components", 3, "--episodes", "0,2", "--alignment", "linear")
    output("fit", dataset, *UPPER_BODY, *chosen, *few, "--out", tmp_path / "model")
    model = TaskParameterizedGMM.load(tmp_path / "model")
    assert [format_operator(operator) for operator in model.operators_] == operators


def test_fit_without_a_robot_learns_joints(dataset, tmp_path):
    few = ("--n-components", 3, "--alignment", "none", "--rate", 5)
    output("fit", dataset, *few, "--out", tmp_path / "model")
    model = TaskParameterizedGMM.load(tmp_path / "model")
    assert list(map(format_operator, model.operators_)) == ["canonical"]
    out = tmp_path / "r.npz"
    output("reproduce", tmp_path / "model", "--dataset", dataset, "--out", out)
    assert arrays(out)["joint_names"].tolist() == list(model.kinematics_.joint_names)


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
    assert TaskParameterizedGMM.load(tmp_path / "model").kinematics_ == kinematics
    both = refusal("fit", "x", *poses, *UPPER_BODY, "--out", "y")
    assert "--poses are instead of --robot" in both


def test_only_chosen_joints_move(dataset, tmp_path):
    robot = ("--robot", "upper_body", "--link", "l_hand", "--robot-joint", "l_*")
    few = ("--n-components", 3, "--rate", 5)
    output("fit", dataset, *robot, *few, "--out", tmp_path / "model")
    names = TaskParameterizedGMM.load(tmp_path / "model").kinematics_.joint_names
    assert len(names) == 7
    assert all(name.startswith("l_") for name in names)
    line = refusal("fit", dataset, *robot[:-1], "left_*", "--out", tmp_path / "x")
    assert "joint 'left_*' is not in the URDF" in line


@pytest.mark.parametrize("suffix", ["parquet", "csv", "npz"])
def test_reproductions_of_a_data_set_are_those_of_the_model(dataset, fitted, tmp_path, suffix):
    out = tmp_path / "new" / f"r.{suffix}"
    printed = output(
        "reproduce", fitted[0], "--dataset", dataset, "--episodes", "1:3", "--out", out
    ).splitlines()
    assert len(printed) == 3
    assert all("rad/s^2" in line and "limit" in line for line in printed[:2])
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    model = TaskParameterizedGMM.load(fitted[0])
    names = list(model.kinematics_.joint_names)
    if suffix == "npz":
        found = arrays(out)
        assert found["joint_names"].tolist() == names
        joints = found["joints"][found["episode"] == 1]
    elif suffix == "csv":
        table = pd.read_csv(out, index_col=["episode", "time"])
        joints = table.loc[1][names].to_numpy()
    else:
        found = demonstrations_from_frame(pd.read_parquet(out))
        assert set(found[1].frames) == {"bottle"}
        joints = found[1].joints.numpy()
    arguments = ("--dataset", dataset, "--episodes", "2", "--out", tmp_path / "again.npz")
    output("reproduce", fitted[0], *arguments)
    again = arrays(tmp_path / "again.npz")
    np.testing.assert_allclose(joints, again["joints"], atol=1e-9)
    np.testing.assert_array_equal(again["time"], model.time_)


def test_reproduce_takes_situations_from_a_file(fitted, tmp_path):
    skill, file, out = BottleShaking(), tmp_path / "situations.json", tmp_path / "r.npz"
    situations = skill.situations(2)
    items = [
        {
            "joints": s.joints.tolist(),
            "frames": {
                "bottle": {
                    "position": s.frames["bottle"].position.tolist(),
                    "orientation": s.frames["bottle"].orientation.tolist(),
                }
            },
        }
        for s in situations
    ]
    file.write_text(json.dumps(items))
    output("reproduce", fitted[0], "--situations", file, "--out", out)
    expected = TaskParameterizedGMM.load(fitted[0]).predict(situations, candidates=False)
    joints = torch.cat([trajectory.joints for trajectory in expected])
    np.testing.assert_allclose(arrays(out)["joints"], joints, atol=1e-12)
    items[1]["frames"] = {"cup": items[1]["frames"]["bottle"]}
    file.write_text(json.dumps(items))
    assert "bottle" in refusal("reproduce", fitted[0], "--situations", file, "--out", out)


def test_plot_draws_each_operator_and_the_chosen_joints(dataset, fitted, tmp_path):
    printed = output(
        "plot", fitted[0], "--dataset", dataset, "--joint", "l_elbow", "--out", tmp_path / "p"
    ).split()
    names = ["operator_1.png", "operator_2.png", "joint_l_elbow.png"]
    assert printed == [str(tmp_path / "p" / name) for name in names]
    for name in names:
        assert (tmp_path / "p" / name).read_bytes().startswith(PNG)


def test_dataset_info_and_plot_show_what_is_in_it(dataset, tmp_path):
    text = output("dataset", "info", dataset)
    for expected in ("v3.0", "20 rows per second", "bottle.qw", "l_shoulder_pitch", "rad"):
        assert expected in text
    output("dataset", "plot", dataset, "--out", tmp_path / "d.png")
    assert (tmp_path / "d.png").read_bytes().startswith(PNG)


def test_dataset_check_lists_all_problems_and_fails(tmp_path):
    assert "no problems in 2 episodes" in output("dataset", "check", bad_set(tmp_path / "a", 0))
    result = run("dataset", "check", bad_set(tmp_path / "b", 2))
    assert result.exit_code == 1
    lines = result.stdout.splitlines()
    assert len(lines) == 2
    assert all(
        f"episode {i}" in line and "observation.state" in line for i, line in enumerate(lines)
    )
    assert "problem: " in output("dataset", "info", tmp_path / "b")


def bad_set(folder, wrong):
    """Two episodes, in as many of which as ``wrong`` says there is a NaN."""
    time = np.arange(10) / 10
    joints = np.sin(time)[:, None] * np.ones(2)
    save_lerobot([Demonstration(time, joints)] * 2, folder, fps=10, task="t")
    [file] = folder.glob("data/*/*.parquet")
    table = pd.read_parquet(file)
    for episode in range(wrong):
        state = table["observation.state"][10 * episode + 3].copy()
        state[0] = np.nan
        table.at[10 * episode + 3, "observation.state"] = state
    table.to_parquet(file)
    return folder


def test_demo_runs_the_experiment_and_prints_a_table_of_100_columns(tmp_path):
    out = tmp_path / "demo"
    small = ("--n-components", 12, "--n-demonstrations", 3, "--n-situations", 2, "--rate", 12)
    text = output("demo", "--out", out, *small)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["settings"]["n_components"] == 12
    assert "learning, K = 12 ...\n" in text
    for name in [*metrics["rows"], "demonstrations"]:
        assert name.partition(",")[0] in text
    assert f"in {out}" in text
    lines = text.splitlines()
    [heading] = [i for i, line in enumerate(lines) if "RMSE rad" in line]
    [caption] = [i for i, line in enumerate(lines) if "median/95th" in line]
    assert max(len(line.rstrip()) for line in lines[heading:caption]) <= 100
    assert "…" not in text
    for folder in ("dataset", "model"):
        assert (out / folder).is_dir()
    assert (out / "figure_3.png").read_bytes().startswith(PNG)


def test_unknown_joints_and_files_in_the_way_are_refused(dataset, fitted, tmp_path):
    where = ("--dataset", dataset, "--out", tmp_path / "p")
    assert "joint 'knee' is not in the model" in refusal(
        "plot", fitted[0], "--joint", "knee", *where
    )
    (tmp_path / "file").write_text("")
    options = ("--n-components", 2, "--rate", 5, "--alignment", "none")
    line = refusal("fit", dataset, *options, "--out", tmp_path / "file")
    assert "exists and is not a saved model" in line
    line = refusal("dataset", "plot", dataset, "--out", tmp_path / "file" / "d.png")
    assert str(tmp_path / "file") in line


def test_fit_has_the_estimators_defaults():
    options = inspect.signature(fit_command).parameters
    estimator = inspect.signature(TaskParameterizedGMM).parameters
    shared = options.keys() & estimator.keys() - {"robot", "operators", "device", "dtype"}
    assert len(shared) > 8
    for name in shared - {"random_state"}:
        assert options[name].default == estimator[name].default, name

"""``tpgmm fit``: what it saves, what it prints, and how it refuses."""

import inspect

import numpy as np

from tests.support.command_line import UPPER_BODY, output, refusal
from tpgmm_datasets import save_lerobot
from tpgmm_tools.cli.fit import fit as fit_command
from tpgmm_torch import (
    Demonstration,
    Hold,
    MultimodalTaskParameterizedGMM,
    Poses,
    TaskParameterizedGMM,
)
from tpgmm_torch.operators.text import default_operators, format_operator

#: For two episodes, or episodes that are not aligned: no word about it.
CALMLY = ("--plausibility", "ignore")


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
    few = ("--n-components", 3, "--episodes", "0,2", "--alignment", "linear", *CALMLY)
    output("fit", dataset, *UPPER_BODY, *chosen, *few, "--out", tmp_path / "model")
    model = TaskParameterizedGMM.load(tmp_path / "model")
    assert [format_operator(operator) for operator in model.operators_] == operators


def test_fit_takes_holds_as_text(dataset, tmp_path):
    few = ("--n-components", 3, "--episodes", "0,2", "--alignment", "linear", *CALMLY)
    for given, holds in (
        (("bottle@l_hand:5.25-",), [Hold("bottle", "l_hand", 5.25)]),
        (
            ("bottle@l_hand:5-6", "bottle@r_hand:6-"),
            [Hold("bottle", "l_hand", 5, 6), Hold("bottle", "r_hand", 6)],
        ),
        (("none",), None),
    ):
        chosen = [word for text in given for word in ("--hold", text)]
        text = output("fit", dataset, *UPPER_BODY, *chosen, *few, "--out", tmp_path / "model")
        model = TaskParameterizedGMM.load(tmp_path / "model")
        assert model.holds == holds and model.holds_ == tuple(holds or ())
        assert ("by l_hand from 5.25 s to the end (in 100% of them)" in text) is (
            "5.25-" in given[0]
        )
    line = refusal(
        "fit", dataset, *UPPER_BODY, "--hold", "bottle", *few, "--out", tmp_path / "m"
    )
    assert "hold 'bottle' is not of the form FRAME@LINK:BEGIN-END" in line
    line = refusal(
        "fit", dataset, *UPPER_BODY, "--hold", "cup@l_hand", *few, "--out", tmp_path / "m"
    )
    assert "frame 'cup' is not in the demonstration" in line


def test_fit_finds_parts_and_says_why(dataset, tmp_path):
    few = ("--n-components", 8, *CALMLY, "--rate", 10)
    found = ("--parts", "auto", "--alignment", "parts")
    text = output("fit", dataset, *UPPER_BODY, *found, *few, "--out", tmp_path / "model")
    model = TaskParameterizedGMM.load(tmp_path / "model")
    assert model.parts == "auto" and len(model.parts_) == 4
    assert text.count("stop\n") == 3 and "because of" in text
    assert f"part 1           0.00 to {model.parts_[0].end:.2f} s, " in text
    given = ("--parts", "2.5, grasp", "--alignment", "linear")
    output("fit", dataset, *UPPER_BODY, *given, *few, "--out", tmp_path / "other")
    assert TaskParameterizedGMM.load(tmp_path / "other").parts == [2.5, "grasp"]
    line = refusal(
        "fit", dataset, *UPPER_BODY, "--parts", "thrown", *few, "--out", tmp_path / "m"
    )
    assert "event 'thrown' is not in a demonstration" in line


def test_fit_without_a_robot_learns_joints(dataset, tmp_path):
    few = ("--n-components", 3, "--alignment", "none", "--rate", 5, *CALMLY)
    output("fit", dataset, *few, "--out", tmp_path / "model")
    model = TaskParameterizedGMM.load(tmp_path / "model")
    assert list(map(format_operator, model.operators_)) == ["canonical"]
    out = tmp_path / "r.npz"
    output("reproduce", tmp_path / "model", "--dataset", dataset, "--out", out)
    assert arrays(out)["joint_names"].tolist() == list(model.kinematics_.joint_names)


def arrays(path):
    with np.load(path) as file:
        return dict(file)


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
    assert "joint 'left_*' is not in the movable joints of the URDF" in line


def test_implausible_recordings_are_refused_where_that_is_asked_for(dataset, tmp_path):
    strictly = ("--plausibility", "error", "--alignment", "none", "--rate", 5)
    line = refusal("fit", dataset, *strictly, "--n-components", 2, "--out", tmp_path / "model")
    assert "alignment: the demonstrations last from 10." in line


def test_a_file_in_the_way_is_left_alone(dataset, tmp_path):
    (tmp_path / "file").write_text("")
    options = ("--n-components", 2, "--rate", 5, "--alignment", "none", *CALMLY)
    line = refusal("fit", dataset, *options, "--out", tmp_path / "file")
    assert "exists and is not a saved model" in line


def test_fit_has_the_estimators_defaults():
    options = inspect.signature(fit_command).parameters
    estimator = inspect.signature(TaskParameterizedGMM).parameters
    shared = options.keys() & estimator.keys() - {"robot", "operators", "device", "dtype"}
    assert len(shared) > 8
    for name in shared - {"random_state"}:
        assert options[name].default == estimator[name].default, name


def test_fit_finds_operators_and_says_why(dataset, tmp_path):
    options = ("--rate", 5, "--n-components", 2, "--operator", "auto", *CALMLY)
    printed = output("fit", dataset, *UPPER_BODY, *options, "--out", tmp_path / "model")
    assert "left out is off by" in printed and "decides there" in printed
    model = TaskParameterizedGMM.load(tmp_path / "model")
    assert "bottle" in model.frame_names_


def test_fit_finds_the_number_of_components(dataset, tmp_path):
    steady = ("--rate", 4, "--alignment", "linear", *CALMLY)
    options = ("--operator", "canonical", "--n-components", "auto", *steady)
    printed = output("fit", dataset, *UPPER_BODY, *options, "--out", tmp_path / "model")
    model = TaskParameterizedGMM.load(tmp_path / "model")
    assert f"components       {model.n_components_} (full)" in printed.splitlines()


def test_what_is_no_number_of_components_is_refused(dataset, tmp_path):
    line = refusal("fit", dataset, "--n-components", "some", "--out", tmp_path / "model")
    assert "'some' is neither a positive integer nor 'auto'" in line


def test_fit_finds_the_ways_of_a_skill_and_reproduce_chooses_once(tmp_path, monkeypatch):
    rng, time, shown = np.random.default_rng(0), np.linspace(0, 1.95, 40), []
    for side in np.resize([1, -1], 8):
        bump = 0.3 * side * np.sin(np.pi * time / 2) + 0.01 * rng.normal()
        path = np.stack((0.4 * time, bump), axis=1)
        shown.append(Demonstration(time, path, joint_names=["forward", "sideways"]))
    save_lerobot(shown, tmp_path / "set", fps=20, task="pass on either side")
    given = ("fit", tmp_path / "set", "--n-components", 5, "--alignment", "none", *CALMLY)
    text = output(*given, "--modes", "auto", "--out", tmp_path / "model")
    assert "2 ways:" in text and "  1  4 of 8 demonstrations: 1, 3, 5, 7" in text
    assert {path.name for path in (tmp_path / "model").iterdir()} == {
        "modes", "mode_0", "mode_1",
    }  # fmt: skip
    choose, calls = MultimodalTaskParameterizedGMM.choose, []
    monkeypatch.setattr(
        MultimodalTaskParameterizedGMM,
        "choose",
        lambda model, situations: calls.append(situations) or choose(model, situations),
    )
    text = output(
        "reproduce", tmp_path / "model", "--dataset", tmp_path / "set", "--episodes", "0",
        "--out", tmp_path / "new.csv",
    )  # fmt: skip
    assert "(mode 0: p = " in text
    assert len(calls) == 1
    line = refusal(
        "plot", tmp_path / "model", "--dataset", tmp_path / "set", "--out", tmp_path / "plots"
    )
    assert "holds a model of several ways" in line
    line = refusal(
        *given, "--modes", 2, "--checkpoint", tmp_path / "c", "--out", tmp_path / "m"
    )
    assert "--modes compares all episodes" in line

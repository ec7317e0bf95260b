"""Skills learned from real recordings beside the repository: examples/leave_one_out.py."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tpgmm_datasets import Scale, load_lerobot
from tpgmm_torch import Canonical, Demonstration, Situation, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.metrics import joint_rmse

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
needs_recordings = pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here")

MILLIMETRES, DEGREES = 0, 1


@pytest.fixture(scope="module")
def example():
    path = ROOT / "examples" / "leave_one_out.py"
    spec = importlib.util.spec_from_file_location("leave_one_out_example", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def hand(example, opening):
    time = np.arange(len(opening)) / 30
    return Demonstration(time, np.tile(opening, (4, 1)).T, joint_names=tuple(example.FINGERS))


def test_the_grasp_is_the_longest_time_with_a_closed_hand(example):
    # half closed at first; in the end it closes faster and further than around the bottle
    parts = [(0.55, 30), (0.8, 30), (0.45, 120), (0.95, 30), (0.4, 45)]
    close, opened = example.grasp(hand(example, np.repeat(*zip(*parts, strict=True))))
    assert (close, opened) == (pytest.approx(2.0), pytest.approx(6.0))


def test_a_hand_that_never_opens_again_holds_to_the_end(example):
    close, opened = example.grasp(hand(example, np.repeat([0.9, 0.4], [30, 60])))
    assert (close, opened) == (pytest.approx(1.0), pytest.approx(89 / 30))


def test_the_angle_between_orientations_ignores_the_sign_of_quaternions(example):
    half = torch.tensor(0.25, dtype=torch.float64)
    turned = torch.stack((half.cos(), half.sin(), 0 * half, 0 * half))
    still = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    for sign in (1, -1):
        angle = example.degrees_between(sign * turned, still)
        assert float(angle) == pytest.approx(np.rad2deg(0.5))


@needs_recordings
def test_g1_grasps_an_unseen_bottle_an_order_better_than_both_baselines(example):
    recording = example.load_g1(DATA / "g1_bottle")
    closing = np.array([d.events["close"] / d.duration for d in recording.demonstrations])
    assert len(closing) == 20
    assert closing.min() > 0.1 and closing.max() < 0.6  # and not the closing in the end
    results = example.leave_one_out(recording, folds=[1, 6, 16])
    model, known, mean, nearest = results.values()
    for baseline in (mean, nearest):
        assert (model[:, MILLIMETRES] < baseline[:, MILLIMETRES]).all()
        assert np.median(model[:, MILLIMETRES]) < np.median(baseline[:, MILLIMETRES]) / 8
        assert np.median(model[:, DEGREES]) < np.median(baseline[:, DEGREES]) / 2
    assert np.median(model[:, MILLIMETRES]) < 5
    assert model[:, MILLIMETRES].max() < 15
    # the way after the grasp depends on where the bottle goes, which only `known` is told
    assert (np.median(known[:, 2:], axis=0) < 0.75 * np.median(mean[:, 2:], axis=0)).all()


@needs_recordings
def test_honeytea_pours_into_an_unseen_cup_better_than_both_baselines(example):
    recording = example.load_honeytea(DATA / "honeytea_bimanual")
    first, *_ = recording.models.items()
    recording = replace(recording, models=dict([first]))
    model, mean, nearest = example.leave_one_out(recording, folds=[0, 4, 6]).values()
    for baseline in (mean, nearest):
        assert np.median(model[:, MILLIMETRES]) < np.median(baseline[:, MILLIMETRES]) / 3
        assert np.median(model[:, DEGREES]) < np.median(baseline[:, DEGREES])
    assert np.isnan(model[:, 4]).all()  # no robot, no joints


@needs_recordings
def test_the_example_prints_its_table(example, capsys):
    example.main([str(DATA / "honeytea_bimanual"), "--set", "honeytea", "--folds", "1"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("honeytea: 1 of 9 episodes held out, {'n_components': 8,")
    methods = [line[:24].strip() for line in lines[2:]]
    assert methods == ["TP-GMM", "TP-GMM, cup unknown", "mean", "nearest"]


@needs_recordings
def test_so101_in_degrees_is_read_aligned_and_reproduced():
    arm = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    units = dict.fromkeys((f"{name}.pos" for name in arm), "deg")
    units["gripper.pos"] = Scale.between((0, 100), (0.0, 1.0))
    demonstrations = load_lerobot(DATA / "so101_record", units=units)
    assert [d.joint_names[0] for d in demonstrations] == ["shoulder_pan.pos"] * 4
    assert max(float(d.joints.abs().max()) for d in demonstrations) < np.pi
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(demonstrations)
    model = TaskParameterizedGMM(10, [Canonical()], random_state=0).fit(aligned)
    [trajectory] = model.predict([Situation.of(aligned[0])], candidates=False)
    moved = (aligned[0].joints - aligned[0].joints[0]).square().mean().sqrt()
    assert joint_rmse(trajectory, aligned[0]) < moved / 2

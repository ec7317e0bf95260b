"""Real recordings beside the repository, and skills learned from them."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from examples.leave_one_out import G1_HAND, grasp
from tests.support.robot_zoo import G1_JOINTS, G1_PATH
from tpgmm_datasets import (
    DatasetError,
    LinkPose,
    Scale,
    describe_lerobot,
    load_lerobot,
    save_lerobot,
)
from tpgmm_torch import Canonical, Demonstration, Situation, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.data.tables import demonstrations_from_frame, demonstrations_to_frame
from tpgmm_torch.metrics import joint_rmse
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.tracked_poses import Poses

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
needs_recordings = pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here")
MILLIMETRES, DEGREES = 0, 1
PARTS = ("ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "Elbow")
PARTS += ("WristRoll", "WristPitch", "WristYaw")


@needs_recordings
def test_g1_has_nested_names_absent_videos_and_radians():
    found = describe_lerobot(DATA / "g1_bottle")
    assert found.version == "v2.1"
    assert found.cameras
    assert found.problems == ()
    demonstrations = load_lerobot(DATA / "g1_bottle")
    assert len(demonstrations) == 20
    assert sum(map(len, demonstrations)) == 7844
    assert demonstrations[0].joint_names[7:14] == tuple(f"kRight{part}" for part in PARTS)


@needs_recordings
def test_g1_joints_are_those_of_its_urdf_and_the_bottle_is_where_the_hand_closes():
    robot = Robot.from_urdf(G1_PATH, [G1_HAND], joints=G1_JOINTS[3:])
    demonstrations = load_lerobot(
        DATA / "g1_bottle",
        robot=robot,
        events={"close": lambda d: grasp(d)[0], "open": lambda d: grasp(d)[1]},
        frames={"bottle": LinkPose(G1_HAND, "close")},
    )
    for demonstration in demonstrations:
        assert demonstration.joint_names == robot.joint_names
        closing, opening = demonstration.events["close"], demonstration.events["open"]
        # the hand closes once more at the end, when the bottle stands and the arm is back
        assert 1 < closing < 0.6 * demonstration.duration
        assert closing + 3 < opening < 0.9 * demonstration.duration
        step = int((demonstration.time - closing).abs().argmin())
        state = robot.state(demonstration.joints[step])
        x, y, z = demonstration.frames["bottle"].position
        torch.testing.assert_close(torch.stack((x, y, z)), state.position(G1_HAND))
        # the table in front of the robot; at the end the hand is further to the right
        assert 0.25 < x < 0.4
        assert -0.2 < y < -0.05
        assert 0.1 < z < 0.2


@needs_recordings
def test_so101_says_that_it_is_not_in_radians():
    found = describe_lerobot(DATA / "so101_record")
    assert found.robot_type == "so101_follower"
    with pytest.raises(DatasetError, match=r"not radians: .*shoulder_pan\.pos"):
        load_lerobot(DATA / "so101_record")
    arm = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    units = dict.fromkeys((f"{name}.pos" for name in arm), "deg")
    units["gripper.pos"] = Scale.between((0, 100), (0.0, 1.0))
    demonstrations = load_lerobot(DATA / "so101_record", units=units)
    raw = load_lerobot(DATA / "so101_record", units="raw")
    assert len(demonstrations) == 4
    for found, stored in zip(demonstrations, raw, strict=True):
        torch.testing.assert_close(found.joints[:, :5], torch.deg2rad(stored.joints[:, :5]))
        torch.testing.assert_close(found.joints[:, 5], stored.joints[:, 5] / 100)


@needs_recordings
def test_honeytea_is_two_hands_without_a_robot():
    robot = Poses(("left", "right"))
    demonstrations = load_lerobot(DATA / "honeytea_bimanual", robot=robot)
    assert len(demonstrations) == 9
    for demonstration in demonstrations:
        assert demonstration.joint_names == robot.joint_names
        norms = torch.linalg.vector_norm(demonstration.joints[:, [3, 4, 5, 6]], dim=-1)
        assert float((norms - 1).abs().max()) < 1e-3
    state = next(c for c in describe_lerobot(DATA / "honeytea_bimanual").columns if c.names)
    assert state.names[3] == "left_qw"


@needs_recordings
@pytest.mark.parametrize("name", ["g1_bottle", "so101_record", "honeytea_bimanual"])
def test_what_is_read_can_be_written_read_and_tabulated(name, tmp_path):
    demonstrations = load_lerobot(DATA / name, units="raw", episodes=slice(3))
    fps = int(describe_lerobot(DATA / name).fps)
    root = save_lerobot(demonstrations, tmp_path / name, fps=fps, task="again")
    for other in (
        load_lerobot(root, units="raw"),
        demonstrations_from_frame(demonstrations_to_frame(demonstrations)),
    ):
        for found, expected in zip(other, demonstrations, strict=True):
            assert torch.equal(found.joints, expected.joints)
            assert np.array_equal(found.time, expected.time)


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

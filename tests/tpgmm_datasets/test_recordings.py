"""Real recordings beside the repository, and skills learned from them."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from examples.leave_one_out import G1_HAND
from tests.support.robot_zoo import G1_JOINTS, G1_PATH
from tpgmm_datasets import DatasetError, LinkPose, Scale, describe_lerobot, load_lerobot
from tpgmm_torch import Canonical, Situation, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.metrics import joint_rmse
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.tracked_poses import Poses

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
needs_recordings = pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here")
MILLIMETRES, DEGREES, PATH, BEFORE = 0, 1, slice(2, 5), 5
ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
SO101 = dict.fromkeys((f"{name}.pos" for name in ARM), "deg")
SO101["gripper.pos"] = Scale.between((0, 100), (0.0, 1.0))
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
    demonstrations = load_lerobot(  # a warning, for one that is not found, would be an error
        DATA / "g1_bottle",
        robot=robot,
        frames={"bottle": f"{G1_HAND}@close", "place": LinkPose(G1_HAND, "open")},
    )
    assert len(demonstrations) == 20
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
    demonstrations = load_lerobot(DATA / "so101_record", units=SO101)
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


@pytest.fixture(scope="module")
def example():
    path = ROOT / "examples" / "leave_one_out.py"
    spec = importlib.util.spec_from_file_location("leave_one_out_example", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@needs_recordings
@pytest.mark.filterwarnings("ignore:left on linear time")
def test_g1_grasps_an_unseen_bottle_an_order_better_than_both_baselines(example):
    recording = example.load_g1(DATA / "g1_bottle")
    models = {name: recording.models[name] for name in ("TP-GMM", "TP-GMM, place known")}
    recording = replace(recording, models=models)
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
    assert (np.median(known[:, PATH], axis=0) < 0.75 * np.median(mean[:, PATH], axis=0)).all()


@needs_recordings
@pytest.mark.filterwarnings("ignore:.*are unlike the others and were not learned from")
def test_g1_approaches_better_if_the_start_of_the_hand_is_a_frame(example):
    recording = example.load_g1(DATA / "g1_bottle")
    models = {name: recording.models[name] for name in ("TP-GMM", "TP-GMM, start")}
    recording = replace(recording, models=models)
    every_fourth = range(0, 20, 4)
    model, start, *_ = example.leave_one_out(recording, "events", every_fourth).values()
    assert start[:, BEFORE].mean() < 0.85 * model[:, BEFORE].mean()
    assert np.median(start[:, MILLIMETRES]) < 5


@needs_recordings
@pytest.mark.filterwarnings("ignore:left on linear time")
def test_honeytea_pours_into_an_unseen_cup_better_than_both_baselines(example):
    recording = example.load_honeytea(DATA / "honeytea_bimanual")
    first, *_ = recording.models.items()
    recording = replace(recording, models=dict([first]))
    model, mean, nearest = example.leave_one_out(recording, folds=[0, 4, 6]).values()
    for baseline in (mean, nearest):
        assert np.median(model[:, MILLIMETRES]) < np.median(baseline[:, MILLIMETRES]) / 3
        assert np.median(model[:, DEGREES]) < np.median(baseline[:, DEGREES])
    assert np.isnan(model[:, 4]).all()  # no robot, no joints


def test_intervals_of_the_median_end_at_the_episodes_that_the_sign_test_says(example):
    columns = len(example.COLUMNS)

    def told(n):
        values = np.tile(np.arange(1.0, n + 1)[:, None], (1, columns))
        return example.intervals({"model": values}).splitlines()[1].split("model")[1].split()

    # P(at most 5 of 20 heads) = 0.0207, 6 of 20: 0.0577; P(at most 1 of 9) = 0.0195
    assert told(20)[:3] == ["6.0", "to", "15.0"]
    assert told(9)[:3] == ["2.0", "to", "8.0"]
    assert told(5) == ["-"] * columns


@needs_recordings
def test_so101_in_degrees_is_read_aligned_and_reproduced():
    demonstrations = load_lerobot(DATA / "so101_record", units=SO101)
    assert [d.joint_names[0] for d in demonstrations] == ["shoulder_pan.pos"] * 4
    assert max(float(d.joints.abs().max()) for d in demonstrations) < np.pi
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(demonstrations)
    model = TaskParameterizedGMM(10, [Canonical()], random_state=0).fit(aligned)
    [trajectory] = model.predict([Situation.of(aligned[0])], candidates=False)
    moved = (aligned[0].joints - aligned[0].joints[0]).square().mean().sqrt()
    assert joint_rmse(trajectory, aligned[0]) < moved / 2

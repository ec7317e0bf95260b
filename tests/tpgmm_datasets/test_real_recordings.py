"""Real recordings beside the repository, where they are there."""

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
    demonstrations_from_frame,
    demonstrations_to_frame,
    describe_lerobot,
    load_lerobot,
    save_lerobot,
)
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.tracked_poses import Poses

DATA = Path(__file__).parents[2].parent / "shared" / "data"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here")

PARTS = ("ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "Elbow")
PARTS += ("WristRoll", "WristPitch", "WristYaw")


def test_g1_has_nested_names_absent_videos_and_radians():
    found = describe_lerobot(DATA / "g1_bottle")
    assert found.version == "v2.1"
    assert found.cameras
    assert found.problems == ()
    demonstrations = load_lerobot(DATA / "g1_bottle")
    assert len(demonstrations) == 20
    assert sum(map(len, demonstrations)) == 7844
    assert demonstrations[0].joint_names[7:14] == tuple(f"kRight{part}" for part in PARTS)


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

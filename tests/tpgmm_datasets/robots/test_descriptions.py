"""The descriptions that come with the package."""

import math

import numpy as np
import pytest
import torch

from tests.support.robot_zoo import zoo
from tpgmm_datasets.robots import bi_so101_urdf, end_links, parse_robot, so101_urdf
from tpgmm_torch import Frame, Robot, quaternions
from tpgmm_torch.exceptions import DataError

ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")


def arm(*joints: float) -> tuple[np.ndarray, np.ndarray]:
    """Position and rotation of the gripper at joints of those angles, the others at zero."""
    robot = Robot.from_urdf(so101_urdf(), ["gripper_frame_link"], joints=ARM)
    state = robot.state([*joints, *[0.0] * (5 - len(joints))])
    rotation = quaternions.to_matrix(state.orientation("gripper_frame_link")).numpy()
    return state.position("gripper_frame_link").numpy(), rotation


def test_the_so101_reaches_forward_in_its_plane() -> None:
    position, rotation = arm()
    # lengths along x and z as published: base, shoulder, upper arm and lower arm, wrist, tip
    x = 0.0388353 + 0.0303992 + 0.028 + 0.1349 + 0.0611 + 0.0981274
    z = 0.0624 + 0.0542 + 0.11257 - 0.0052
    assert position[0] == pytest.approx(x, abs=1e-9)
    assert abs(position[1]) < 1e-3 > abs(position[2] - z) - 0.0079
    assert rotation[:, 2] == pytest.approx([1, 0, 0], abs=1e-12)


def test_its_joints_turn_as_they_are_called() -> None:
    straight, _ = arm()
    reach = straight[0] - 0.0388353
    turned, _ = arm(0.3)  # the axis of the pan points down
    assert turned[:2] == pytest.approx(
        [0.0388353 + reach * math.cos(0.3), -reach * math.sin(0.3)], abs=1e-4
    )
    for joints in ([0, 0.2], [0, 0, 0.2], [0, 0, 0, 0.2]):  # positive bends down
        lowered, rotation = arm(*joints)
        assert lowered[2] < straight[2]
        assert rotation[:, 2] == pytest.approx([math.cos(0.2), 0, -math.sin(0.2)], abs=1e-12)
    rolled, rotation = arm(0, 0, 0, 0, 0.5)
    assert rolled[0] == pytest.approx(straight[0])
    assert rotation[:, 2] == pytest.approx([1, 0, 0], abs=1e-12)


@pytest.mark.parametrize("joined", [True, False])
def test_several_robots_are_written_as_text(joined: bool, tmp_path) -> None:
    (tmp_path / "arm.urdf").write_text(so101_urdf())
    texts = ["left=so101@0,0.2,0,0.5", f"right={tmp_path}/arm.urdf@0,-0.2,0.1,0,0,0,1"]
    both = parse_robot(";".join(texts) if joined else texts)
    alone = parse_robot("so101")
    turn = [math.cos(0.25), 0, 0, math.sin(0.25)]
    poses = {"left": Frame([0, 0.2, 0], turn), "right": Frame([0, -0.2, 0.1], [0, 0, 0, 1])}
    expected = Robot.combine(poses, left=alone, right=alone)
    assert both.links == expected.links == end_links(both.model)
    joints = torch.linspace(-1, 1, both.n_joints).double()
    difference = both.state(joints).positions - expected.state(joints).positions
    assert float(difference.abs().max()) < 1e-12


def test_robots_that_are_not_there_are_told_beside_those_that_are() -> None:
    with pytest.raises(DataError, match=r"no file 'so100'; .*'so101', 'upper_body'"):
        parse_robot("left=so100@0,0.2,0")


def test_the_two_arms_are_named_as_lerobot_names_their_motors() -> None:
    motors = [f"{side}_{name}" for side in ("left", "right") for name in (*ARM, "gripper")]
    assert list(Robot.from_urdf(bi_so101_urdf(), []).joint_names) == motors


def test_hands_are_known_by_their_grippers() -> None:
    assert end_links(zoo(("tip",)).model) == ("flange",)  # which carries two fingers
    assert parse_robot("upper_body").links == ("l_hand", "r_hand")
    assert parse_robot("so101", ["wrist_link"]).links == ("wrist_link",)
    assert parse_robot(so101_urdf()).links == ("gripper_frame_link",)
    assert not parse_robot(so101_urdf().replace('"gripper"', '"roll"')).links

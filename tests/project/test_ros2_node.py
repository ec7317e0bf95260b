"""The ROS 2 example, with a stub in place of ROS."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support import ros_stub, skills
from tests.support.skills import small_bottle
from tpgmm_control import Controller
from tpgmm_torch import save

FILE = Path(__file__).parents[2] / "examples" / "ros2_node.py"


@pytest.fixture
def node(monkeypatch, tmp_path):
    model = skills.small_bottle()
    save(model, tmp_path / "model")
    ros_stub.install(monkeypatch, model=str(tmp_path / "model"), rate=10.0, base_frame="torso")
    return runpy.run_path(str(FILE))["SkillNode"]()


START = skills.few_bottles()[0]
NAMES = list(skills.small_bottle().kinematics_.joint_names)


def tell_joints(node, positions) -> None:
    """In the reverse order, and with one that the model does not know."""
    names = [*reversed(NAMES), "gripper"]
    node.heard["joint_states"](name=names, position=[*reversed(list(positions)), 0.5])


def tell_bottle(node, frame_id="torso", shift=0.0, norm=1.0) -> None:
    pose = START.frames["bottle"]
    x, y, z = pose.position.tolist()
    qw, qx, qy, qz = (norm * pose.orientation).tolist()
    node.heard["frames/bottle"](
        header=SimpleNamespace(frame_id=frame_id),
        pose=SimpleNamespace(
            position=SimpleNamespace(x=x + shift, y=y, z=z),
            orientation=SimpleNamespace(w=qw, x=qx, y=qy, z=qz),
        ),
    )


def test_nothing_is_sent_before_everything_is_known(node):
    node.tick()
    tell_joints(node, START.joints[0].tolist())
    node.tick()
    assert node.sent["joint_trajectory"] == []
    tell_bottle(node, frame_id="camera")
    tell_bottle(node, norm=3.0)
    node.heard["joint_states"](name=["gripper"], position=[0.0])
    node.tick()
    assert node.sent["joint_trajectory"] == []
    assert [text.split(":")[0] for text in node.warnings] == [
        "the pose of 'bottle' is in 'camera', not in 'torso'",
        "the pose of 'bottle'",
        f"joint_states lacks {NAMES}",
    ]


def test_a_robot_that_follows_is_led_as_the_controller_leads_it(node):
    joints = START.joints[0]
    direct = Controller(small_bottle().skill, joints, START.frames)
    for _ in range(400):
        tell_joints(node, joints.tolist())
        tell_bottle(node)
        node.tick()
        message = node.sent["joint_trajectory"][-1]
        [point] = message.points
        told = {"bottle": START.frames["bottle"]}
        wanted = direct.step(0.1, joints, told)
        assert message.joint_names == NAMES
        np.testing.assert_allclose(point.positions, wanted.reference, atol=1e-6)
        np.testing.assert_allclose(point.velocities, wanted.velocity, atol=1e-5)
        assert (point.time_from_start.sec, point.time_from_start.nanosec) == (0, 100_000_000)
        assert node.sent["status"][-1].data.startswith(wanted.status)
        if wanted.status == "finished":
            break
        joints = wanted.reference
    assert direct.finished
    assert len(node.sent["status"]) > 100


def test_a_robot_that_is_not_heard_of_any_more_is_held(node):
    joints = START.joints[0].tolist()
    for step in range(30):
        if step < 15:
            tell_joints(node, joints)
            tell_bottle(node)
        node.tick()
        joints = list(node.sent["joint_trajectory"][-1].points[0].positions)
    assert node.sent["status"][-1].data.startswith("holding: ")
    last, before = (node.sent["joint_trajectory"][at].points[0].positions for at in (-1, -5))
    np.testing.assert_allclose(last, before, atol=1e-9)

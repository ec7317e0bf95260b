"""A ROS 2 node around the controller: measured joints and object poses in, references out.

    python examples/ros2_node.py --ros-args -p model:=out/demo/model -p rate:=100.0

It needs ROS 2 (rclpy and its common messages); in a workspace, put the file into a package of
yours. What it listens to and what it sends:

====================  ================================  ====================================
topic                 type                              what
====================  ================================  ====================================
``joint_states``      sensor_msgs/JointState            by name, in any order [rad]
``frames/NAME``       geometry_msgs/PoseStamped         of each frame, in the robot's base frame
``joint_trajectory``  trajectory_msgs/JointTrajectory   one point each tick, due one tick later
``status``            std_msgs/String                   of the skill, with the reason
====================  ================================  ====================================

The skill begins when joints and all frames are there. A pose whose ``header.frame_id`` is not
the parameter ``base_frame`` (if that is given) is refused: transform it first. The controller
gets the ages of joints and poses, and holds the robot when none were accepted for too long.
Where poses are only known at the start, ``-p follow_frames:=false``. After the end
the last reference is sent on. The node checks no collisions, and it is no emergency stop.
"""

from functools import partial
from typing import Any

import rclpy
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from tpgmm_control import Controller
from tpgmm_torch import Frame
from tpgmm_torch.persistence import load_model


class SkillNode(Node):
    """Runs one skill, once."""

    def __init__(self) -> None:
        super().__init__("tpgmm_skill")
        folder = self.declare_parameter("model", "").value
        self._follow = self.declare_parameter("follow_frames", True).value
        self._base = self.declare_parameter("base_frame", "").value
        self._period = 1.0 / self.declare_parameter("rate", 100.0).value
        self._model = load_model(folder, device="cpu")
        self._names = self._model.kinematics_.joint_names
        # of a frame that follows from the start posture nobody has to tell
        shown = self._model.skill.summary
        given = {} if shown is None else shown.frames
        self._required = [
            name
            for name in self._model.frame_names_
            if name not in given or given[name].link is None
        ]
        self._joints: list[float] | None = None
        self._frames: dict[str, Frame] = {}
        self._received: dict[str, float] = {}  # when, for "joints" and the frames
        self._controller: Controller | None = None
        self._last = 0.0
        self.create_subscription(JointState, "joint_states", self._on_joints, 10)
        for name in self._required:
            heard = partial(self._on_pose, name)
            self.create_subscription(PoseStamped, f"frames/{name}", heard, 10)
        self._out = self.create_publisher(JointTrajectory, "joint_trajectory", 10)
        self._status = self.create_publisher(String, "status", 10)
        self.create_timer(self._period, self._tick)

    def _on_joints(self, message: Any) -> None:
        positions = dict(zip(message.name, message.position, strict=False))
        if missing := [name for name in self._names if name not in positions]:
            self._warn(f"joint_states lacks {missing}")
            return
        self._joints = [positions[name] for name in self._names]
        self._received["joints"] = self._now()

    def _on_pose(self, name: str, message: Any) -> None:
        if self._controller is not None and not self._follow:
            return
        seen_from = message.header.frame_id
        if self._base and seen_from != self._base:
            self._warn(f"the pose of {name!r} is in {seen_from!r}, not in {self._base!r}")
            return
        at, turn = message.pose.position, message.pose.orientation
        try:
            frame = Frame((at.x, at.y, at.z), (turn.w, turn.x, turn.y, turn.z))
        except ValueError as error:  # not finite, or no unit quaternion
            self._warn(f"the pose of {name!r}: {error}")
            return
        self._frames[name], self._received[name] = frame, self._now()

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=5.0)

    def _now(self) -> float:
        return self.get_clock().now().nanoseconds * 1e-9

    def _tick(self) -> None:
        now = self._now()
        if self._controller is None:
            if self._joints is None or not self._frames.keys() >= set(self._required):
                return
            self._controller = Controller(self._model.skill, self._joints, self._frames)
            passed = self._period
        else:
            passed = now - self._last
        self._last = now
        if passed <= 0:  # a simulator's clock stands
            return
        told = self._frames if self._follow else {}
        ages = {name: now - self._received[name] for name in ("joints", *told)}
        command = self._controller.step(passed, self._joints, told, ages=ages)
        point = JointTrajectoryPoint()
        point.positions = command.reference.tolist()
        point.velocities = command.velocity.tolist()
        seconds, rest = divmod(round(self._period * 1e9), 10**9)
        point.time_from_start = Duration(sec=seconds, nanosec=rest)
        self._out.publish(JointTrajectory(joint_names=list(self._names), points=[point]))
        reason = command.reason()
        self._status.publish(
            String(data=f"{command.status}: {reason}" if reason else command.status.value)
        )


def main() -> None:
    """Run until Ctrl-C."""
    rclpy.init()
    node = SkillNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()


if __name__ == "__main__":
    main()

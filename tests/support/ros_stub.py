"""As much of ROS 2 as a node needs that only listens, ticks and publishes: no middleware."""

import sys
from types import ModuleType, SimpleNamespace


class Node:
    """Parameters come from ``Node.given``; the clock is ``seconds``; nothing runs by itself."""

    given: dict[str, object] = {}  # noqa: RUF012

    def __init__(self, name):
        self.name, self.seconds = name, 0.0
        self.heard, self.sent, self.warnings, self.timers = {}, {}, [], []

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=self.given.get(name, default))

    def create_subscription(self, kind, topic, callback, _depth):
        self.heard[topic] = lambda **fields: callback(kind(**fields))

    def create_publisher(self, _kind, topic, _depth):
        self.sent[topic] = []
        return SimpleNamespace(publish=self.sent[topic].append)

    def create_timer(self, period, callback):
        self.timers.append((period, callback))

    def get_clock(self):
        now = SimpleNamespace(nanoseconds=round(self.seconds * 1e9))
        return SimpleNamespace(now=lambda: now)

    def get_logger(self):
        return SimpleNamespace(warning=lambda text, **_throttle: self.warnings.append(text))

    def tick(self):
        """Let a period pass and run the timer."""
        [(period, callback)] = self.timers
        self.seconds += period
        callback()


class Message(SimpleNamespace):
    """Any message; a JointTrajectoryPoint is filled after it was made."""


MESSAGES = {
    "builtin_interfaces": ["Duration"],
    "geometry_msgs": ["PoseStamped"],
    "sensor_msgs": ["JointState"],
    "std_msgs": ["String"],
    "trajectory_msgs": ["JointTrajectory", "JointTrajectoryPoint"],
}


def install(monkeypatch, **parameters) -> None:
    """Let ``import rclpy`` find this; nodes get these parameters."""
    monkeypatch.setattr(Node, "given", parameters)
    rclpy, node = ModuleType("rclpy"), ModuleType("rclpy.node")
    node.Node = Node
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.setitem(sys.modules, "rclpy.node", node)
    for package, kinds in MESSAGES.items():
        messages = ModuleType(f"{package}.msg")
        for kind in kinds:
            setattr(messages, kind, Message)
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", messages)

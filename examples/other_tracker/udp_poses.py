"""Poses of objects from a tracker in another process, which sends them as UDP datagrams.

``pip install ./examples/other_tracker`` adds the source of poses ``udp``, and a cell file asks
for it; what has no tags needs no ``"target"``::

    {"source": "udp", "objects": {"cup": {}}}

The tracker (FoundationPose, a motion capture system, a robot's own) sends a JSON text for each
object and frame: its pose ``x y z qw qx qy qz`` in the robot's base frame [m], and the standard
deviations of position [m] and orientation [rad]. It may send ``{"problem": "why"}`` too, which
stops the robot until the next episode.

.. code-block:: python

    import json, socket, time

    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    while True:
        found = {"object": "cup", "pose": [0.4, 0.1, 0.02, 1, 0, 0, 0], "std": [0.002, 0.02]}
        sender.sendto(json.dumps(found).encode(), ("127.0.0.1", 47123))
        time.sleep(0.02)

Another port is chosen by the environment variable ``TPGMM_POSES_PORT``.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time as clock
from typing import Any

import numpy as np

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.poses import pose_matrix, pose_vector
from tpgmm_vision.sources import ObservedPose

#: A pose is valid for this long [s]: a tracker at 30 Hz may lose four pictures.
LONGEST_AGE = 0.15


class UdpPoses:
    """The latest pose of each object of a cell: a :class:`tpgmm_vision.sources.PoseSource`.

    A thread receives, so that ages are right however seldom poses are asked for.

    Parameters
    ----------
    cell : Cell
        Its objects are those that poses are given of; the ``pose`` of one is that of the
        object's frame in what the tracker calls the object.
    robot : Kinematics, optional
        Not needed here.

    Attributes
    ----------
    problem : str
        What the tracker says is wrong, or what it sent that is no pose.
    """

    def __init__(self, cell: Any, robot: Any = None) -> None:
        self._objects = dict(cell.objects)
        self._lock = threading.Lock()
        self._latest: dict[str, tuple[float, np.ndarray, np.ndarray]] = {}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        port = int(os.environ.get("TPGMM_POSES_PORT", "47123"))
        try:
            self._socket.bind(("127.0.0.1", port))
        except OSError as error:
            self._socket.close()
            raise DataError(
                f"port {port} cannot be listened to ({error}): another run may still do so; "
                "choose another one with TPGMM_POSES_PORT, for the tracker too"
            ) from error
        self.problem = ""
        threading.Thread(target=self._receive, daemon=True).start()

    def reset(self) -> None:
        """Forget what was received: another episode begins."""
        with self._lock:
            self.problem = ""
            self._latest.clear()

    def close(self) -> None:
        """Stop listening."""
        # wakes the thread up, which closes the socket
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
            own.sendto(b"", self._socket.getsockname())

    def poses(self, images: Any, joints: Any, time: float) -> dict[str, ObservedPose]:
        """The latest pose of each object, valid while it is young; pictures are not needed."""
        with self._lock:
            latest, now = dict(self._latest), clock.monotonic()
        found = {}
        for name, one in self._objects.items():
            if name not in latest:
                reason = f"no pose of {name!r} was received, but of {sorted(latest)}"
                nowhere = np.full(7, np.nan), np.full((6, 6), np.nan)
                found[name] = ObservedPose(*nowhere, False, reason)
                continue
            received, pose, covariance = latest[name]
            age = now - received
            found[name] = ObservedPose(
                pose_vector(pose @ one.pose),
                covariance,
                age <= LONGEST_AGE,
                "" if age <= LONGEST_AGE else f"the last pose was received {age:.2f} s ago",
            )
        return found

    def _receive(self) -> None:
        """Keep what comes until an empty datagram does."""
        with self._socket:
            while datagram := self._socket.recv(65536):
                now = clock.monotonic()
                try:
                    message = json.loads(datagram)
                    problem = str(message["problem"]) if "problem" in message else ""
                    named = {} if problem else {_name(message): (now, *_pose(message))}
                except (ValueError, KeyError, TypeError) as error:
                    text = datagram[:100].decode(errors="replace")
                    problem = f"the tracker sent {text}: {type(error).__name__}: {error}"
                    named = {}
                with self._lock:
                    self._latest |= named
                    self.problem = problem or self.problem


def _name(message: dict[str, Any]) -> str:
    """The object of a message."""
    if not isinstance(name := message["object"], str):
        raise TypeError(f"the object is a text, got {name!r}")
    return name


def _pose(message: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The pose (4, 4) and the covariance (6, 6) in a message."""
    position, orientation = map(float, message["std"])
    if not (0 < position < np.inf and 0 < orientation < np.inf):
        raise ValueError(f"std is two numbers above 0, got {message['std']}")
    deviations = np.repeat([position, orientation], 3)
    return pose_matrix(message["pose"]), np.diag(deviations**2)

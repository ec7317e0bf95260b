"""Reading back the page that ``write_motion`` writes."""

import base64
import re
from pathlib import Path

import msgspec
import numpy as np
import zstandard

#: Pictures per second of the recorded pages.
FPS = 2.0


class Recording:
    """The messages in a page: what was added to the scene, and where it was at which time."""

    def __init__(self, path: Path) -> None:
        self.page = path.read_text(encoding="utf-8")
        [embedded] = re.findall(r'__VISER_EMBED_DATA__="([^"]+)"', self.page)
        data = base64.b64decode(embedded)
        size = int.from_bytes(data[:8], "little")
        inner = zstandard.ZstdDecompressor().decompress(data[8:], max_output_size=size)
        length = int.from_bytes(inner[:8], "little")
        content = msgspec.msgpack.decode(inner[8 : 8 + length])
        self.duration, self.messages = content["durationSeconds"], content["messages"]
        self._buffers, at = [], 8 + length
        for length in content["binaryBufferLengths"]:
            at += -at % 8
            self._buffers.append(inner[at : at + length])
            at += length

    @property
    def nodes(self) -> set[str]:
        """Paths of everything in the scene."""
        return {m["name"] for _, m in self.messages if "props" in m}

    def props(self, node: str) -> dict:
        """Properties of a node as it was added."""
        [found] = [
            m["props"] for _, m in self.messages if m.get("name") == node and "props" in m
        ]
        return {key: self._value(value) for key, value in found.items()}

    def pose(self, node: str, time: float) -> np.ndarray:
        """Position and quaternion of a node at a time, (7,)."""
        pose = {"position": np.zeros(3), "wxyz": np.array((1.0, 0.0, 0.0, 0.0))}
        for at, message in self.messages:
            if at <= time + 1e-9 and message.get("name") == node and "props" not in message:
                for key in pose.keys() & message.keys():
                    pose[key] = np.array(message[key])
        return np.concatenate(list(pose.values()))

    def _value(self, value):
        if not isinstance(value, dict) or "__binary_index" not in value:
            return value
        return np.frombuffer(self._buffers[value["__binary_index"]], value["dtype"])

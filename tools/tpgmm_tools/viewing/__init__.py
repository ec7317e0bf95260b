"""Motions in three dimensions: robot, objects, paths, and where the links may be.

Needs the extra ``cli`` (viser). :func:`write_motion` makes one HTML file that opens
anywhere; :class:`LiveView` serves the same scene, in which objects can be moved by hand.
"""

from tpgmm_tools.viewing.page import LiveView, write_motion
from tpgmm_tools.viewing.scene import MotionScene, ellipsoids
from tpgmm_tools.viewing.visuals import Shape, link_shapes, parse_shape

__all__ = [
    "LiveView", "MotionScene", "Shape", "ellipsoids", "link_shapes", "parse_shape",
    "write_motion",
]  # fmt: skip

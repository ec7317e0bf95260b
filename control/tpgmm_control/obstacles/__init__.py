"""Obstacles: distances of a robot from what is around it, and from itself."""

from tpgmm_control.obstacles.report import Contact, find_contacts
from tpgmm_control.obstacles.scene import Scene
from tpgmm_control.obstacles.shapes import Shape

__all__ = ["Contact", "Scene", "Shape", "find_contacts"]

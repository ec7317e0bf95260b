"""Obstacles: distances of a robot from what is around it, and from itself."""

from tpgmm_torch.obstacles.report import Contact, find_contacts
from tpgmm_torch.obstacles.scene import Scene
from tpgmm_torch.obstacles.shapes import Shape

__all__ = ["Contact", "Scene", "Shape", "find_contacts"]

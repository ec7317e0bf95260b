"""A simulated robot with two arms, found by LeRobot's commands as a plugin."""

from .bimanual import Bimanual
from .config_bimanual import BimanualConfig

__all__ = ["Bimanual", "BimanualConfig"]

"""The whole body of a robot, of which the model's links are only a part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.urdf import MULTIPLE_TYPES, UrdfModel, read_urdf
from tpgmm_torch.viewing.visuals import Shape, link_shapes

__all__ = ["whole_body"]


def whole_body(
    kinematics: Kinematics, meshes: Path | None = None
) -> tuple[Kinematics, Mapping[str, Sequence[Shape]]]:
    """Kinematics of all links that can be seen, and their shapes.

    Parameters
    ----------
    kinematics : Kinematics
        Of a model. A :class:`Robot` knows its URDF; of any other only the links are seen.
    meshes : Path, optional
        Folder with the files of the robot's meshes.

    Returns
    -------
    kinematics : Kinematics
        In float64 on the CPU, the links of the model first.
    shapes : mapping of str to sequence of Shape
        By name of the link.
    """
    if not isinstance(kinematics, Robot):
        return kinematics.to(torch.float64, "cpu"), {}
    config = kinematics.config() | {"dtype": "float64"}
    urdf = read_urdf(config["urdf"])
    held = _held_by(urdf, config["base"])
    shapes = {link: s for link, s in link_shapes(urdf, meshes).items() if link in held}
    config["links"] += [link for link in shapes if link not in kinematics.links]
    return Robot.from_config(config), shapes


def _held_by(urdf: UrdfModel, base: str) -> set[str]:
    """Links between which and the base there is no joint of several degrees of freedom."""
    held, front = {base}, [base]
    joints = [joint for joint in urdf.joints if joint.type not in MULTIPLE_TYPES]
    while front:
        at = front.pop()
        ends = [(j.parent, j.child) for j in joints if at in (j.parent, j.child)]
        found = {link for pair in ends for link in pair} - held
        held |= found
        front += found
    return held

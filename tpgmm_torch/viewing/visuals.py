"""What a robot looks like: the shapes of its links, as a URDF's ``<visual>`` elements say.

Boxes, cylinders, spheres, and meshes where their files are given. A link whose meshes are not
at hand is drawn as sticks that lead from its origin to the joints that hang on it, so that any
robot can be looked at with nothing but its URDF.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal
from xml.etree import ElementTree

import numpy as np

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.urdf import UrdfModel, placement

__all__ = ["Color", "Shape", "link_shapes"]

Color = tuple[int, int, int]

DEFAULT_COLOR: Color = (125, 145, 165)
#: A stick's radius: this share of its length, but between these two [m].
STICK, THINNEST, THICKEST = 0.06, 0.004, 0.02


@dataclass(frozen=True, eq=False)
class Shape:
    """A solid that is fixed to a link.

    Parameters
    ----------
    kind : {"box", "cylinder", "sphere", "mesh"}
    size : tuple of float
        Edges of a box; radius and length (along z) of a cylinder; radius of a sphere [m];
        scale of a mesh.
    pose : ndarray of shape (4, 4)
        In the link; the centre of a primitive.
    color : tuple of int
        Red, green, blue, 0 to 255.
    opacity : float
        0 to 1.
    file : Path, optional
        Of a mesh.
    """

    kind: Literal["box", "cylinder", "sphere", "mesh"]
    size: tuple[float, ...]
    pose: Array
    color: Color = DEFAULT_COLOR
    opacity: float = 1.0
    file: Path | None = None


def link_shapes(model: UrdfModel, meshes: Path | None = None) -> dict[str, list[Shape]]:
    """The shapes of every link that has any.

    Parameters
    ----------
    model : UrdfModel
    meshes : Path, optional
        Folder with the mesh files. Of a name like ``package://robot/meshes/hand.stl`` the
        longest end counts that exists there. Without a folder meshes become sticks.

    Returns
    -------
    dict of str to list of Shape
        By name of the link, in the link's frame.

    Raises
    ------
    DataError
        If a visual is not one that URDF knows, or a mesh is not in the folder.
    """
    root = ElementTree.fromstring(model.text)
    materials = {m.get("name"): m for m in root.findall("material")}
    visuals = {str(link.get("name")): link.findall("visual") for link in root.findall("link")}
    plain = not any(visuals.values())
    shapes: dict[str, list[Shape]] = {}
    for link, elements in visuals.items():
        found = [_shape(element, link, materials, meshes) for element in elements]
        drawn = [shape for shape in found if shape is not None]
        if not drawn and (elements or plain):
            drawn = _sticks(model, link)
        if drawn:
            shapes[link] = drawn
    return shapes


def _shape(
    visual: ElementTree.Element,
    link: str,
    materials: Mapping[str | None, ElementTree.Element],
    meshes: Path | None,
) -> Shape | None:
    """One ``<visual>``; None for a mesh without a folder to look in."""
    geometry = visual.find("geometry")
    solids = [] if geometry is None else list(geometry)
    if len(solids) != 1 or solids[0].tag not in ("box", "cylinder", "sphere", "mesh"):
        raise DataError(
            f"a <visual> of link {link!r} needs one <box>, <cylinder>, <sphere> or <mesh> in "
            f"its <geometry>, got {[solid.tag for solid in solids]}"
        )
    solid, origin = solids[0], visual.find("origin")
    pose = np.eye(4)
    if origin is not None:
        xyz, rpy = (_numbers(origin, key, 3, link, "0 0 0") for key in ("xyz", "rpy"))
        pose = placement(np.array(xyz), np.array(rpy))
    color, opacity = _color(visual, link, materials)
    match solid.tag:
        case "box":
            return Shape("box", _numbers(solid, "size", 3, link), pose, color, opacity)
        case "sphere":
            return Shape("sphere", _numbers(solid, "radius", 1, link), pose, color, opacity)
        case "cylinder":
            size = _numbers(solid, "radius", 1, link) + _numbers(solid, "length", 1, link)
            return Shape("cylinder", size, pose, color, opacity)
    if meshes is None:
        return None
    scale = _numbers(solid, "scale", 3, link, "1 1 1")
    file = _mesh_file(solid.get("filename", ""), link, meshes)
    return Shape("mesh", scale, pose, color, opacity, file)


def _numbers(
    element: ElementTree.Element, key: str, count: int, link: str, default: str | None = None
) -> tuple[float, ...]:
    text = element.get(key, default)
    try:
        values = tuple(float(word) for word in (text or "").split())
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise DataError(
            f"a <visual> of link {link!r}: <{element.tag} {key}> needs {count} finite "
            f"number(s), got {text!r}"
        )
    return values


def _color(
    visual: ElementTree.Element,
    link: str,
    materials: Mapping[str | None, ElementTree.Element],
) -> tuple[Color, float]:
    """A material may be described in place, or once for the whole robot and named here."""
    material = visual.find("material")
    color = None if material is None else material.find("color")
    if material is not None and color is None and material.get("name") in materials:
        color = materials[material.get("name")].find("color")
    if color is None:
        return DEFAULT_COLOR, 1.0
    red, green, blue, opacity = np.clip(_numbers(color, "rgba", 4, link), 0, 1)
    return (round(255 * red), round(255 * green), round(255 * blue)), float(opacity)


def _mesh_file(name: str, link: str, folder: Path) -> Path:
    path = PurePosixPath(name.partition("://")[2] or name)
    parts: Sequence[str] = [p for p in path.parts if p not in ("/", "..")]
    for start in range(len(parts)):
        file = folder.joinpath(*parts[start:])
        if file.is_file():
            return file
    raise DataError(f"mesh {name!r} of link {link!r} is not in the folder {folder}")


def _sticks(model: UrdfModel, link: str) -> list[Shape]:
    """A stick to each joint that hangs on the link; a small ball where none does."""
    ends = [joint.origin[:3, 3] for joint in model.joints if joint.parent == link]
    sticks = [_stick(end) for end in ends if np.linalg.norm(end) > THINNEST]
    return sticks or [Shape("sphere", (2 * THINNEST,), np.eye(4))]


def _stick(end: Array) -> Shape:
    """A cylinder from the origin to ``end``: its z axis along that way."""
    length = float(np.linalg.norm(end))
    z = end / length
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack((x, np.cross(z, x), z))
    pose[:3, 3] = end / 2
    return Shape("cylinder", (float(np.clip(STICK * length, THINNEST, THICKEST)), length), pose)

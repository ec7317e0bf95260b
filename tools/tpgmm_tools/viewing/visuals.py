"""Shapes of a robot's links, from the ``<visual>`` elements of its URDF, and of objects.

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
import torch

from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.urdf import FREEDOMS, UrdfModel, parse_xml, placement, read_urdf

__all__ = ["Shape"]

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
        Kind of solid.
    size : tuple of float
        Edges of a box; radius and length (along z) of a cylinder; radius of a sphere [m];
        scale of a mesh.
    pose : ndarray of shape (4, 4)
        In the link; the centre of a primitive.
    color, opacity : tuple of int, float
        Red, green, blue, 0 to 255; 0 to 1.
    file : Path, optional
        Of a mesh.
    """

    kind: Literal["box", "cylinder", "sphere", "mesh"]
    size: tuple[float, ...]
    pose: Array
    color: Color = DEFAULT_COLOR
    opacity: float = 1.0
    file: Path | None = None

    @property
    def placement(self) -> Array:
        """The pose as position [m] and quaternion, of shape (7,)."""
        turn = torch.from_numpy(np.ascontiguousarray(self.pose[:3, :3]))
        return np.concatenate((self.pose[:3, 3], quaternions.from_matrix(turn).numpy()))


#: Attributes in URDF that say how large a solid is: name, number of values, default.
ATTRIBUTES: Mapping[str, Sequence[tuple[str, int, str | None]]] = {
    "box": [("size", 3, None)],
    "cylinder": [("radius", 1, None), ("length", 1, None)],
    "sphere": [("radius", 1, None)],
    "mesh": [("scale", 3, "1 1 1")],
}
#: Of objects, and how many numbers say how large a solid is.
OBJECT_COLOR: Color = (230, 159, 0)
OBJECT_OPACITY = 0.6
SIZES: Mapping[str, int] = {"box": 3, "cylinder": 2, "sphere": 1}


def parse_shape(text: str) -> Shape:
    """Read an object's shape from text, about the origin of its frame.

    Parameters
    ----------
    text : str
        ``"box:0.1,0.1,0.2"``, edges; ``"cylinder:0.04,0.2"``, radius and length along z;
        ``"sphere:0.05"``, radius [m].

    Raises
    ------
    DataError
        If the text has another form.

    Examples
    --------
    >>> parse_shape("cylinder:0.04,0.2").size
    (0.04, 0.2)
    """
    kind, _, numbers = text.partition(":")
    try:
        size = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        size = ()
    if len(size) != SIZES.get(kind) or not all(0 < edge < math.inf for edge in size):
        raise DataError(
            "a shape is box:X,Y,Z, cylinder:RADIUS,LENGTH or sphere:RADIUS in metres, got "
            f"{text!r}"
        )
    return Shape(kind, size, np.eye(4), OBJECT_COLOR, OBJECT_OPACITY)  # type: ignore[arg-type]


def link_shapes(model: UrdfModel, meshes: Path | None = None) -> dict[str, list[Shape]]:
    """Return the shapes of every link that has any, by name, in the link's frame.

    Parameters
    ----------
    model : UrdfModel
        Whose ``<visual>`` elements count.
    meshes : Path, optional
        Folder with the mesh files. Of a name like ``package://robot/meshes/hand.stl`` the
        longest end counts that exists there. Without a folder meshes become sticks.

    Raises
    ------
    DataError
        If a visual is not one that URDF knows, or a mesh is not in the folder.
    """
    root = parse_xml(model.text)
    materials = {m.get("name"): m for m in root.findall("material")}
    visuals = {str(link.get("name")): link.findall("visual") for link in root.findall("link")}
    plain = not any(visuals.values())
    shapes: dict[str, list[Shape]] = {}
    for link, elements in visuals.items():
        read = (_shape(element, link, materials, meshes) for element in elements)
        if solids := [shape for shape in read if shape is not None]:
            shapes[link] = solids
        elif elements or plain:
            shapes[link] = _sticks(model, link)
    return shapes


def _shape(
    visual: ElementTree.Element,
    link: str,
    materials: Mapping[str | None, ElementTree.Element],
    meshes: Path | None,
) -> Shape | None:
    """Read a ``<visual>``; None for a mesh without a folder to look in."""
    geometry = visual.find("geometry")
    solids = [] if geometry is None else list(geometry)
    if len(solids) != 1 or solids[0].tag not in ATTRIBUTES:
        raise DataError(
            f"a <visual> of link {link!r} needs one <box>, <cylinder>, <sphere> or <mesh> in "
            f"its <geometry>, got {[solid.tag for solid in solids]}"
        )
    [solid], pose = solids, _origin(visual, link)
    color, opacity = _color(visual, link, materials)
    file = None
    if solid.tag == "mesh":
        if meshes is None:
            return None
        file = _mesh_file(solid.get("filename", ""), link, meshes)
    sizes = [_numbers(solid, key, n, link, usual) for key, n, usual in ATTRIBUTES[solid.tag]]
    return Shape(solid.tag, sum(sizes, ()), pose, color, opacity, file)  # type: ignore[arg-type]


def _origin(visual: ElementTree.Element, link: str) -> Array:
    origin = visual.find("origin")
    if origin is None:
        return np.eye(4)
    xyz, rpy = (_numbers(origin, key, 3, link, "0 0 0") for key in ("xyz", "rpy"))
    return placement(xyz, rpy)


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
    """Read a material: described in place, or once for the whole robot and named here."""
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
    """Make a stick to each joint that hangs on the link; a small ball where none does."""
    ends = [joint.origin[:3, 3] for joint in model.joints if joint.parent == link]
    sticks = [_stick(end) for end in ends if np.linalg.norm(end) > THINNEST]
    return sticks or [Shape("sphere", (2 * THINNEST,), np.eye(4))]


def _stick(end: Array) -> Shape:
    """Make a cylinder from the origin to ``end``: its z axis along that way."""
    length = float(np.linalg.norm(end))
    z = end / length
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack((x, np.cross(z, x), z))
    pose[:3, 3] = end / 2
    return Shape("cylinder", (float(np.clip(STICK * length, THINNEST, THICKEST)), length), pose)


def whole_body(
    kinematics: Kinematics, meshes: Path | None = None
) -> tuple[Kinematics, Mapping[str, Sequence[Shape]]]:
    """Return the kinematics of all links that can be seen, in float64 on the CPU, and shapes.

    Parameters
    ----------
    kinematics : Kinematics
        Of a model; its links come first. A :class:`Robot` knows its URDF; of any other only
        the links are seen.
    meshes : Path, optional
        Folder with the files of the robot's meshes.
    """
    if not isinstance(kinematics, Robot):
        return kinematics.to(torch.float64, "cpu"), {}
    config = kinematics.config() | {"dtype": "float64"}
    urdf = read_urdf(config["urdf"])
    held = _links_on(urdf, config["base"])
    shapes = {link: s for link, s in link_shapes(urdf, meshes).items() if link in held}
    config["links"] += [link for link in shapes if link not in kinematics.links]
    return Robot.from_config(config), shapes


def _links_on(urdf: UrdfModel, base: str) -> set[str]:
    """Return links between which and the base no joint has several degrees of freedom."""
    held, front = {base}, [base]
    joints = [joint for joint in urdf.joints if FREEDOMS[joint.type] <= 1]
    while front:
        at = front.pop()
        ends = [(j.parent, j.child) for j in joints if at in (j.parent, j.child)]
        new = {link for pair in ends for link in pair} - held
        held |= new
        front += new
    return held


def unit_ball() -> tuple[Array, Array]:
    """Return vertices (V, 3) and triangles (F, 3) of a ball of radius 1."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(ball.vertices), np.asarray(ball.faces)


def mesh(shape: Shape) -> tuple[Array, Array]:
    """Return vertices (V, 3) [m] and triangles (F, 3) of a ``shape`` that is a mesh.

    Of the formats, COLLADA alone says in which unit its numbers are.

    Raises
    ------
    DataError, DependencyError
        If the file cannot be read, or a package is missing for its format.
    """
    import trimesh

    try:
        loaded = trimesh.load_mesh(shape.file)
        units = loaded.units
        unit = trimesh.units.unit_conversion(units, "meters") if units else 1.0
        return np.asarray(loaded.vertices) * unit * shape.size, np.asarray(loaded.faces)
    except ImportError as error:
        raise DependencyError(
            f"the mesh {shape.file} needs pycollada: pip install 'tpgmm-torch[collada]'"
        ) from error
    except Exception as error:  # whatever a reader of one of many formats raises
        raise DataError(f"the mesh {shape.file} cannot be read: {error}") from error

"""Solids that robots and their surroundings are made of, from URDF, MJCF or a few numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Self
from xml.etree import ElementTree

import numpy as np

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.mjcf import compile_mjcf, mujoco_module
from tpgmm_torch.robots.urdf import free_name, parse_xml

__all__ = ["Shape"]

#: How many numbers say how large a solid is: half edges; radius; radius and half length.
SIZES: Mapping[str, int] = {"box": 3, "sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3}
#: Thickness of a table top [m].
THICKNESS = 0.04


@dataclass(frozen=True, eq=False)
class Shape:
    """A solid, fixed to a link of the robot, to an object that moves, or to the base.

    Parameters
    ----------
    name : str
        Reports call it so; several solids may share a name.
    kind : {"box", "sphere", "capsule", "cylinder", "ellipsoid", "plane", "mesh"}
        Capsules and cylinders lie along z; meshes count as their convex hulls.
    size : sequence of float
        Half edges of a box or an ellipsoid; radius of a sphere; radius and half length of a
        capsule or a cylinder [m].
    pose : Frame
        Of its centre, in what carries it.
    carrier : str, optional
        The link or the frame that it moves with; None for what stands still in the base frame.
    vertices : ndarray of shape (V, 3), optional
        Of a mesh [m].
    rest : Frame, optional
        Where an object stands of which no pose is given.

    Raises
    ------
    DataError
        If sizes are no positive numbers, or too many or too few.

    Examples
    --------
    >>> Shape.box("shelf", [0.6, 0.3, 0.02], [0.4, 0.0, 1.1]).size
    (0.3, 0.15, 0.01)
    """

    name: str
    kind: str
    size: Sequence[float]
    pose: Frame
    carrier: str | None = None
    vertices: Array | None = None
    rest: Frame | None = None

    def __post_init__(self) -> None:
        if self.kind in ("plane", "mesh"):
            return
        size = tuple(map(float, self.size))
        if len(size) != SIZES.get(self.kind) or not all(0 < x < math.inf for x in size):
            raise DataError(
                f"a solid is one of {', '.join(SIZES)}, with {SIZES.get(self.kind, 'as many')} "
                f"positive size(s) in metres; {self.name!r} is a {self.kind!r} of {size}"
            )
        object.__setattr__(self, "size", size)

    @classmethod
    def box(cls, name: str, edges: Sequence[float], position: Any, **where: Any) -> Self:
        """A box of three edges [m] about a ``position`` (3,) [m].

        Parameters
        ----------
        name : str
        edges : sequence of three floats
        position : array-like of shape (3,)
        **where
            ``orientation``, a quaternion (w, x, y, z), and ``carrier``, the frame or link in
            which it stands.
        """
        return cls(name, "box", [x / 2 for x in edges], *_placed(position, **where))

    @classmethod
    def sphere(cls, name: str, radius: float, position: Any, **where: Any) -> Self:
        """A sphere about a ``position`` (3,) [m]; ``where`` as for :meth:`box`."""
        return cls(name, "sphere", [radius], *_placed(position, **where))

    @classmethod
    def cylinder(
        cls, name: str, radius: float, length: float, position: Any, **where: Any
    ) -> Self:
        """A cylinder along z about a ``position`` (3,) [m]; ``where`` as for :meth:`box`."""
        return cls(name, "cylinder", [radius, length / 2], *_placed(position, **where))

    @classmethod
    def capsule(
        cls, name: str, radius: float, begin: Sequence[float], end: Sequence[float]
    ) -> Self:
        """All that is nearer than ``radius`` to a segment from ``begin`` to ``end`` [m]."""
        ends = np.array([begin, end], float)
        way = ends[1] - ends[0]
        length = float(np.linalg.norm(way))
        if not 0 < length < math.inf:
            raise DataError(f"a capsule leads from one point to another, got {begin}, {end}")
        # the turn of z into the segment: half of the way there, and back by half a turn
        half = np.array([0.0, 0.0, 1.0]) + way / length
        half = half / np.linalg.norm(half) if np.linalg.norm(half) > 1e-9 else np.eye(3)[0]
        pose = Frame(ends.mean(0), np.array([0.0, *half]))
        return cls(name, "capsule", [radius, length / 2], pose)

    @classmethod
    def table(
        cls,
        height: float,
        *,
        name: str = "table",
        size: Sequence[float] = (1.0, 1.6),
        centre: Sequence[float] = (0.6, 0.0),
    ) -> Self:
        """A table top of a ``height`` [m] above the base: finite, so it ends before a robot.

        Parameters
        ----------
        height : float
            Of its upper side.
        name : str
        size, centre : sequence of two floats
            Along x and y [m].
        """
        return cls.box(name, [*size, THICKNESS], [*centre, height - THICKNESS / 2])


def _placed(
    position: Any, orientation: Any = None, carrier: str | None = None
) -> tuple[Any, ...]:
    pose = Frame(position) if orientation is None else Frame(position, orientation)
    if pose.batch_shape:
        raise DataError(f"a solid has one position (3,), got {tuple(pose.position.shape)}")
    return pose, carrier


def excluded(model: Any) -> list[tuple[str, str]]:
    """Names of the bodies whose contacts a compiled ``model`` excludes."""
    pairs = [divmod(int(both), 1 << 16) for both in model.exclude_signature]
    return [(model.body(one).name, model.body(other).name) for one, other in pairs]


def solids(model: Any, links: Sequence[str], base: str, visuals: bool) -> Iterator[Shape]:
    """The solids of a compiled MuJoCo model.

    Parameters
    ----------
    model : mujoco.MjModel
    links : sequence of str
        Links of the robot: solids of bodies of these names are theirs. Other bodies stand
        still, but for free ones, which are objects that move with the frame of their name.
    base : str
        In its frame others stand, where a body is called so.
    visuals : bool
        Whether solids count that collide with nothing.
    """
    mujoco = mujoco_module("distances")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names = [model.body(i).name or free_name(f"body{i}", ()) for i in range(model.nbody)]
    at = names.index(base) if base in names else 0
    bodies = [Frame(data.xpos[i].copy(), data.xquat[i].copy()) for i in range(model.nbody)]
    bodies = [pose.seen_from(bodies[at]) for pose in bodies]
    for index in range(model.ngeom):
        if visuals or model.geom_contype[index] or model.geom_conaffinity[index]:
            yield _solid(model, names, bodies, index, links)


def _solid(
    model: Any, names: Sequence[str], bodies: Sequence[Frame], index: int, links: Sequence[str]
) -> Shape:
    """One of the solids of a compiled model, with the poses of its bodies in the base frame."""
    geom, body = model.geom(index), int(model.geom_bodyid[index])
    kind = mujoco_module("distances").mjtGeom(int(model.geom_type[index])).name
    kind = kind.removeprefix("mjGEOM_").lower()
    size = geom.size[: SIZES.get(kind, 3)].tolist()
    pose = Frame(geom.pos.copy(), geom.quat.copy())
    vertices = _vertices(model, index) if kind == "mesh" else None
    if names[body] in links:
        return Shape(names[body], kind, size, pose, names[body], vertices)
    root, world = int(model.body_rootid[body]), bodies[body].compose(pose)
    if _floats(model, root):
        pose = world.seen_from(bodies[root])
        return Shape(names[root], kind, size, pose, names[root], vertices, bodies[root])
    name = names[body] if body else geom.name or f"geom{index}"
    return Shape(name, kind, size, world, None, vertices)


def _floats(model: Any, root: int) -> bool:
    """Whether a body is free, or set from outside."""
    first = int(model.body_jntadr[root])
    return bool(model.body_mocapid[root] >= 0 or (first >= 0 and model.jnt_type[first] == 0))


def _vertices(model: Any, geom: int) -> Array:
    mesh = int(model.geom_dataid[geom])
    at = int(model.mesh_vertadr[mesh])
    found: Array = model.mesh_vert[at : at + int(model.mesh_vertnum[mesh])].astype(np.float64)
    return found


def urdf_solids(text: str, meshes: Path | None, visuals: bool) -> list[Shape]:
    """The solids of the links of a URDF, which MuJoCo reads link by link.

    Parameters
    ----------
    text : str
    meshes : Path, optional
        The folder of mesh files.
    visuals : bool
        Whether ``<visual>`` counts where a link has no ``<collision>``.

    Raises
    ------
    DataError
        If no link has collision geometry, or a mesh is not found.
    """
    links = {str(link.get("name")): link for link in parse_xml(text).findall("link")}
    tags = ["collision", "visual"] if visuals else ["collision"]
    flat, root = ElementTree.Element("robot", name="solids"), free_name("root", links)
    settings = {"fusestatic": "false", "discardvisual": "false", "strippath": "false"}
    ElementTree.SubElement(ElementTree.SubElement(flat, "mujoco"), "compiler", settings)
    ElementTree.SubElement(flat, "link", name=root)
    for name, link in links.items():
        found = next(filter(None, map(link.findall, tags)), [])
        if found:
            joint = ElementTree.SubElement(flat, "joint", name=name, type="fixed")
            ElementTree.SubElement(joint, "parent", link=root)
            ElementTree.SubElement(joint, "child", link=name)
            one = ElementTree.SubElement(flat, "link", name=name)
            one.extend([_collision(element, name, meshes) for element in found])
    if len(flat) == 2:
        seen = any(link.find("visual") is not None for link in links.values())
        raise DataError(
            "no link of the robot has collision geometry"
            + (", only visuals: visuals=True takes these" if seen else "")
            + "; or give the file that has it, geometry='robot.xml'"
        )
    model = compile_mjcf(ElementTree.tostring(flat, encoding="unicode"), "the robot")
    return [replace(one, carrier=one.name) for one in solids(model, list(links), root, True)]


def _collision(
    element: ElementTree.Element, link: str, meshes: Path | None
) -> ElementTree.Element:
    """The solid of an element of a link, with the paths of its meshes."""
    solid = ElementTree.Element("collision")
    solid.extend([part for part in element if part.tag in ("origin", "geometry")])
    for mesh in solid.iter("mesh"):
        mesh.set("filename", str(_mesh_file(mesh.get("filename", ""), link, meshes)))
    return solid


def _mesh_file(name: str, link: str, folder: Path | None) -> Path:
    """The longest end of a name that exists in the folder."""
    path = PurePosixPath(name.partition("://")[2] or name)
    parts = [part for part in path.parts if part not in ("/", "..")]
    for start in range(len(parts) if folder else 0):
        assert folder is not None
        if (file := folder.joinpath(*parts[start:]).resolve()).is_file():
            return file
    where = "sight" if folder is None else str(folder)
    raise DataError(
        f"link {link!r} has the mesh {name!r}, which is not in {where}"
        ": give the folder of the mesh files, meshes='...'"
    )

"""Tags on the bodies of a simulated scene: which, where, and how they are drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import mujoco
import numpy as np

from tpgmm_vision.poses import Array, pose_vector, rigid
from tpgmm_vision.targets import FAMILIES, Target, modules_of, target_from

__all__ = ["CUBE_ROOM", "Carrier", "add_carrier", "cube_at", "flat_at"]

#: Edges of the black squares of tags on cubes, and of those that lie flat [m].
CUBE, FLAT = 0.040, 0.060
#: How far from a surface the middle of a cube is that is fixed to it [m].
CUBE_ROOM = CUBE * 10 / 16 + 0.002
#: Pixels of a module of a tag: with a power of two, its mipmaps keep the edges of modules.
PIXELS = 32
#: Of the plates on which tags are drawn [m].
THICKNESS = 0.001
#: How much a plate shines by itself, so that sides in the shade are seen.
EMISSION = 0.25
#: Faces of a plate: two triangles that show the tag, then its back and its edges.
PLATE = (
    (0, 3, 1), (1, 3, 2),
    (4, 5, 7), (5, 6, 7), (0, 1, 4), (1, 5, 4), (1, 2, 5), (2, 6, 5), (2, 3, 6), (3, 7, 6),
    (3, 0, 7), (0, 4, 7),
)  # fmt: skip
#: Where the corners of the tag are in its texture, and a white place.
TEXTURE = ((0, 0), (1, 0), (1, 1), (0, 1), (0.01, 0.01))


@dataclass(frozen=True, eq=False)
class Carrier:
    """Tags that a body carries.

    Parameters
    ----------
    entry : mapping
        The target as a cell file describes it, ``{"tag": 3, "size": 0.06}``.
    pose : ndarray of shape (4, 4)
        Of the target in the frame of the body.
    upright : bool, default=False
        Whether the z axis of the body is always vertical.
    """

    entry: Mapping[str, Any]
    pose: Array
    upright: bool = False

    @property
    def target(self) -> Target:
        """Where the corners of the tags are."""
        return target_from(self.entry)


def cube_at(
    first: int, x: float = 0.0, y: float = 0.0, z: float = 0.0, size: float = CUBE
) -> Carrier:
    """A cube of five tags, turned as the body is.

    Parameters
    ----------
    first : int
        Its tags are this and the next four.
    x, y, z : float
        Its middle in the frame of the body [m].
    size : float, default=0.04
        Edges of the black squares; the cube is a quarter larger [m].
    """
    entry = {"cube": [*range(first, first + 5)], "size": size}
    return Carrier(entry, rigid(np.zeros(3), (x, y, z)))


def flat_at(
    number: int,
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    size: float = FLAT,
    upright: bool = True,
) -> Carrier:
    """A tag that lies in the plane z of the body, to be read from before the robot.

    Parameters
    ----------
    number : int
    x, y, z : float
        Its middle in the frame of the body [m].
    size : float, default=0.06
        Edge of the black square [m].
    upright : bool, default=True
        Whether the body always lies level.
    """
    pose = rigid((0.0, 0.0, math.pi / 2), (x, y, z))
    return Carrier({"tag": number, "size": size}, pose, upright)


def add_carrier(spec: mujoco.MjSpec, body: str, carrier: Carrier) -> None:
    """Draw tags on a body: thin plates without mass, with which nothing collides.

    Parameters
    ----------
    spec : mujoco.MjSpec
        Of the scene that is drawn; its bodies stay those that they are.
    body : str
        ``"world"`` is what stands still.
    carrier : Carrier
    """
    target = carrier.target
    modules = modules_of(target.family)
    for number, corners in target.corners.items():
        name, half = f"tag {number}", np.linalg.norm(corners[1] - corners[0]) / 2
        half *= (modules + 2) / modules
        _add_texture(spec, name, target.family, number, modules)
        edge = np.array(
            [[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]]
        )
        corner, faces = np.full((len(PLATE), 3), len(TEXTURE) - 1), np.array(PLATE)
        corner[:2] = faces[:2]
        mesh = spec.add_mesh(name=name)
        mesh.uservert = np.concatenate((edge, edge - (0, 0, THICKNESS))).ravel().tolist()
        mesh.userface, mesh.userfacetexcoord = faces.ravel().tolist(), corner.ravel().tolist()
        mesh.usertexcoord = np.ravel(TEXTURE).tolist()
        place = pose_vector(carrier.pose @ _tag_pose(corners))
        spec.body(body).add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name,
            pos=place[:3], quat=place[3:], contype=0, conaffinity=0, mass=0,
        )  # fmt: skip


def _tag_pose(corners: Array) -> Array:
    """The frame (4, 4) of a tag whose corners (4, 3) these are."""
    x, y = corners[1] - corners[0], corners[0] - corners[3]
    x, y = x / np.linalg.norm(x), y / np.linalg.norm(y)
    return rigid(np.stack((x, y, np.cross(x, y)), axis=1), corners.mean(axis=0))


def _add_texture(spec: Any, name: str, family: str, number: int, modules: int) -> None:
    """A texture with a white module around the tag, and the material of it."""
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    black = cv2.aruco.generateImageMarker(dictionary, number, modules * PIXELS)
    picture = np.pad(black, PIXELS, constant_values=255)
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3,
        width=picture.shape[1], height=picture.shape[0],
    )  # fmt: skip
    texture.data = np.repeat(picture[..., None], 3, axis=2).tobytes()
    material = spec.add_material(name=name, specular=0.0, shininess=0.0, emission=EMISSION)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name

"""Tags on the bodies of a simulated scene: which, where, and how they are drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import mujoco
import numpy as np

from lerobot_env_bimanual.robot_scene import add_geom
from tpgmm_vision.poses import Array, pose_vector, rigid
from tpgmm_vision.targets import FAMILIES, Target, modules_of, target_from

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
#: Triangles of a plate between the corners of its front and those of its back; the first two
#: show the texture, whose corners come first, the others a white place of it.
PLATE = "031 132 457 567 014 154 125 265 236 376 307 047"
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
        """Corners of the tags."""
        return target_from(self.entry)


def cube_at(
    first: int, x: float = 0, y: float = 0, z: float = 0, size: float = CUBE
) -> Carrier:
    """Describe a cube of five tags, turned as the body is.

    Parameters
    ----------
    first : int
        Its tags are this and the next four.
    x, y, z : float
        Its middle in the frame of the body [m].
    size : float, default=0.04
        Edges of the black squares; the cube is a quarter larger [m].
    """
    cube = {"cube": [*range(first, first + 5)], "size": size}
    return Carrier(cube, rigid(np.zeros(3), (x, y, z)))


def flat_at(
    number: int, x: float, z: float, size: float = FLAT, upright: bool = True
) -> Carrier:
    """Describe a tag in the plane z of the body, to be read from before the robot.

    Parameters
    ----------
    number : int
    x, z : float
        Its middle in the frame of the body, in whose plane y = 0 it is [m].
    size : float, default=0.06
        Edge of the black square [m].
    upright : bool, default=True
        Whether the body always lies level.
    """
    pose = rigid((0.0, 0.0, math.pi / 2), (x, 0.0, z))
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
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[target.family])
    for number, corners in target.corners.items():
        black = cv2.aruco.generateImageMarker(dictionary, number, modules * PIXELS)
        picture = np.pad(black, PIXELS, constant_values=255)
        name, (height, width) = f"tag {number}", picture.shape
        texture = spec.add_texture(name=name, width=width, height=height, nchannel=3)
        texture.type = mujoco.mjtTexture.mjTEXTURE_2D
        texture.data = np.repeat(picture[..., None], 3, axis=2).tobytes()
        material = spec.add_material(name=name, specular=0.0, shininess=0.0, emission=EMISSION)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        x, y = corners[1] - corners[0], corners[0] - corners[3]
        half, x, y = np.linalg.norm(x) / 2, x / np.linalg.norm(x), y / np.linalg.norm(y)
        pose = carrier.pose @ rigid(np.stack((x, y, np.cross(x, y)), 1), corners.mean(axis=0))
        edge = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * half
        front = edge * (modules + 2) / modules
        faces = np.array([[int(one) for one in face] for face in PLATE.split()])
        shown = np.where(np.arange(len(faces))[:, None] < 2, faces, len(TEXTURE) - 1)
        mesh = spec.add_mesh(name=name, userface=faces.ravel(), userfacetexcoord=shown.ravel())
        mesh.uservert = np.concatenate((front, front - (0, 0, THICKNESS))).ravel()
        mesh.usertexcoord = np.ravel(TEXTURE)
        add_geom(
            spec.body(body), mujoco.mjtGeom.mjGEOM_MESH, (0, 0, 0), name=name, meshname=name,
            material=name, pos=pose[:3, 3], quat=pose_vector(pose)[3:], mass=0,
        )  # fmt: skip

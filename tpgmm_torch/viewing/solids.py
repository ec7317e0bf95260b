"""Shapes of a robot in a viser scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch import quaternions
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.viewing.visuals import Shape

__all__ = ["add_solid", "unit_sphere"]


def add_solid(scene: Any, name: str, shape: Shape) -> Any:
    """Add a shape below the node of its link.

    Parameters
    ----------
    scene : viser.SceneApi
    name : str
        Path of the new node.
    shape : Shape

    Returns
    -------
    viser.SceneNodeHandle

    Raises
    ------
    DataError
        If the file of a mesh cannot be read.
    """
    turn = torch.from_numpy(np.ascontiguousarray(shape.pose[:3, :3]))
    placed: dict[str, Any] = {
        "position": shape.pose[:3, 3],
        "wxyz": quaternions.from_matrix(turn).numpy(),
        "color": shape.color,
        "opacity": None if shape.opacity >= 1 else shape.opacity,
    }
    match shape.kind:
        case "box":
            return scene.add_box(name, dimensions=shape.size, **placed)
        case "sphere":
            return scene.add_icosphere(name, *shape.size, **placed)
        case "cylinder":
            radius, length = shape.size
            return scene.add_cylinder(name, radius, length, **placed)
    vertices, faces = _mesh(shape)
    return scene.add_mesh_simple(name, vertices, faces, **placed)


def unit_sphere() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (F, 3) of a ball of radius 1."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(ball.vertices), np.asarray(ball.faces)


def _mesh(shape: Shape) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    import trimesh

    try:
        mesh = trimesh.load_mesh(shape.file)
        return np.asarray(mesh.vertices) * shape.size, np.asarray(mesh.faces)
    except Exception as error:  # whatever a reader of one of many formats raises
        raise DataError(f"the mesh {shape.file} cannot be read: {error}") from error

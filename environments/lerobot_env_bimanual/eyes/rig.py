"""Cameras before a simulated scene whose bodies carry tags."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_env_bimanual.eyes.carriers import Carrier, add_carrier
from lerobot_env_bimanual.eyes.lens import Imperfections, Lens, usual_camera
from lerobot_env_bimanual.rendering import Renderer, offscreen
from lerobot_env_bimanual.robot_scene import RobotScene
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_vision.camera import Camera
from tpgmm_vision.cell import camera_content, pose_content
from tpgmm_vision.poses import Array, inverse, pose_vector, rigid

#: How LeRobot names the features of cameras.
IMAGES = "observation.images."
#: OpenCV's camera looks along z, y down; MuJoCo's along -z, y up.
_TURNED = rigid(np.diag((1.0, -1.0, -1.0)), np.zeros(3))


@dataclass(frozen=True, eq=False)
class View:
    """Where a camera is.

    Parameters
    ----------
    pose : ndarray of shape (4, 4)
        Of the camera in the world, or in the frame of ``link``.
    link : str, optional
        The body that carries it.
    """

    pose: Array
    link: str | None = None


def looking(eye: ArrayLike, at: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """Return the pose (4, 4) of a camera that looks from one point at another [m]."""
    eye = np.asarray(eye, dtype=float)
    z = np.asarray(at, dtype=float) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, np.asarray(up, dtype=float))
    x /= np.linalg.norm(x)
    return rigid(np.stack((x, np.cross(z, x), z), axis=1), eye)


class Rig:
    """Cameras before a scene, and tags on its bodies.

    They are in a copy of the scene's model, which is brought to where the scene is before it is
    drawn: what is simulated does not know of them.

    Parameters
    ----------
    scene : RobotScene
    views : mapping of str to View
        The cameras by their names.
    carriers : mapping of str to Carrier
        The tags, by the bodies that carry them; ``"world"`` is what stands still.
    objects : mapping of str to str, optional
        Bodies whose carriers are objects of the cell, and their names there; by default all
        but ``"world"``, under their own names.
    checks : mapping of str to str, optional
        The same of carriers that stand still, by which a camera that was moved is noticed;
        ``{"world": "base"}`` by default. What is neither is drawn alone: a tag in a hand.
    camera : Camera, optional
        Of all views; that of :func:`~lerobot_env_bimanual.eyes.lens.usual_camera` by default.
    imperfections : Imperfections, optional
        What spoils the pictures.

    Raises
    ------
    DataError
        If a body does not exist.
    DependencyError
        If nothing can be drawn on this machine.
    """

    def __init__(
        self,
        scene: RobotScene,
        views: Mapping[str, View],
        carriers: Mapping[str, Carrier],
        objects: Mapping[str, str] | None = None,
        checks: Mapping[str, str] | None = None,
        camera: Camera | None = None,
        imperfections: Imperfections | None = None,
    ) -> None:
        self.scene, self.views, self.carriers = scene, dict(views), dict(carriers)
        self._renderer: Renderer | None = None
        movable = {body: body for body in carriers if body != "world"}
        self.objects = movable if objects is None else objects
        self.checks = {"world": "base"} if checks is None else checks
        self.lens = Lens(camera or usual_camera())
        self.imperfections = imperfections or Imperfections()
        self._model = self._furnish(scene.spec.copy()).compile()
        self._data = mujoco.MjData(self._model)
        # bodies are the same; those of their geoms that are tags come last
        pairs = zip(self._model.body_geomadr, scene.model.body_geomnum, strict=True)
        self._geoms = np.concatenate([first + np.arange(n) for first, n in pairs])

    def _furnish(self, spec: mujoco.MjSpec) -> mujoco.MjSpec:
        """Add tags and cameras to the bodies that carry them."""
        there = [body.name for body in spec.bodies]
        mounts = {name: view.link or "world" for name, view in self.views.items()}
        if missing := [
            body for body in (*self.carriers, *mounts.values()) if body not in there
        ]:
            raise DataError(f"the scene has no bodies {missing}; it has {there}")
        for body, carrier in self.carriers.items():
            add_carrier(spec, body, carrier)
        for name, view in self.views.items():
            place, mount = pose_vector(view.pose @ _TURNED), spec.body(mounts[name])
            camera = mount.add_camera(name=f"eye {name}", pos=place[:3], quat=place[3:])
            camera.fovy = self.lens.fovy
        return spec

    def pictures(self, rng: np.random.Generator) -> dict[str, NDArray[np.uint8]]:
        """Pictures of the cameras now.

        Parameters
        ----------
        rng : Generator
            Of the noise.

        Returns
        -------
        dict of str to ndarray of shape (height, width, 3)
            RGB pictures by the names of the cameras.
        """
        self._follow()
        if self._renderer is None:
            if offscreen() is None:
                raise DependencyError(
                    "cameras cannot be drawn on this machine: install the system's EGL or "
                    "OSMesa (Debian: libegl1 and libgl1-mesa-dri, or libosmesa6), and leave "
                    "MUJOCO_GL unset"
                )
            self._renderer = Renderer(
                self._model, *self.lens.size, f"eye {next(iter(self.views))}"
            )
        drawn = {name: self._renderer(self._data, f"eye {name}") for name in self.views}
        return {name: self.imperfections(self.lens(one), rng) for name, one in drawn.items()}

    def _follow(self) -> None:
        """Be where the scene is."""
        seen, model, scene = self._model, self.scene.model, self.scene.data
        self._data.qpos[:] = scene.qpos
        seen.body_pos[:], seen.body_quat[:] = model.body_pos, model.body_quat
        seen.geom_pos[self._geoms], seen.geom_quat[self._geoms] = (
            model.geom_pos,
            model.geom_quat,
        )
        mujoco.mj_kinematics(seen, self._data)
        mujoco.mj_camlight(seen, self._data)

    def content(self) -> dict[str, Any]:
        """Return the true cell file of the scene, as :mod:`tpgmm_vision.cell` describes it."""
        cameras, objects, checks = (dict[str, dict[str, Any]]() for _ in range(3))
        for name, view in self.views.items():
            cameras[name] = camera_content(self.lens.camera, IMAGES + name)
            cameras[name] |= {"pose": pose_content(view.pose)}
            cameras[name] |= {} if view.link is None else {"link": view.link}
        for body, carrier in self.carriers.items():
            target = {"target": dict(carrier.entry)}
            if body in self.objects:
                pose = {"pose": pose_content(inverse(carrier.pose))}
                known = {"upright": True} if carrier.upright else {}
                objects[self.objects[body]] = target | pose | known
            elif body in self.checks:
                pose = {"pose": pose_content(self.pose(body) @ carrier.pose)}
                checks[self.checks[body]] = target | pose
        return {"cameras": cameras, "objects": objects, "checks": checks}

    def camera_pose(self, camera: str) -> Array:
        """Return a camera's pose in the world (4, 4)."""
        view = self.views[camera]
        return view.pose if view.link is None else self.pose(view.link) @ view.pose

    def pose(self, body: str) -> Array:
        """Return a body's pose in the world (4, 4)."""
        data = self.scene.data.body(body)
        return rigid(data.xmat.reshape(3, 3), data.xpos)

    def close(self) -> None:
        """Free what the graphics library holds."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

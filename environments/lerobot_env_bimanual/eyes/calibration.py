"""Let a robot move tags in its hand before a camera, to calibrate the camera and the joints."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_env_bimanual.eyes.recorder import row
from lerobot_env_bimanual.eyes.rig import Rig
from lerobot_env_bimanual.robot_scene import TIMESTEP
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_vision.detection.tags import TagDetector
from tpgmm_vision.poses import Array, inverse, transform

__all__ = ["calibration_episode", "chain_of", "varied_postures"]

Vector = NDArray[np.float64]
Reading = Callable[[Vector], Vector]
#: So many postures are drawn, from the middle share of the ranges of the joints.
DRAWN, RANGE = 10_000, 0.8
#: A tag may be seen if it is so far from the border of the picture [pixels], and turned from
#: the camera by at most this [deg].
BORDER, TURNED = 12.0, 55.0
#: Which distance between postures is as different as a turn by 1 rad [m].
APART = 0.2
#: How fast joints move at most on the way between postures [rad/s], how long a way takes at
#: least, and for how long the robot then stands still [s].
SPEED, LEAST, STILL = 1.0, 0.4, 0.4
TASK = "show the tags in the hand to the camera"


def chain_of(rig: Rig, link: str) -> NDArray[np.intp]:
    """The numbers of the joints that move a link, from its base on."""
    model = rig.scene.model
    body, chain = model.body(link).id, set[int]()
    while body:
        chain.add(int(body))
        body = model.body_parentid[body]
    return np.flatnonzero(np.isin(model.jnt_bodyid[_driven(rig)], list(chain)))


def _driven(rig: Rig) -> NDArray[np.intp]:
    """The joints that have motors, among all."""
    return np.asarray(rig.scene.model.actuator_trnid[:, 0], dtype=np.intp)


def varied_postures(
    rig: Rig, link: str, n: int, rng: np.random.Generator, camera: str | None = None
) -> Vector:
    """Postures in which a camera sees the tags that a link carries, as different as can be.

    Parameters
    ----------
    rig : Rig
        Its scene is as the robot begins: joints that do not move the link stay where they are.
    link : str
    n : int
        How many.
    rng : Generator
    camera : str, optional
        The first one by default.

    Returns
    -------
    ndarray of shape (n, n_joints)
        In an order in which the way from one to the next is short [rad].

    Raises
    ------
    DataError
        If fewer are found.
    """
    scene, before = rig.scene, rig.scene.data.qpos.copy()
    moved, camera = chain_of(rig, link), camera or next(iter(rig.views))
    low, high = scene.model.jnt_range[_driven(rig)[moved]].T
    joints, kept, seen = scene.joints, list[Vector](), list[Array]()
    for shares in (1 + RANGE * rng.uniform(-1, 1, (DRAWN, len(moved)))) / 2:
        joints[moved] = low + shares * (high - low)
        _place(rig, joints)
        pose = inverse(rig.camera_pose(camera)) @ rig.pose(link) @ rig.carriers[link].pose
        if _faces(rig, pose, link):
            kept.append(joints.copy())
            seen.append(pose)
    turns = Rotation.from_matrix([pose[:3, :3] for pose in [*seen, np.eye(4)]])
    places = np.array([pose[:3, 3] for pose in [*seen, np.eye(4)]])
    # one after the other that is most unlike the others, if its tags are found
    detector, chosen = TagDetector(rig.carriers[link].target.family), list[int]()
    gap = np.append(np.full(len(seen), np.inf), 0.0)
    while len(chosen) < n and gap.any():
        best = int(gap.argmax())
        _place(rig, kept[best])
        shown = [detector(rig.pictures(rng)[camera]).corners.keys() for _ in range(2)]
        gap[best] = 0.0
        if all(found & rig.carriers[link].target.corners.keys() for found in shown):
            chosen.append(best)
            apart = np.linalg.norm(places - places[best], axis=1) / APART
            gap = np.minimum(gap, np.hypot(apart, (turns[best].inv() * turns).magnitude()))
    scene.data.qpos[:] = before
    mujoco.mj_kinematics(scene.model, scene.data)
    if len(chosen) < n:
        raise DataError(
            f"of {DRAWN} postures {len(chosen)} show the tags of {link} to the camera "
            f"{camera!r}, {n} are asked for: is it before the robot, and not too far away?"
        )
    order, last = list[Vector](), scene.joints
    while chosen:
        nearest = min(chosen, key=lambda one: float(np.abs(kept[one] - last).max()))
        chosen.remove(nearest)
        order.append(last := kept[nearest])
    return np.stack(order)


def _place(rig: Rig, joints: Vector) -> None:
    """Put the joints somewhere."""
    model, data = rig.scene.model, rig.scene.data
    data.qpos[model.jnt_qposadr[_driven(rig)]] = joints
    mujoco.mj_kinematics(model, data)


def _faces(rig: Rig, pose: Array, link: str) -> bool:
    """Whether a tag is in the picture and faces the camera; something may be before it."""
    corners = np.stack([*rig.carriers[link].target.corners.values()])
    seen = transform(pose, corners.reshape(-1, 3)).reshape(corners.shape)
    middle, out = seen.mean(axis=1), np.cross(seen[:, 1] - seen[:, 0], seen[:, 0] - seen[:, 3])
    away = np.linalg.norm(out, axis=1) * np.linalg.norm(middle, axis=1)
    faces = -(out * middle).sum(axis=1) > away * np.cos(np.radians(TURNED))
    faces &= middle[:, 2] > 0
    if not faces.any():
        return False
    camera = rig.lens.camera
    pixels = camera.project(seen[faces]).reshape(-1, 4, 2)
    end = np.array((camera.width, camera.height)) - BORDER
    return bool(((pixels > BORDER) & (pixels < end)).all(axis=(1, 2)).any())


def calibration_episode(
    rig: Rig,
    postures: Vector,
    fps: int,
    rng: np.random.Generator,
    measured: Reading = np.asarray,
    commanded: Reading = np.asarray,
) -> Iterator[dict[str, Any]]:
    """Let a robot go through postures, and stand still in each.

    Parameters
    ----------
    rig : Rig
        Its scene is simulated.
    postures : ndarray of shape (n, n_joints)
        [rad]
    fps : int
        Rows per second.
    rng : Generator
        Of the noise of the pictures.
    measured, commanded : callable, optional
        What the robot reads where its joints are (n_joints,) [rad], and what it calls
        references: with offsets, noise, in another unit. As they are by default.

    Yields
    ------
    dict
        The rows of one episode, for ``add_frame`` of what
        :func:`~lerobot_env_bimanual.eyes.recorder.recording` opens.
    """
    scene, period = rig.scene, round(1 / (TIMESTEP * fps))
    reference = scene.joints
    for posture in postures:
        seconds = max(LEAST, float(np.abs(posture - reference).max()) / SPEED)
        rows = round((seconds + STILL) * fps)
        time = torch.arange(rows * period + 1, dtype=torch.float64) * TIMESTEP / seconds
        way = reference + minimum_jerk(time).numpy()[:, None] * (posture - reference)
        for first in range(0, rows * period, period):
            step = way[first : first + period + 1]
            state, action = measured(scene.joints), commanded(step[-1])
            yield row(TASK, state, action, rig.pictures(rng))
            scene.follow(step)
        reference = posture

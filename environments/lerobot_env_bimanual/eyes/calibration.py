"""Let a robot move tags in its hand before a camera, to calibrate the camera and the joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_env_bimanual.eyes.recorder import Recorder
from lerobot_env_bimanual.eyes.rig import Rig
from lerobot_env_bimanual.robot_scene import TIMESTEP
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_vision.poses import Array, inverse, transformed

__all__ = ["calibration_episode", "chain_of", "varied_postures"]

#: Postures are drawn from the middle share of the ranges of the joints, until so many times as
#: many as are wanted show the tags, or so many have been drawn.
RANGE, CANDIDATES, DRAWN = 0.8, 10, 30_000
#: A tag is shown if its edges are this long in the picture and this far from its border
#: [pixels], and it is turned from the camera by at most this [deg].
EDGE, BORDER, TURNED = 15.0, 12.0, 55.0
#: Which distance between postures is as different as a turn by 1 rad [m].
APART = 0.2
#: How fast joints move at most on the way between postures [rad/s], how long a way takes at
#: least, and for how long the robot then stands still [s].
SPEED, LEAST, STILL = 1.0, 0.4, 0.4
Reading = Callable[[NDArray[np.float64]], NDArray[np.float64]]
TASK = "show the tags in the hand to the camera"


def chain_of(rig: Rig, link: str) -> NDArray[np.intp]:
    """The numbers of the driven joints that move a link."""
    model = rig.scene.model
    body, bodies = model.body(link).id, set[int]()
    while body:
        bodies.add(int(body))
        body = model.body_parentid[body]
    driven = model.jnt_bodyid[model.actuator_trnid[:, 0]]
    return np.flatnonzero([int(one) in bodies for one in driven])


def varied_postures(
    rig: Rig, link: str, n: int, rng: np.random.Generator, camera: str | None = None
) -> NDArray[np.float64]:
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
        If so many are not found.
    """
    scene = rig.scene
    model, before = scene.model, scene.data.qpos.copy()
    moved, camera = chain_of(rig, link), camera or next(iter(rig.views))
    driven = model.actuator_trnid[:, 0]
    low, high = model.jnt_range[driven[moved]].T
    low, high = (low + high) / 2 + (high - low) * RANGE / 2 * np.array([[-1], [1]])
    start, kept, seen = scene.joints, list[NDArray[np.float64]](), list[Array]()
    for _ in range(DRAWN):
        joints = start.copy()
        joints[moved] = rng.uniform(low, high)
        scene.data.qpos[model.jnt_qposadr[driven]] = joints
        mujoco.mj_kinematics(model, scene.data)
        if _shown(rig, camera, link):
            kept.append(joints)
            seen.append(_in_camera(rig, camera, link))
            if len(kept) == CANDIDATES * n:
                break
    scene.data.qpos[:] = before
    mujoco.mj_kinematics(model, scene.data)
    if len(kept) < n:
        raise DataError(
            f"of {DRAWN} postures {len(kept)} show the tags of {link} to the camera "
            f"{camera!r}, {n} are asked for: is it before the robot, and not too far away?"
        )
    chosen = _different(seen, n)
    return _ordered(np.stack([kept[one] for one in chosen]), start)


def _in_camera(rig: Rig, camera: str, link: str) -> Array:
    """Where the tags of a link are, seen from a camera (4, 4)."""
    return inverse(rig.camera_pose(camera)) @ rig.pose(link) @ rig.carriers[link].pose


def _shown(rig: Rig, camera: str, link: str) -> bool:
    """Whether the camera sees one of the tags of a link well, and nothing is before it."""
    pose, lens = _in_camera(rig, camera, link), rig.lens.camera
    corners = np.stack([*rig.carriers[link].target.corners.values()])
    seen = transformed(pose, corners.reshape(-1, 3)).reshape(corners.shape)
    middle, outwards = (
        seen.mean(axis=1),
        np.cross(seen[:, 1] - seen[:, 0], seen[:, 0] - seen[:, 3]),
    )
    away = np.linalg.norm(outwards, axis=1) * np.linalg.norm(middle, axis=1)
    towards = -(outwards * middle).sum(axis=1) / away
    for tag in np.flatnonzero(
        (towards > np.cos(np.radians(TURNED))) & (seen[..., 2].min(axis=1) > 0)
    ):
        pixels = lens.project(seen[tag])
        size = np.array((lens.width, lens.height)) - 1
        inside = (pixels > BORDER).all() and (pixels < size - BORDER).all()
        edges = np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1)
        points = [middle[tag], *(0.1 * middle[tag] + 0.9 * seen[tag])]
        if inside and edges.min() > EDGE and all(rig.in_sight(camera, one) for one in points):
            return True
    return False


def _different(poses: Sequence[Array], n: int) -> list[int]:
    """Those ``n`` poses that are far from one another."""
    turns = Rotation.from_matrix(np.stack([pose[:3, :3] for pose in poses]))
    places = np.stack([pose[:3, 3] for pose in poses])
    chosen, gap = [0], np.full(len(poses), np.inf)
    while len(chosen) < n:
        last = chosen[-1]
        apart = np.linalg.norm(places - places[last], axis=1) / APART
        gap = np.minimum(gap, np.hypot(apart, (turns[last].inv() * turns).magnitude()))
        chosen.append(int(gap.argmax()))
    return chosen


def _ordered(postures: NDArray[np.float64], start: NDArray[np.float64]) -> NDArray[np.float64]:
    """From each to the nearest that is left."""
    left, order, last = list(range(len(postures))), list[int](), start
    while left:
        nearest = min(left, key=lambda one: np.abs(postures[one] - last).max())
        left.remove(nearest)
        order.append(nearest)
        last = postures[nearest]
    return postures[order]


def calibration_episode(
    recorder: Recorder,
    rig: Rig,
    postures: NDArray[np.float64],
    rng: np.random.Generator,
    measured: Reading = np.asarray,
    commanded: Reading = np.asarray,
    task: str = TASK,
) -> None:
    """Record an episode in which the robot goes through postures and stands still in each.

    Parameters
    ----------
    recorder : Recorder
        Of the cameras of the rig and the joints of its scene.
    rig : Rig
    postures : ndarray of shape (n, n_joints)
        [rad]
    rng : Generator
        Of the noise of the pictures.
    measured, commanded : callable, optional
        What the robot reads where its joints are (n_joints,) [rad], and what it calls
        references: with offsets, noise, in another unit. As they are by default.
    task : str, optional
        What the set calls it.
    """
    scene, period = rig.scene, round(1 / (TIMESTEP * recorder.fps))
    reference = scene.joints
    for posture in postures:
        seconds = max(LEAST, float(np.abs(posture - reference).max()) / SPEED)
        rows = round((seconds + STILL) * recorder.fps)
        time = np.arange(rows * period + 1) * TIMESTEP / seconds
        shares = minimum_jerk(torch.from_numpy(time)).numpy()
        way = reference + shares[:, None] * (posture - reference)
        for row in range(rows):
            step = way[row * period : (row + 1) * period + 1]
            state, action = measured(scene.joints), commanded(step[-1])
            recorder.add(state, action, rig.pictures(rng), task)
            scene.follow(step)
        reference = posture
    recorder.save()

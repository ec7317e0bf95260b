"""Let a robot move tags in its hand before a camera, to calibrate the camera and the joints."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_env_bimanual.eyes.recorder import row
from lerobot_env_bimanual.eyes.rig import Rig
from lerobot_env_bimanual.robot_scene import TIMESTEP, RobotScene
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_vision.detection.tags import TagDetector
from tpgmm_vision.poses import Array, inverse, transform

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


def chain_of(scene: RobotScene, link: str) -> NDArray[np.intp]:
    """Find the numbers of the joints that move a link, from its base on."""
    model = scene.model
    body, chain = model.body(link).id, set[int]()
    while body:
        chain.add(int(body))
        body = model.body_parentid[body]
    return np.flatnonzero(np.isin(model.jnt_bodyid[_driven(scene)], list(chain)))


def _driven(scene: RobotScene) -> NDArray[np.intp]:
    """Return the numbers of the joints that have motors, among all."""
    return np.asarray(scene.model.actuator_trnid[:, 0], dtype=np.intp)


def varied_postures(rig: Rig, link: str, n: int, rng: np.random.Generator) -> Vector:
    """Draw postures, as different as can be, in which the first camera sees a link's tags.

    Parameters
    ----------
    rig : Rig
        Its scene is as the robot begins: joints that do not move the link stay where they are.
    link : str
    n : int
        How many.
    rng : Generator

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
    camera = next(iter(rig.views))
    postures, poses = _draw_candidates(rig, link, camera, rng)
    chosen = _choose_unlike(rig, link, n, postures, poses, camera, rng)
    scene.data.qpos[:] = before
    mujoco.mj_kinematics(scene.model, scene.data)
    if len(chosen) < n:
        raise DataError(
            f"of {DRAWN} postures {len(chosen)} show the tags of {link} to the camera "
            f"{camera!r}, {n} are asked for: is it before the robot, and not too far away?"
        )
    return _order_by_nearness(chosen, scene.joints)


def _draw_candidates(
    rig: Rig, link: str, camera: str, rng: np.random.Generator
) -> tuple[list[Vector], list[Array]]:
    """Draw postures in which tags may be seen, and the poses of the tags before the camera."""
    scene, moved = rig.scene, chain_of(rig.scene, link)
    low, high = scene.model.jnt_range[_driven(scene)[moved]].T
    joints, kept, seen = scene.joints, list[Vector](), list[Array]()
    for shares in (1 + RANGE * rng.uniform(-1, 1, (DRAWN, len(moved)))) / 2:
        joints[moved] = low + shares * (high - low)
        _place(rig, joints)
        pose = inverse(rig.camera_pose(camera)) @ rig.pose(link) @ rig.carriers[link].pose
        if _faces(rig, pose, link):
            kept.append(joints.copy())
            seen.append(pose)
    return kept, seen


def _choose_unlike(
    rig: Rig,
    link: str,
    n: int,
    postures: list[Vector],
    poses: list[Array],
    camera: str,
    rng: np.random.Generator,
) -> list[Vector]:
    """Choose one after the other that is most unlike the others, if its tags are found."""
    turns = Rotation.from_matrix([pose[:3, :3] for pose in [*poses, np.eye(4)]])
    places = np.array([pose[:3, 3] for pose in [*poses, np.eye(4)]])
    target, chosen = rig.carriers[link].target, list[Vector]()
    detector = TagDetector(target.family)
    gap = np.append(np.full(len(poses), np.inf), 0.0)
    while len(chosen) < n and gap.any():
        best = int(gap.argmax())
        _place(rig, postures[best])
        shown = [detector(rig.pictures(rng)[camera]).corners.keys() for _ in range(2)]
        gap[best] = 0.0
        if all(found & target.corners.keys() for found in shown):
            chosen.append(postures[best])
            apart = np.linalg.norm(places - places[best], axis=1) / APART
            gap = np.minimum(gap, np.hypot(apart, (turns[best].inv() * turns).magnitude()))
    return chosen


def _order_by_nearness(postures: list[Vector], last: Vector) -> Vector:
    """Go to the nearest of the postures that are left, time after time."""
    order = list[Vector]()
    while postures:
        apart = [float(np.abs(posture - last).max()) for posture in postures]
        order.append(last := postures.pop(int(np.argmin(apart))))
    return np.stack(order)


def _place(rig: Rig, joints: Vector) -> None:
    """Put the joints somewhere."""
    model, data = rig.scene.model, rig.scene.data
    data.qpos[model.jnt_qposadr[_driven(rig.scene)]] = joints
    mujoco.mj_kinematics(model, data)


def _faces(rig: Rig, pose: Array, link: str) -> bool:
    """Check whether a tag is in the picture and faces the camera, hidden or not."""
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
    links: Iterable[str],
    n: int,
    fps: int,
    rng: np.random.Generator,
    measure: Reading,
    command: Reading,
) -> Iterator[dict[str, Any]]:
    """Let a robot go through postures in which links show their tags, and stand still in each.

    Parameters
    ----------
    rig : Rig
        Its scene is simulated.
    links : iterable of str
        No joint moves two of them.
    n : int
        How many postures.
    fps : int
        Rows per second.
    rng : Generator
        Of the postures and the noise of the pictures.
    measure, command : callable
        What the robot reads where its joints are (n_joints,) [rad], and what it calls
        references: with offsets, noise, in another unit.

    Yields
    ------
    dict
        The rows of one episode, for ``add_frame`` of what
        :func:`~lerobot_env_bimanual.eyes.recorder.recording` opens.
    """
    scene, period = rig.scene, round(1 / (TIMESTEP * fps))
    reference = scene.joints
    postures = np.tile(reference, (n, 1))
    for link in links:
        moved = chain_of(scene, link)
        postures[:, moved] = varied_postures(rig, link, n, rng)[:, moved]
    for posture in postures:
        seconds = max(LEAST, float(np.abs(posture - reference).max()) / SPEED)
        rows = round((seconds + STILL) * fps)
        time = torch.arange(rows * period + 1, dtype=torch.float64) * TIMESTEP / seconds
        way = reference + minimum_jerk(time).numpy()[:, None] * (posture - reference)
        for first in range(0, rows * period, period):
            step = way[first : first + period + 1]
            state, action = measure(scene.joints), command(step[-1])
            yield row(TASK, state, action, rig.pictures(rng))
            scene.follow(step)
        reference = posture

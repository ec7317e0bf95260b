"""Cells whose cameras, tags and offsets are known, and what their cameras see."""

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_datasets.robots import bi_so101_urdf, so101_urdf, upper_body_urdf
from tpgmm_torch import Robot
from tpgmm_vision.camera import Camera
from tpgmm_vision.cell import CellCamera
from tpgmm_vision.detection.tags import Detections
from tpgmm_vision.poses import Array, inverse, pose_matrix, rigid, transform
from tpgmm_vision.targets import Target, cube

CAMERA = Camera(640, 480, (554.0, 554.0), (322.5, 237.5), (0.08, -0.15, 0.0006, -0.0004, 0.0))
HAND, BI_HANDS = "gripper_frame_link", ("left_gripper_frame_link", "right_gripper_frame_link")
CUBE, OTHER, LARGE = (
    cube([first + i for i in range(5)], size)
    for first, size in ((10, 0.03), (20, 0.03), (10, 0.04))
)
#: Pixels of a module of a drawn tag, and drawn pixels of a picture's pixel.
MODULE, FINE = 16, 3
IN_HAND = rigid(np.radians([10, 20, 30]), (0.0, 0.0, -0.05))


def looking(eye: tuple[float, float, float], at: tuple[float, float, float]) -> Array:
    """Pose of a camera that looks at a point, upright."""
    z = np.subtract(at, eye)
    z /= np.linalg.norm(z)
    x = np.cross(z, (0, 0, 1))
    x /= np.linalg.norm(x)
    return rigid(np.stack((x, np.cross(z, x), z), 1), eye)


def robot_named(name: str) -> Robot:
    texts = {"so101": so101_urdf, "upper_body": upper_body_urdf, "bi_so101": bi_so101_urdf}
    links = {"so101": [HAND], "upper_body": ["r_hand"], "bi_so101": list(BI_HANDS)}
    return Robot.from_urdf(texts[name](), links[name])


def visible(camera: Camera, pose: Array, target: Target) -> dict[int, Array]:
    """Corners of tags that are turned to the camera, in its picture and large enough."""
    found = {}
    for number, points in target.corners.items():
        local = transform(pose, points)
        middle, normal = local.mean(0), np.cross(local[1] - local[0], local[3] - local[0])
        cosine = normal @ middle / np.linalg.norm(normal) / np.linalg.norm(middle)
        if (local[:, 2] < 0.12).any() or cosine < np.cos(np.radians(65)):
            continue
        if (np.abs(local[:, :2]) > 0.65 * local[:, 2:]).any():  # where the lens is no model
            continue
        pixels = camera.project(local)
        inside = ((pixels > 12) & (pixels < (camera.width - 12, camera.height - 12))).all()
        if inside and np.linalg.norm(pixels[0] - pixels[2]) > 20:
            found[number] = pixels
    return found


@dataclass
class SimulatedCell:
    """A robot, cameras by name (pose and link) and targets by name (target, pose, link)."""

    robot: Robot
    cameras: dict[str, tuple[Array, str | None]]
    targets: dict[str, tuple[Target, Array, str | None]]
    offsets: Array
    joint_noise: float = np.radians(0.2)
    backlash: float = np.radians(0.4)
    gravity: bool = True
    pixels: float = 0.15
    camera: Camera = CAMERA
    bases: tuple[str, ...] = ()
    base: Array = field(default_factory=lambda: np.eye(4))
    middle: Array = field(default_factory=lambda: np.zeros(0))
    reach: Array = field(default_factory=lambda: np.zeros(0))

    def links(self, joints: Array, link: str | None) -> Array:
        if link is None:
            return np.tile(np.eye(4), (len(joints), 1, 1))
        pose = self.robot.state(torch.as_tensor(joints)).pose(link)
        poses = pose_matrix(torch.cat((pose.position, pose.orientation), -1).numpy())
        return self.base @ poses if link.startswith(self.bases) else poses

    def measured(self, joints: Array, rng: np.random.Generator) -> Array:
        """What sensors say where the joints are: noise, and play in the gears.

        A joint hangs to the side to which weight pulls it; others, and all where ``gravity`` is
        False, are on any side.
        """
        side = rng.choice([-1.0, 1.0], joints.shape)
        if self.gravity:
            rise = (
                self.robot.state(torch.as_tensor(joints)).jacobians[..., 2, :].sum(-2).numpy()
            )
            side = np.where(np.abs(rise) > 0.01, np.sign(rise), side)
        side *= self.backlash / 2
        return joints - self.offsets + side + rng.normal(0, self.joint_noise, joints.shape)

    def corners(
        self, joints: Array, rng: np.random.Generator
    ) -> dict[str, list[dict[int, Array]]]:
        """By camera, the corners of tags at joints."""
        found: dict[str, list[dict[int, Array]]] = {}
        held = [(t, self.links(joints, link) @ pose) for t, pose, link in self.targets.values()]
        for name, (pose, link) in self.cameras.items():
            back = inverse(self.links(joints, link) @ pose)
            found[name] = [
                {
                    number: pixels + rng.normal(0, self.pixels, (4, 2))
                    for target, poses in held
                    for number, pixels in visible(
                        self.camera, back[k] @ poses[k], target
                    ).items()
                }
                for k in range(len(joints))
            ]
        return found

    def postures(self, n: int, rng: np.random.Generator, least: int = 1) -> Array:
        """Joints at which each camera sees a tag, and hands are above the table."""
        found: list[Array] = []
        while len(found) < n:
            joints = self.middle + rng.uniform(
                -self.reach, self.reach, (64, self.robot.n_joints)
            )
            seen = self.corners(joints, rng)
            heights = [self.links(joints, one)[:, 2, 3] for one in self.robot.links]
            high = (np.array(heights) > 0.03).all(0)
            found += [
                joints[k]
                for k in range(64)
                if high[k] and all(len(one[k]) >= least for one in seen.values())
            ]
        return np.array(found[:n])

    def recorded(
        self, n: int, rng: np.random.Generator
    ) -> tuple[Array, dict[str, list[Detections]]]:
        joints = self.postures(n, rng)
        seen = {k: [Detections(c) for c in v] for k, v in self.corners(joints, rng).items()}
        return self.measured(joints, rng), seen

    def described(self) -> dict[str, CellCamera]:
        return {
            name: CellCamera(self.camera, f"observation.images.{name}", None, link)
            for name, (_, link) in self.cameras.items()
        }


def so101_cell(offset: float, rng: np.random.Generator, **settings: Any) -> SimulatedCell:
    """An SO-101 with a cube in its hand before one camera; offsets of this deviation [deg]."""
    robot = robot_named("so101")
    offsets = np.radians(rng.normal(0, offset, 6)) * [1, 1, 1, 1, 1, 0]
    lower, upper = robot.lower.numpy(), robot.upper.numpy()
    return SimulatedCell(
        robot, {"front": (looking((0.55, 0.35, 0.40), (0.2, 0.0, 0.12)), None)},
        {"cube": (CUBE, IN_HAND, HAND)}, offsets,
        middle=0.35 * (lower + upper), reach=0.35 * (upper - lower), **settings,
    )  # fmt: skip


def wrist_cell(offset: float, rng: np.random.Generator, **settings: Any) -> SimulatedCell:
    """An SO-101 whose camera on the gripper sees a cube that stands still on the table."""
    cell = so101_cell(offset, rng, **settings)
    cell.cameras = {"wrist": (rigid((0.0, np.radians(25), 0.0), (-0.07, 0.0, -0.10)), HAND)}
    cell.targets = {"base": (CUBE, rigid((0, 0, 0.4), (0.30, 0.03, 0.02)), None)}
    return cell


def two_arm_cell(offset: float, rng: np.random.Generator, **settings: Any) -> SimulatedCell:
    """Two SO-101, a cube in each hand, one camera; the right base is 30 mm and 3 deg off."""
    robot = robot_named("bi_so101")
    lower, upper = robot.lower.numpy(), robot.upper.numpy()
    offsets = np.radians(rng.normal(0, offset, 12)) * ([1, 1, 1, 1, 1, 0] * 2)
    return SimulatedCell(
        robot, {"front": (looking((0.85, 0.1, 0.45), (0.15, 0.0, 0.12)), None)},
        {"cube": (CUBE, IN_HAND, BI_HANDS[0]), "other": (OTHER, IN_HAND, BI_HANDS[1])},
        offsets, bases=("right_",), base=rigid((0, 0, np.radians(3)), (0.02, -0.02, 0.01)),
        middle=0.35 * (lower + upper), reach=0.35 * (upper - lower), **settings,
    )  # fmt: skip


def drawn(
    camera: Camera, tags: dict[int, Array], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """A picture of tags whose corners are given, with noise."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    size = camera.width * FINE, camera.height * FINE
    picture = np.full(size[::-1], 150, np.uint8)
    edges = np.array([[1, 1], [9, 1], [9, 9], [1, 9]]) * MODULE - 0.5
    for number, corners in tags.items():
        inside = cv2.aruco.generateImageMarker(dictionary, number, 8 * MODULE)
        texture = np.pad(inside, MODULE, constant_values=255)
        shape = cv2.getPerspectiveTransform(
            edges.astype(np.float32), ((corners + 0.5) * FINE - 0.5).astype(np.float32)
        )
        cv2.warpPerspective(
            texture, shape, size, picture, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT
        )
    small = cv2.resize(picture, None, fx=1 / FINE, fy=1 / FINE, interpolation=cv2.INTER_AREA)
    small = small + rng.normal(scale=2.0, size=small.shape)
    return np.repeat(small.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def record(root: Path, cell: SimulatedCell, postures: Array, rng: np.random.Generator) -> Path:
    """A LeRobot data set of a robot that goes from posture to posture and stops at each."""
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = [f"{name}.pos" for name in cell.robot.joint_names]
    joints = {"dtype": "float32", "shape": (len(names),), "names": names}
    shape = cell.camera.height, cell.camera.width, 3
    video = {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}
    keys = {name: f"observation.images.{name}" for name in cell.cameras}
    features = {
        "observation.state": joints,
        "action": joints,
        **dict.fromkeys(keys.values(), video),
    }
    made = LeRobotDataset.create(
        "test/cell", 10, features, root=root, robot_type="so101_follower", use_videos=True,
        rgb_encoder=RGBEncoderConfig(vcodec="h264"),
    )  # fmt: skip
    path = [postures[:1]]
    for one, other in pairwise(postures):  # half way is quick, then it stands still
        path += [(one + other)[None] / 2, other[None], other[None], other[None]]
    true = np.concatenate(path)
    measured = np.repeat(cell.measured(postures, rng), 4, axis=0)[3:]
    measured[1::4] = true[1::4]
    seen = cell.corners(true, rng)
    for k, row in enumerate(np.degrees(measured).astype(np.float32)):
        if k == 0 or not np.array_equal(true[k], true[k - 1]):
            pictures = {
                keys[name]: drawn(cell.camera, found[k], rng) for name, found in seen.items()
            }
        made.add_frame({"observation.state": row, "action": row, "task": "wave", **pictures})
    made.save_episode()
    made.finalize()
    return root

"""An SO-101 that takes a cup with tags before a camera: its recordings, drawn ray by ray."""

import json
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch

from tpgmm_datasets.robots import so101_urdf
from tpgmm_evaluation.policies.inverse_kinematics import reach
from tpgmm_torch import Frame, Robot
from tpgmm_vision.camera import Camera
from tpgmm_vision.cell import camera_content, pose_content
from tpgmm_vision.poses import Array, inverse, pose_matrix, rigid, transform
from tpgmm_vision.targets import FAMILIES, Board, Target, cube, modules_of, tag

FPS = 15
KEY = "observation.images.front"
LINK = "gripper_frame_link"
CAMERA = Camera(640, 480, (554.0, 554.0), (322.5, 237.5), (0.08, -0.15, 0.0006, -0.0004, 0.0))
CUP, IN_HAND, BASE = cube(range(10, 15), 0.04), cube(range(20, 25), 0.04), tag(0, 0.06)
#: The cup below its cube, the cube in the hand, the tag at the base.
CUP_IN_CUBE = rigid(np.zeros(3), (0.0, 0.0, -0.06))
CUBE_IN_HAND = rigid((0.3, 0.2, 0.1), (0.0, 0.0, 0.04))
BASE_TAG = rigid((0.0, 0.0, 1.5), (0.1, 0.2, 0.0))
HOME = np.array([0.0, -0.6, 0.6, 0.6, 0.0, 1.2])
SAMPLES = 2


def looking(eye: tuple[float, float, float], at: tuple[float, float, float]) -> Array:
    """Pose of a camera that looks at a point, upright."""
    z = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
    x = np.cross(z, (0, 0, 1)) / np.linalg.norm(np.cross(z, (0, 0, 1)))
    return rigid(np.stack((x, np.cross(z, x), z), 1), eye)


VIEW = looking((0.75, 0.3, 0.5), (0.2, 0.0, 0.1))


def picture(things: list[tuple[Array, Target]], rng: np.random.Generator) -> np.ndarray:
    """What the camera sees of targets at poses (4, 4) in the base frame, RGB with noise."""
    grey = np.full((CAMERA.height, CAMERA.width), 120.0)
    for pose, target in sorted(things, key=lambda one: -(inverse(VIEW) @ one[0])[2, 3]):
        for number, corners in target.corners.items():
            _draw(grey, transform(inverse(VIEW) @ pose, corners), target.family, number)
    grey = cv2.GaussianBlur(grey, (0, 0), 0.6) + 2 * rng.standard_normal(grey.shape)
    return np.repeat(grey.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def _draw(grey: np.ndarray, corners: Array, family: str, number: int) -> None:
    """Draw a tag by what the ray of each sample of a pixel meets."""
    middle, modules = corners.mean(0), modules_of(family)
    x, y = corners[1] - corners[0], corners[0] - corners[3]
    size, normal = float(np.linalg.norm(x)), np.cross(x, y)
    if normal @ middle > 0 or middle[2] < 0.1:
        return
    pixels = CAMERA.project(middle + (1 + 2 / modules) * (corners - middle))
    low = np.maximum(np.floor(pixels.min(0)).astype(int), 0)
    high = np.minimum(np.ceil(pixels.max(0)).astype(int) + 1, grey.shape[::-1])
    if (high <= low).any():
        return
    steps = [
        low[k] + (np.arange(n * SAMPLES) + 0.5) / SAMPLES - 0.5
        for k, n in enumerate(high - low)
    ]
    rays = CAMERA.rays(np.stack(np.meshgrid(*steps), -1).reshape(-1, 2))
    rays = np.c_[rays, np.ones(len(rays))]
    where = rays * ((normal @ middle) / (rays @ normal))[:, None] - middle
    column = np.floor((where @ x / size**2 + 0.5) * modules + 1).astype(int)
    row = np.floor((0.5 - where @ y / size**2) * modules + 1).astype(int)
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    black = cv2.aruco.generateImageMarker(dictionary, number, modules) == 0
    shown = np.where(np.pad(black, 1), 30.0, 220.0)
    hit = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < modules + 2)
    values = np.where(hit, shown[row * hit, column * hit], np.nan)
    width, height = high - low
    values = values.reshape(height, SAMPLES, width, SAMPLES).swapaxes(1, 2)
    values = values.reshape(height, width, -1)
    part = grey[low[1] : high[1], low[0] : high[0]]
    part[:] = np.where(np.isnan(values), part[..., None], values).mean(-1)


def record(folder: Path, episodes: int = 5, postures: int = 14, seed: int = 0) -> None:
    """Write ``recordings/calibration`` and ``recordings/cups`` as lerobot-record does.

    Joints are in LeRobot's units. Beside them, pictures of a board in ``board`` and the true
    cell, ``true_cell.json``.
    """
    robot, rng = Robot.from_urdf(so101_urdf(), links=[LINK]), np.random.default_rng(seed)
    _write(folder / "recordings" / "calibration", robot, [_shown(robot, postures, rng)], rng)
    taken = [_taken(robot, rng) for _ in range(episodes)]
    _write(folder / "recordings" / "cups", robot, taken, rng)
    _board(folder / "board", rng)
    content = {
        "cameras": {"front": camera_content(CAMERA, KEY) | {"pose": pose_content(VIEW)}},
        "objects": {
            "cup": {
                "target": {"cube": list(CUP.corners), "size": _edge(CUP)},
                "pose": pose_content(CUP_IN_CUBE),
                "upright": True,
            }
        },
        "checks": {
            "base": {"target": {"tag": 0, "size": _edge(BASE)}, "pose": pose_content(BASE_TAG)}
        },
    }
    (folder / "true_cell.json").write_text(json.dumps(content), encoding="utf-8")


Episode = tuple[np.ndarray, list[list[tuple[Array, Target]]]]


def _hands(robot: Robot, joints: np.ndarray) -> list[Array]:
    """Poses of the hand."""
    state = robot.state(torch.from_numpy(joints))
    values = torch.cat((state.position(LINK), state.orientation(LINK)), -1).numpy()
    return list(pose_matrix(values / np.r_[1, 1, 1, [np.linalg.norm(values[0, 3:])] * 4]))


def _shown(robot: Robot, n: int, rng: np.random.Generator) -> Episode:
    """The hand shows a cube in postures in which it stands still, and moves between them."""
    low, high = robot.lower.numpy(), robot.upper.numpy()
    found = [HOME]
    while len(found) <= n:
        joints = rng.uniform((low + 0.1).clip(HOME - 1.3), (high - 0.1).clip(None, HOME + 1.3))
        joints[-1] = 0.1
        [hand] = _hands(robot, joints[None])
        seen = inverse(VIEW) @ hand @ CUBE_IN_HAND
        pixels = CAMERA.project(seen[None, :3, 3])[0]
        inside = (pixels > 60).all() and (
            pixels < (CAMERA.width - 60, CAMERA.height - 60)
        ).all()
        if hand[2, 3] > 0.05 and 0.3 < seen[2, 3] < 0.8 and inside:
            found.append(joints)
    rows = [found[1]]
    for before, after in pairwise(found[1:]):
        rows += [*np.linspace(before, after, FPS // 2), *[after] * (FPS // 2)]
    joints = np.stack([found[1]] * FPS + rows)
    things = [
        [(hand @ CUBE_IN_HAND, IN_HAND), (BASE_TAG, BASE)] for hand in _hands(robot, joints)
    ]
    return joints, things


def _taken(robot: Robot, rng: np.random.Generator) -> Episode:
    """The hand goes to the cup, closes, and lifts it."""
    place = np.array([rng.uniform(0.2, 0.28), rng.uniform(-0.08, 0.08), 0.04])
    cup = rigid((0.0, 0.0, rng.uniform(-0.3, 0.3)), place)
    home, at = HOME + 0.03 * rng.standard_normal(6), HOME
    ways = []
    for aside in ((-0.06, 0.0, 0.02), (0.0, 0.0, 0.02), (0.0, 0.0, 0.12)):
        goal = Frame(transform(cup, [aside])[0])
        at = reach(robot, {LINK: goal}, at, orientations=False).numpy()
        ways.append(at.copy())
    closed = [ways[1].copy(), ways[2].copy()]
    for one in closed:
        one[-1] = 0.1
    time = np.arange(0, 4.3, 1 / FPS)
    joints, begin, before = np.tile(home, (len(time), 1)), 0.0, home
    for end, goal in zip((1.5, 2.5, 3.0, 4.0), (ways[0], ways[1], *closed), strict=True):
        share = ((time - begin) / (end - begin)).clip(0, 1)[:, None]
        joints += (10 * share**3 - 15 * share**4 + 6 * share**5) * (goal - before)
        begin, before = end, goal
    hands, grasp = _hands(robot, joints), round(3.0 * FPS)
    held = inverse(hands[grasp]) @ cup
    poses = [cup if row < grasp else hand @ held for row, hand in enumerate(hands)]
    things = [[(pose @ inverse(CUP_IN_CUBE), CUP), (BASE_TAG, BASE)] for pose in poses]
    return joints, things


def _write(root: Path, robot: Robot, episodes: list[Episode], rng: np.random.Generator) -> None:
    """Write a set with videos with LeRobot."""
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = [f"{name}.pos" for name in robot.joint_names]
    joint = {"dtype": "float32", "shape": (len(names),), "names": names}
    shape = (CAMERA.height, CAMERA.width, 3)
    camera = {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}
    features = {"observation.state": joint, "action": joint, KEY: camera}
    made = LeRobotDataset.create(
        f"local/{root.name}", FPS, features, root=root, robot_type="so_follower",
        streaming_encoding=True, encoder_queue_maxsize=0,
        rgb_encoder=RGBEncoderConfig(vcodec="h264"),  # AV1 takes several times as long
    )  # fmt: skip
    low, high = robot.lower.numpy()[-1], robot.upper.numpy()[-1]
    for joints, things in episodes:
        stored = np.degrees(joints)
        stored[:, -1] = 100 * (joints[:, -1] - low) / (high - low)
        for row, action, seen in zip(stored, [*stored[1:], stored[-1]], things, strict=True):
            values = {"observation.state": row, "action": action}
            values = {key: one.astype(np.float32) for key, one in values.items()}
            made.add_frame({**values, KEY: picture(seen, rng), "task": "take the cup"})
        made.save_episode()
    made.finalize()


def _board(folder: Path, rng: np.random.Generator, n: int = 16) -> None:
    """Pictures of the usual board, by a homography that leaves the lens out of each square."""
    folder.mkdir()
    board = Board()
    size = np.array([board.columns, board.rows]) * board.square
    drawn = board.drawn.generateImage(tuple((size * 5000).astype(int))).astype(np.float32)
    steps = [
        (np.arange(n * SAMPLES) + 0.5) / SAMPLES - 0.5 for n in (CAMERA.width, CAMERA.height)
    ]
    rays = CAMERA.rays(np.stack(np.meshgrid(*steps), -1).reshape(-1, 2))
    rays = np.c_[rays, np.ones(len(rays))].reshape(len(steps[1]), len(steps[0]), 3)
    drawn = cv2.GaussianBlur(drawn, (0, 0), 2)
    for number in range(n):
        lean, side = rng.uniform(0.2, 0.75), rng.uniform(0, 2 * np.pi)
        turn = rigid((lean * np.cos(side), lean * np.sin(side), 0.0), np.zeros(3))
        turn = turn @ rigid((0, 0, rng.uniform(-0.4, 0.4)), np.zeros(3))
        z = rng.uniform(0.35, 0.55)
        middle = np.array([rng.uniform(-0.25, 0.25) * z, rng.uniform(-0.18, 0.18) * z, z])
        normal = turn[:3, 2]
        local = (rays * ((normal @ middle) / (rays @ normal))[..., None] - middle) @ turn[
            :3, :2
        ]
        where = ((local + size / 2) * 5000 - 0.5).astype(np.float32)
        seen = cv2.remap(drawn, where, None, cv2.INTER_LINEAR, borderValue=190)
        small = cv2.resize(seen, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
        small = small + 2 * rng.standard_normal(small.shape)
        cv2.imwrite(str(folder / f"{number:02}.png"), small.clip(0, 255).astype(np.uint8))


def _edge(target) -> float:
    """Edge of a target's tags [m]."""
    first, second, *_ = next(iter(target.corners.values()))
    return float(np.linalg.norm(second - first))

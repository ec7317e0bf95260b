"""LeRobot data sets with pictures of a printed tag, drawn by its homography and encoded."""

import cv2
import numpy as np

from tpgmm_vision.camera import Camera
from tpgmm_vision.poses import inverse, pose_vector, rigid, transform
from tpgmm_vision.targets import tag

FPS = 25
KEY = "observation.images.front"
CAMERA = Camera(320, 240, (277.0, 277.0), (159.5, 119.5))
#: Looks straight down from 0.5 m above the base.
BASE_FROM_CAMERA = rigid(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.5])
SIZE, NUMBER = 0.06, 3
#: Pixels of a module of the texture, and drawn pixels of a picture's pixel.
MODULE, FINE = 16, 4
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
OBJECT = {"target": {"tag": NUMBER, "size": SIZE}}
NAMES = ["hand.x", "hand.y", "hand.z", "hand.qw", "hand.qx", "hand.qy", "hand.qz"]


def cell_content(**changed):
    """A cell with this camera and the tag as object ``cup``."""
    pose = pose_vector(BASE_FROM_CAMERA).tolist()
    front = {
        "key": KEY, "size": [CAMERA.width, CAMERA.height],
        "focal_length": list(CAMERA.focal_length),
        "principal_point": list(CAMERA.principal_point), "pose": pose,
    }  # fmt: skip
    return {"cameras": {"front": front}, "objects": {"cup": OBJECT}} | changed


def picture(tags, rng=None):
    """What the camera sees of tags: ``{number: base_from_tag}``; grey, with noise."""
    size = CAMERA.width * FINE, CAMERA.height * FINE
    drawn = np.full(size[::-1], 150, np.uint8)
    side = 10 * MODULE  # with a module of white all round
    edges = np.array([[1, 1], [9, 1], [9, 9], [1, 9]]) * MODULE - 0.5
    for number, base_from_tag in tags.items():
        texture = np.full((side, side), 255, np.uint8)
        inside = cv2.aruco.generateImageMarker(DICTIONARY, number, 8 * MODULE)
        texture[MODULE:-MODULE, MODULE:-MODULE] = inside
        corners = tag(number, SIZE).corners[number]
        seen = CAMERA.project(
            transform(inverse(BASE_FROM_CAMERA), transform(base_from_tag, corners))
        )
        shape = cv2.getPerspectiveTransform(
            edges.astype(np.float32), ((seen + 0.5) * FINE - 0.5).astype(np.float32)
        )
        cv2.warpPerspective(
            texture, shape, size, drawn, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT
        )
    small = cv2.resize(drawn, None, fx=1 / FINE, fy=1 / FINE, interpolation=cv2.INTER_AREA)
    noise = 0 if rng is None else rng.normal(scale=2.0, size=small.shape)
    grey = np.clip(small + noise, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def record(root, episodes, *, codec="libsvtav1", images=False, seed=0):
    """Write a data set with LeRobot: of each episode its pictures, and poses of a hand.

    Each episode is ``(tags of each row, base_from_hand of each row)``.
    """
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    rng, shape = np.random.default_rng(seed), (CAMERA.height, CAMERA.width, 3)
    joints = {"dtype": "float32", "shape": (7,), "names": NAMES}
    camera = {
        "dtype": "image" if images else "video",
        "shape": shape,
        "names": ["height", "width", "channels"],
    }
    made = LeRobotDataset.create(
        "test/tags", FPS, {"observation.state": joints, "action": joints, KEY: camera},
        root=root, robot_type="hand", use_videos=not images,
        rgb_encoder=RGBEncoderConfig(vcodec=codec),
    )  # fmt: skip
    for tags, hands in episodes:
        for shown, hand in zip(tags, hands, strict=True):
            state = pose_vector(hand).astype(np.float32)
            row = {"observation.state": state, "action": state, "task": "carry"}
            made.add_frame({**row, KEY: picture(shown, rng)})
        made.save_episode()
    made.finalize()
    return root


def carried(rows, covered=(), shift=0.0):
    """An episode in which a hand moves the tag: what is drawn, and poses of hand and tag.

    In ``covered`` stretches, ``(first, last)`` rows, nothing is drawn. All is moved by
    ``shift`` along y [m].
    """
    time = np.arange(rows) / FPS
    shares = [
        np.clip((time - begin) / length, 0, 1)[:, None]
        for begin, length in ((0, 0.6), (0.8, 0.8), (1.8, 0.5))
    ]
    come, go, leave = (share**2 * (3 - 2 * share) for share in shares)
    way = np.array([[-0.15, -0.1, 0.2], [-0.05, 0, 0.02], [0.05, 0.05, 0.02], [0, 0.1, 0.2]])
    place = (
        way[0] + come * (way[1] - way[0]) + go * (way[2] - way[1]) + leave * (way[3] - way[2])
    )
    place += np.stack(
        (0 * time, shift + 0 * time, 0.05 * np.sin(np.pi * go[:, 0]) ** 2), axis=1
    )
    hand = [rigid([0, 0, 0.6 * turn], p) for turn, p in zip(go[:, 0], place, strict=True)]
    first, last = int(0.8 * FPS), int(1.7 * FPS)
    grasp = inverse(hand[first]) @ rigid([0, 0.1, 0.4], way[1] + [0, shift, 0.02])
    true = [hand[min(max(row, first), last)] @ grasp for row in range(rows)]
    hidden = {row for a, b in covered for row in range(a, b + 1)}
    drawn = [{} if row in hidden else {NUMBER: pose} for row, pose in enumerate(true)]
    return drawn, hand, np.array(true)

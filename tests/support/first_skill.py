"""A newcomer's recordings: two SO-101 arms take a cup, written as lerobot-record does."""

from pathlib import Path

import numpy as np
import pandas as pd
import torch

from tests.support.lerobot_sets import DATA, change_info, change_table
from tpgmm_datasets import save_lerobot
from tpgmm_datasets.robots import so101_urdf
from tpgmm_evaluation.policies.inverse_kinematics import reach
from tpgmm_torch import Demonstration, Frame, Robot, quaternions

__all__ = ["FPS", "GRASP", "bimanual", "record"]

FPS = 30
#: Where each hand takes the cup, seen from it [m].
GRASP = {
    "left_gripper_frame_link": [0.0, 0.03, 0.03],
    "right_gripper_frame_link": [0.0, -0.03, 0.03],
}
HOME = [0.0, -0.6, 0.6, 0.6, 0.0, 1.2]
#: Ends of the phases [s]: beside the cup, at it, closed, lifted.
BESIDE, AT, CLOSED, LIFTED = 1.5, 2.5, 3.0, 4.0


def bimanual() -> Robot:
    """Two arms, 40 cm apart."""
    arm = Robot.from_urdf(so101_urdf(), links=["gripper_frame_link"])
    places = {"left": Frame([0.0, 0.2, 0.0]), "right": Frame([0.0, -0.2, 0.0])}
    return Robot.combine(places, left=arm, right=arm)


def record(folder: Path, episodes: int = 8, seed: int = 0) -> tuple[Path, Path, list[Frame]]:
    """Write ``recordings/cups`` and ``poses.csv`` into a folder; and the poses of the cup.

    Names are those of LeRobot's ``bi_so_follower``, arms in degrees, grippers from 0 (closed)
    to 100; nothing says so, and no column has the cup.
    """
    robot, rng = bimanual(), np.random.default_rng(seed)
    cups = [
        Frame(
            [rng.uniform(0.2, 0.26), rng.uniform(-0.04, 0.04), 0.03],
            quaternions.exp(torch.tensor([0.0, 0.0, rng.uniform(-0.3, 0.3)]).double()),
        )
        for _ in range(episodes)
    ]
    shown = [_take(robot, cup, rng) for cup in cups]
    root = folder / "recordings" / "cups"
    save_lerobot(shown, root, fps=FPS, task="take the cup", robot_type="bi_so_follower")

    def undeclared(info):
        for name in ("observation.state", "action"):
            info["features"][name].pop("info")

    change_info(root, undeclared)
    change_table(root, DATA, lambda table: table)
    table = pd.DataFrame(
        {
            "episode": range(episodes),
            **{axis: [float(cup.position[i]) for cup in cups] for i, axis in enumerate("xyz")},
            "yaw": [2 * float(torch.atan2(*cup.orientation[[3, 0]])) for cup in cups],
        }
    )
    table.to_csv(folder / "poses.csv", index=False)
    return root, folder / "poses.csv", cups


def _take(robot, cup, rng) -> Demonstration:
    """One recording, in LeRobot's units."""
    home = np.array(HOME * 2) + 0.03 * rng.standard_normal(12)
    grippers = [robot.joint_names.index(f"{side}_gripper") for side in ("left", "right")]
    home[grippers] = HOME[-1]
    at = _reached(robot, cup, home, 0.0, 0.0)
    beside, lifted = (_reached(robot, cup, at, *away) for away in ((0.04, 0.0), (0.0, 0.05)))
    closed = [joints.copy() for joints in (at, lifted)]
    for joints in closed:
        joints[grippers] = 0.1
    time = np.arange(0, LIFTED + 0.3, 1 / FPS)
    joints, begin, before = np.tile(home, (len(time), 1)), 0.0, home
    for end, goal in zip((BESIDE, AT, CLOSED, LIFTED), (beside, at, *closed), strict=True):
        share = ((time - begin) / (end - begin)).clip(0, 1)[:, None]
        joints += (10 * share**3 - 15 * share**4 + 6 * share**5) * (goal - before)
        begin, before = end, goal
    lower, upper = robot.lower.numpy()[grippers], robot.upper.numpy()[grippers]
    stored = np.rad2deg(joints)
    stored[:, grippers] = 100 * (joints[:, grippers] - lower) / (upper - lower)
    names = [f"{name}.pos" for name in robot.joint_names]
    return Demonstration(time, stored, joint_names=names)


def _reached(robot, cup, start, aside, above):
    goals = {
        link: Frame(
            cup.transform(torch.tensor([x, y + np.sign(y) * aside, z + above]).double())
        )
        for link, (x, y, z) in GRASP.items()
    }
    return reach(robot, goals, start, orientations=False).numpy()

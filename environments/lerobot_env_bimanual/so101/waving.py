"""Two SO-101 arms show tags in their grippers to the cameras, to calibrate a cell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lerobot_env_bimanual.eyes.calibration import calibration_episode, varied_postures
from lerobot_env_bimanual.eyes.carriers import cube_at
from lerobot_env_bimanual.eyes.recorder import recording_of, rig_to_record
from lerobot_env_bimanual.so101.env import CHECKS, BiSo101Env
from lerobot_env_bimanual.so101.robot import SIDES, hand_of
from lerobot_env_bimanual.so101.scene import CUBE, LEFT, TAG

#: The first number of the cube of tags in each gripper.
IN_HAND = {"left": 30, "right": 40}
#: The joints of each arm.
PARTS = {"left": slice(0, 6), "right": slice(6, 12)}
#: Where cup and saucer are meanwhile [m].
AWAY = {"cup": (0.5, 0.45, 0.0), "saucer": (0.5, -0.45, 0.03)}


def record_waving(
    out: str | Path,
    *,
    n: int = 30,
    seed: int = 0,
    specimen: int = 0,
    cameras: str | Sequence[str] = "front",
    fps: int = 25,
    size: tuple[int, int] = (640, 480),
    codec: str = "av1",
) -> Path:
    """Record one episode in which both arms turn tags before the cameras.

    Parameters
    ----------
    out : str or Path
        The folder; it must not exist.
    n : int, default=30
        Postures, in each of which both arms stand still.
    seed : int, default=0
        Of the postures and the noise of the pictures.
    specimen : int, default=0
        As of :class:`BiSo101Env`.
    cameras : str or sequence of str, default="front"
    fps : int, default=25
    size : (int, int)
        Width and height of the pictures.
    codec : {"av1", "h264", "pictures"}, default="av1"

    Returns
    -------
    Path
        The folder, with the true cell file, ``cell.json``, in it.
    """
    env, rng = BiSo101Env(fps=fps, specimen=specimen), np.random.default_rng((seed, n))
    env.reset(seed=seed)
    env.scene.let_go(LEFT)
    for name, place in AWAY.items():
        env.scene.put(name, np.array((*place, 1.0, 0.0, 0.0, 0.0)))
    cubes = {hand_of(side): cube_at(first, z=CUBE, size=TAG) for side, first in IN_HAND.items()}
    rig = rig_to_record(env, n, cameras, size, carriers={**CHECKS, **cubes}, objects={})
    postures = np.concatenate(
        [varied_postures(rig, hand_of(side), n, rng)[:, PARTS[side]] for side in SIDES],
        axis=1,
    )
    cell = {**rig.content(), **env.cell_of_joints()}
    options = {"codec": codec, "robot_type": env.robot_type}
    with recording_of(env, rig, out, cell, **options) as opened:
        for row in calibration_episode(
            rig, postures, fps, rng, env.in_stored_units, env.in_stored_units
        ):
            opened.add_frame(row)
        opened.save_episode()
    rig.close()
    return Path(out)

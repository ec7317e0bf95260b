"""Record demonstrations of the tasks with cameras, as LeRobot data sets with videos.

``python -m lerobot_env_bimanual.record --task pour --n 10 --cameras front --out out/pour``
writes a set with ``observation.state``, ``action``, the cameras' videos, and the true cell file
beside them; the poses of the objects are in the pictures alone.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_env_bimanual.base import Observation
from lerobot_env_bimanual.bottle.carrying import CarryAndPutEnv
from lerobot_env_bimanual.bottle.shaking import BottleShakingEnv
from lerobot_env_bimanual.controlled import ControlledEnv
from lerobot_env_bimanual.eyes.calibration import (
    calibration_episode,
    chain_of,
    varied_postures,
)
from lerobot_env_bimanual.eyes.carriers import CUBE_ROOM, cube_at
from lerobot_env_bimanual.eyes.lens import Imperfections
from lerobot_env_bimanual.eyes.recorder import CODECS, Recorder
from lerobot_env_bimanual.eyes.views import CHECK
from lerobot_env_bimanual.robot_scene import PALM_SIZE
from lerobot_env_bimanual.so101 import TASKS
from lerobot_env_bimanual.so101.env import BiSo101Env
from lerobot_env_bimanual.so101.expert import teleoperated
from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.names import ROBOTS, SUITE, UPPER_BODY
from lerobot_env_bimanual.suite.tasks import suite_task
from tpgmm_datasets.bottle.carrying import CarryAndPut, slid
from tpgmm_datasets.bottle.skill import HANDS, BottleShaking
from tpgmm_torch import Demonstration
from tpgmm_torch.exceptions import DataError, TPGMMError, UnknownNameError

__all__ = ["CALIBRATION", "EXPERTS", "Expert", "expert", "main", "record", "record_calibration"]

Vector = NDArray[np.float64]
#: Time steps per second of the experts' motions, whatever the rate of the set.
RATE = 100.0
#: The task of showing tags to the cameras, and by how much joints may be wrong then.
CALIBRATION = "calibration"
#: Tags in the hands that calibrate: the first number of each cube.
IN_HAND = {"l_hand": 30, "r_hand": 40}
#: Attempts for each episode that is asked for; experts fail seldom.
ATTEMPTS = 3


@dataclass(frozen=True)
class Expert:
    """Who demonstrates a task, and where.

    Parameters
    ----------
    environment : callable
        Makes the environment, of ``fps`` and other options.
    motion : callable
        The demonstration that belongs to a seed.
    objects : tuple of str
        What is observed.
    actions : callable, optional
        In place of motions: gives the actions in an episode that has begun, one by one.
    """

    environment: Callable[..., ControlledEnv]
    motion: Callable[[int], Demonstration] | None
    objects: tuple[str, ...]
    actions: Callable[[Any, np.random.Generator], Iterator[Vector]] | None = None

    def begin(
        self, env: ControlledEnv, rng: np.random.Generator
    ) -> tuple[Observation, Iterable[Vector]]:
        """Begin an episode; what is observed, and the actions."""
        if self.motion is None:
            assert self.actions is not None
            observation, _ = env.reset(seed=int(rng.integers(2**31)))
            return observation, self.actions(env, rng)
        motion = self.motion(int(rng.integers(2**31)))
        seed = int(rng.integers(2**31))
        observation, _ = env.reset(seed=seed, options=self.start(motion))
        ticks = np.arange(1, int(motion.time[-1] * env.fps + 1e-6) + 2) / env.fps
        time = motion.time.numpy()
        ways = [np.interp(ticks, time, column) for column in motion.joints.numpy().T]
        return observation, np.stack(ways, axis=1)

    def start(self, motion: Demonstration) -> dict[str, Any]:
        """The options with which an episode begins as a demonstration does."""
        start: dict[str, Any] = {"joints": motion.joints[0].numpy()}
        for name in self.objects:
            pose = motion.frame(name)
            pose = pose[0] if pose.batch_shape else pose
            start[name] = torch.cat((pose.position, pose.orientation)).numpy()
        if motion.frame(self.objects[0]).batch_shape:  # it slides in the hands
            start["slide"] = slid(motion)
        return start


def expert(task: str, robot: str = UPPER_BODY) -> Expert:
    """The expert of a task by its name.

    Raises
    ------
    UnknownNameError
        If there is none.
    """
    if task in SUITE:
        able = suite_task(task, robot)

        def drawn(seed: int) -> Demonstration:
            return able.demonstrations(1, seed, RATE)[0]

        def made(**options: Any) -> ControlledEnv:
            return SuiteEnv(task, robot, **options)

        return Expert(made, drawn, able.objects)
    if task not in ALONE:
        raise UnknownNameError("task", task, "the recorder", EXPERTS)
    if robot != UPPER_BODY:
        raise DataError(f"{task} is done by its own robot alone, not by {robot!r}")
    return ALONE[task]


ALONE = {
    "bottle_shaking": Expert(
        partial(BottleShakingEnv, track=True),
        lambda seed: BottleShaking(rate=RATE, steady_rhythm=True).demonstrations(1, seed)[0],
        ("bottle",),
    ),
    "carry_and_put": Expert(
        CarryAndPutEnv,
        lambda seed: CarryAndPut(rate=RATE).demonstrations(1, seed)[0],
        ("bottle", "tray"),
    ),
    "cup_on_saucer": Expert(BiSo101Env, None, TASKS["cup_on_saucer"], teleoperated),
}
#: What can be recorded.
EXPERTS = (*ALONE, *SUITE)


def record(
    task: str,
    out: str | Path,
    *,
    n: int = 10,
    seed: int = 0,
    cameras: str | Sequence[str] = "front",
    fps: int = 25,
    size: tuple[int, int] = (640, 480),
    robot: str = UPPER_BODY,
    true_poses: bool = False,
    codec: str = "av1",
    noise: float = 0.0,
    imperfections: Imperfections | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Path:
    """Let an environment follow the expert's motions, and record what its cameras see.

    ``observation.state`` is what was measured, ``action`` the reference for the end of each
    period. Demonstrations that do not succeed by the rules of the environment are not kept.

    Parameters
    ----------
    task : str
        One of :data:`EXPERTS`.
    out : str or Path
        The folder; it must not exist.
    n : int, default=10
        How many episodes.
    seed : int, default=0
        Of the demonstrations and of all noise.
    cameras : str or sequence of str, default="front"
        Of :data:`~lerobot_env_bimanual.eyes.views.VIEWS`.
    fps : int, default=25
        Rows per second; a divisor of 1000.
    size : (int, int)
        Width and height of the pictures.
    robot : str, default="upper_body"
        Who does a task of the suite.
    true_poses : bool, default=False
        Whether the poses of the objects are recorded too, in ``observation.environment_state``.
    codec : {"av1", "h264", "pictures"}, default="av1"
    noise : float, default=0
        Of the sensors, as of :class:`~lerobot_env_bimanual.controlled.ControlledEnv`.
    imperfections : Imperfections, optional
        What spoils the pictures.
    progress : callable, optional
        Is given a line after each episode.

    Returns
    -------
    Path
        The folder, with ``cell.json`` in it.

    Raises
    ------
    DataError, UnknownNameError
        If the folder exists, an option is not one of the above, or so many do not succeed.
    """
    if n < 1:
        raise DataError(f"at least one episode is recorded, got n={n}")
    able = expert(task, robot)
    env = able.environment(fps=fps, noise=noise)
    rig = env.rig(cameras, size, imperfections)
    if not rig.views:
        raise DataError("a set with videos needs a camera: --cameras front")
    env.reset(seed=seed)  # the table stands somewhere
    recorder = Recorder(
        out,
        fps,
        env.recorded_names,
        dict.fromkeys(rig.views, size),
        env.cell(rig),
        objects=able.objects if true_poses else (),
        units=env.units,
        robot_type=env.robot_type or robot,
        codec=codec,
    )
    with recorder:
        for number in range(ATTEMPTS * n):
            # each has numbers of its own: episode 3 is the same, however many there are
            rng = np.random.default_rng((seed, number))
            done, seconds = _follow(recorder, env, rig, able, rng, true_poses)
            progress(
                f"episode {recorder.episodes} of {n}, {seconds:.1f} s"
                + ("" if done else ": one more failed, and was not kept")
            )
            if recorder.episodes == n:
                break
        else:
            raise DataError(
                f"of {ATTEMPTS * n} demonstrations of {task} {recorder.episodes} succeed, "
                f"{n} are asked for"
            )
    rig.close()
    env.close()
    return Path(out)


def record_calibration(
    out: str | Path,
    *,
    n: int = 30,
    seed: int = 0,
    cameras: str | Sequence[str] = "front",
    fps: int = 25,
    size: tuple[int, int] = (640, 480),
    robot: str = UPPER_BODY,
    hand: str = "r_hand",
    codec: str = "av1",
    offset_deg: float = 0.0,
    noise_deg: float = 0.0,
    imperfections: Imperfections | None = None,
) -> Path:
    """Let a robot of the suite show a cube of tags in its hand in varied postures.

    Parameters
    ----------
    out, seed, cameras, fps, size, robot, codec, imperfections
        As for :func:`record`; the postures are such that the first camera sees the tags.
    n : int, default=30
        How many postures.
    hand : {"r_hand", "l_hand"}, default="r_hand"
    offset_deg, noise_deg : float, default=0
        Standard deviations of constant errors of the joints that move the hand, and of the
        noise of each reading [deg]. The constant ones are ``joint_offsets`` of the cell file.

    Returns
    -------
    Path
        The folder, with the true ``cell.json`` in it.

    Raises
    ------
    DataError, UnknownNameError
        If the folder exists, an option is not one of the above, or so few postures show the
        tags.
    """
    if hand not in HANDS:
        raise UnknownNameError("hand", hand, "the recorder", HANDS)
    env = expert("lid", robot).environment(fps=fps)
    env.reset(seed=seed)
    side = 1 if hand == "r_hand" else -1  # palms are turned to each other
    cube = cube_at(IN_HAND[hand], y=side * (PALM_SIZE[1] + CUBE_ROOM))
    rig = env.rig(cameras, size, imperfections, {**CHECK, hand: cube}, {})
    rng = np.random.default_rng((seed, n))
    postures = varied_postures(rig, hand, n, rng)
    offsets = np.zeros(len(env.joint_names))
    moved = chain_of(rig, hand)
    offsets[moved] = np.radians(offset_deg) * rng.standard_normal(len(moved))
    named = {env.joint_names[one]: round(float(offsets[one]), 7) for one in moved}
    cell = {**rig.content(), "joints": list(env.joint_names)}
    cell |= {"joint_offsets": named} if offset_deg else {}

    def measured(joints: Vector) -> Vector:
        return joints - offsets + np.radians(noise_deg) * rng.standard_normal(len(joints))

    sizes = dict.fromkeys(rig.views, size)
    with Recorder(
        out, fps, env.joint_names, sizes, cell, robot_type=robot, codec=codec
    ) as recorder:
        calibration_episode(
            recorder, rig, postures, rng, measured, lambda joints: joints - offsets
        )
    rig.close()
    env.close()
    return Path(out)


def _follow(
    recorder: Recorder,
    env: ControlledEnv,
    rig: Any,
    able: Expert,
    rng: np.random.Generator,
    true_poses: bool,
) -> tuple[bool, float]:
    """Record an episode; whether it succeeds, and is kept, and its seconds."""
    observation, actions = able.begin(env, rng)
    over, info, seconds = False, {}, 0.0
    for reference in actions:
        poses = observation["environment_state"] if true_poses else None
        recorder.add(
            observation["agent_pos"], reference, rig.pictures(rng), env.task_description, poses
        )
        observation, _, _, over, info = env.step(reference)
        seconds += 1 / env.fps
    while not over:
        *_, over, info = env.step(reference)
    if info["is_success"]:
        recorder.save()
    else:
        recorder.discard()
    return bool(info["is_success"]), seconds


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m lerobot_env_bimanual.record",
        description="Record demonstrations with cameras as a LeRobot data set with videos.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument(
        "--task", required=True, choices=(*EXPERTS, CALIBRATION),
        help="what is done; calibration: tags in a hand are shown in varied postures",
    )  # fmt: skip
    parser.add_argument("--out", required=True, help="folder of the set; it must not exist")
    parser.add_argument("--n", type=int, default=10, help="episodes, or postures")
    parser.add_argument("--seed", type=int, default=0, help="of demonstrations and noise")
    parser.add_argument("--cameras", default="front", help="names, with commas between them")
    parser.add_argument("--fps", type=int, default=25, help="rows per second")
    parser.add_argument(
        "--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"),
        help="of the pictures",
    )  # fmt: skip
    parser.add_argument("--robot", choices=ROBOTS, default=UPPER_BODY, help="who does it")
    parser.add_argument("--codec", choices=CODECS, default="av1", help="of the videos")
    shown = parser.add_argument_group("demonstrations")
    shown.add_argument("--noise", type=float, default=0.0, help="of the sensors")
    shown.add_argument(
        "--true-poses", action="store_true", help="record the poses of the objects too"
    )
    moved = parser.add_argument_group("calibration")
    moved.add_argument("--hand", choices=HANDS, default=HANDS[1], help="that has the tags")
    moved.add_argument("--offset-deg", type=float, default=0.0, help="of the joints, constant")
    moved.add_argument("--noise-deg", type=float, default=0.0, help="of the joints")
    given = vars(parser.parse_args(arguments))
    task, given["size"] = given.pop("task"), tuple(given["size"])
    calibrates = task == CALIBRATION
    for name in ("noise", "true_poses") if calibrates else ("hand", "offset_deg", "noise_deg"):
        if given.pop(name) != parser.get_default(name):
            parser.error(f"--{name.replace('_', '-')} is no option of the task {task}")
    _hush()
    try:
        out = (
            record_calibration(**given) if calibrates else record(task, **given, progress=_say)
        )
    except TPGMMError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"recorded {out}")
    return 0


def _hush() -> None:
    """Let libraries report errors alone: progress is what this command says."""
    from datasets.utils.logging import disable_progress_bar

    os.environ.setdefault("SVT_LOG", "1")
    logging.getLogger("lerobot").setLevel(logging.ERROR)
    disable_progress_bar()


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())

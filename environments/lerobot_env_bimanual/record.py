"""Record demonstrations of the tasks with cameras, as LeRobot data sets with videos.

``python -m lerobot_env_bimanual.record --task pour --n 10 --cameras front --out out/pour``
writes a set with ``observation.state``, ``action``, the cameras' videos, and the true cell file
in it; the poses of the objects are in the pictures alone.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lerobot_env_bimanual.base import Array
from lerobot_env_bimanual.bottle.carry_and_put import CarryAndPut, slid
from lerobot_env_bimanual.bottle.carrying import CarryAndPutEnv
from lerobot_env_bimanual.bottle.shaking import BottleShakingEnv
from lerobot_env_bimanual.controlled import ControlledEnv
from lerobot_env_bimanual.eyes import calibration
from lerobot_env_bimanual.eyes.carriers import CUBE_ROOM, cube_at
from lerobot_env_bimanual.eyes.recorder import CODECS, recording_before, row
from lerobot_env_bimanual.eyes.rig import Rig
from lerobot_env_bimanual.robot_scene import PALM_SIZE
from lerobot_env_bimanual.so101 import BI_SO101, TASKS
from lerobot_env_bimanual.so101.env import BiSo101Env
from lerobot_env_bimanual.so101.expert import teleoperate
from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.names import MORE, ROBOTS, SUITE, UPPER_BODY
from lerobot_env_bimanual.suite.tasks import suite_task
from tpgmm_datasets.bottle.skill import HANDS, BottleShaking
from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.exceptions import DataError, TPGMMError, UnknownNameError

__all__ = ["record"]

#: Time steps per second of the experts' motions, whatever the rate of the set.
RATE = 100.0
#: The task of showing tags to the cameras, and the first tag of the cube in each hand.
CALIBRATION, IN_HAND = "calibration", {"l_hand": 30, "r_hand": 40}
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
        In place of motions: the actions in an episode that has begun, one by one.
    """

    environment: Callable[..., ControlledEnv]
    motion: Callable[[int], Demonstration] | None
    objects: tuple[str, ...]
    actions: Callable[[Any, np.random.Generator], Iterable[Array]] | None = None

    def begin(
        self, env: ControlledEnv, rng: np.random.Generator
    ) -> tuple[dict[str, Any], Iterable[Array]]:
        """Begin an episode: what is observed, and the actions."""
        motion = self.motion(int(rng.integers(2**31))) if self.motion else None
        start, seed = {} if motion is None else self.start(motion), int(rng.integers(2**31))
        observation, _ = env.reset(seed=seed, options=start)
        if motion is None:
            assert self.actions is not None
            return observation, self.actions(env, rng)
        time = motion.time.numpy()
        ticks = np.arange(1, int(time[-1] * env.fps + 1e-6) + 2) / env.fps
        ways = [np.interp(ticks, time, column) for column in motion.joints.numpy().T]
        return observation, np.stack(ways, axis=1)

    def start(self, motion: Demonstration) -> dict[str, Any]:
        """Return the options with which an episode begins as a demonstration does."""
        start: dict[str, Any] = {"joints": motion.joints[0].numpy()}
        for name in self.objects:
            pose = motion.frame(name)
            pose = pose[0] if pose.batch_shape else pose
            start[name] = torch.cat((pose.position, pose.orientation)).numpy()
        if motion.frame(self.objects[0]).batch_shape:  # it slides in the hands
            start["slide"] = slid(motion)
        return start


def expert(task: str, robot: str = UPPER_BODY) -> Expert:
    """Find the expert of a task by its name, and that of the robot.

    Raises
    ------
    DataError, UnknownNameError
        If it does not exist.
    """
    if task not in EXPERTS:
        raise UnknownNameError("task", task, "the recorder", EXPERTS)
    if task in SUITE or task in MORE:
        able = suite_task(task, robot)
        made, of = partial(SuiteEnv, task, robot), partial(able.demonstrations, rate=RATE)
        return Expert(made, lambda seed: of(1, seed)[0], able.objects)
    if robot not in (UPPER_BODY, BI_SO101 if task in TASKS else UPPER_BODY):
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
    "cup_on_saucer": Expert(BiSo101Env, None, TASKS["cup_on_saucer"], teleoperate),
}
#: What can be recorded.
EXPERTS = (*ALONE, *SUITE, *MORE)


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
    codec: str = "av1",
    true_poses: bool = False,
    noise: float = 0.0,
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
        Who does a task of the suite. Other tasks have a robot of their own.
    codec : {"av1", "h264", "pictures"}, default="av1"
        How pictures are stored.
    true_poses : bool, default=False
        Whether the poses of the objects are recorded too, in ``observation.environment_state``.
    noise : float, default=0
        Of the sensors, as of :class:`~lerobot_env_bimanual.controlled.ControlledEnv`.
    progress : callable, optional
        Is given a line after each episode.

    Returns
    -------
    Path
        The folder, with the true ``cell.json`` in it.

    Raises
    ------
    DataError, UnknownNameError
        If the folder exists, an option is not one of the above, or fewer demonstrations
        succeed.
    """
    able = expert(task, robot)
    env = able.environment(fps=fps, noise=noise)
    env.reset(seed=seed)
    settings: dict[str, Any] = {
        "objects": able.objects if true_poses else (),
        "robot_type": env.robot_type or robot,
        "codec": codec,
    }
    with recording_before(env, out, n, cameras=cameras, size=size, **settings) as (rig, opened):
        _demonstrate(opened, able, env, rig, n, seed, true_poses, progress)
    return Path(out)


def record_calibration(
    out: str | Path,
    *,
    n: int = 10,
    seed: int = 0,
    fps: int = 25,
    robot: str = UPPER_BODY,
    hand: str = HANDS[1],
    offset_deg: float = 0.0,
    noise_deg: float = 0.0,
    **options: Any,
) -> Path:
    """Record one episode in which a robot shows a cube of tags in its hand to a camera.

    Parameters
    ----------
    out, seed, fps
        As of :func:`record`.
    n : int, default=10
        How many postures.
    robot : str, default="upper_body"
        Who is calibrated; ``"bi_so101"`` with both hands at once, and its own offsets.
    hand : {"r_hand", "l_hand"}, default="r_hand"
        The one that has the tags.
    offset_deg, noise_deg : float, default=0
        Standard deviations of constant errors of the joints that move this hand, and of the
        noise of each reading [deg]. The constant ones are ``joint_offsets`` of the cell file.
    **options
        ``cameras``, ``size`` and ``codec``, as of :func:`record`.

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
    env: ControlledEnv
    reading: tuple[calibration.Reading, calibration.Reading]
    if robot == BI_SO101:
        env = arms = BiSo101Env(fps=fps)
        rng = np.random.default_rng((seed, n))
        env.reset(seed=seed)
        cubes, cell = arms.take_cubes(), dict[str, Any]()
        reading = arms.in_stored_units, arms.in_stored_units
    else:
        env, rng = expert("lid", robot).environment(fps=fps), np.random.default_rng(seed)
        env.reset(seed=seed)
        side = PALM_SIZE[1] + CUBE_ROOM  # palms are turned to each other
        cubes = {hand: cube_at(IN_HAND[hand], y=side if hand == "r_hand" else -side)}
        moved, offsets = calibration.chain_of(env.scene, hand), np.zeros(len(env.joint_names))
        offsets[moved] = np.radians(offset_deg) * rng.standard_normal(len(moved)).round(4)
        cell = {"joint_offsets": {env.joint_names[i]: float(offsets[i]) for i in moved}}

        def measure(joints: Array) -> Array:
            noise = np.radians(noise_deg) * rng.standard_normal(len(joints))
            return np.asarray(joints - offsets + noise)

        reading = measure, lambda joints: joints - offsets
    tags = {"carriers": {**env.checks, **cubes}, "objects": {}}
    options |= {"cell": cell, "tags": tags, "robot_type": env.robot_type or robot}
    with recording_before(env, out, n, **options) as (rig, opened):
        for frame in calibration.calibration_episode(rig, cubes, n, fps, rng, *reading):
            opened.add_frame(frame)
        opened.save_episode()
    return Path(out)


def _demonstrate(
    opened: Any,
    able: Expert,
    env: ControlledEnv,
    rig: Rig,
    n: int,
    seed: int,
    true_poses: bool,
    progress: Callable[[str], None],
) -> None:
    """Record demonstrations until a number of them succeed."""
    for number in range(ATTEMPTS * n):
        # each has numbers of its own: episode 3 is the same, however many there are
        rng = np.random.default_rng((seed, number))
        (observation, actions), over = able.begin(env, rng), False
        for reference in actions:
            poses = observation["environment_state"] if true_poses else None
            seen, joints = rig.pictures(rng), observation["agent_pos"]
            opened.add_frame(row(env.task_description, joints, reference, seen, poses))
            observation, _, _, over, info = env.step(reference)
        while not over:
            *_, over, info = env.step(reference)
        if info["is_success"]:
            opened.save_episode()
        else:
            opened.clear_episode_buffer()
        failed = "" if info["is_success"] else ": one failed, and is not kept"
        progress(f"episode {opened.num_episodes} of {n}{failed}")
        if opened.num_episodes == n:
            return
    raise DataError(
        f"of {ATTEMPTS * n} demonstrations {opened.num_episodes} succeed, {n} are asked for"
    )


def demonstrate_forces(
    task: str, n: int = 5, seed: int = 0, *, fps: int = 50, robot: str = UPPER_BODY
) -> list[Demonstration]:
    """Demonstrations with wrenches: what the robot measures while it follows the expert.

    Parameters
    ----------
    task : str
        Of the suite.
    n : int, default=5
        How many.
    seed : int, default=0
    fps : int, default=50
        Time steps per second.
    robot : str, default="upper_body"

    Returns
    -------
    list of Demonstration
        The joints are measured, the frames those of the beginning.
    """
    able, found = expert(task, robot), list[Demonstration]()
    env = able.environment(fps=fps, force=True)
    for number in range(n):
        seen, actions = able.begin(env, np.random.default_rng((seed, number)))
        every = [seen]
        for reference in actions:
            seen, _, _, over, _ = env.step(reference)
            every.append(seen)
            if over:
                break
        rows = {key: torch.from_numpy(np.stack([one[key] for one in every])) for key in seen}
        poses = rows["environment_state"][0].view(-1, 7)
        objects = zip(able.objects, poses, strict=True)
        found.append(
            Demonstration(
                rows["timestamp"][:, 0],
                rows["agent_pos"],
                {name: Frame(pose[:3], pose[3:]) for name, pose in objects},
                env.joint_names,
                wrenches={hand: rows[f"wrench.{hand}"] for hand in HANDS},
            )
        )
    env.close()
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        prog="python -m lerobot_env_bimanual.record",
        description="Record demonstrations with cameras as a LeRobot data set with videos.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add, motion = parser.add_argument, f"of the task {CALIBRATION}"
    tasks = (*EXPERTS, CALIBRATION)
    add("--task", required=True, choices=tasks, help=f"{CALIBRATION} shows tags in a hand")
    add("--out", required=True, help="folder of the set; it must not exist")
    add("--n", type=int, default=10, help="episodes, or postures")
    add("--seed", type=int, default=0, help="of demonstrations and noise")
    add("--cameras", default="front", help="names, with commas between them")
    add("--fps", type=int, default=25, help="rows per second")
    add("--size", type=int, nargs=2, default=(640, 480), help="width and height of pictures")
    usual = f"who does it (default: {UPPER_BODY}, and {BI_SO101} for {', '.join(TASKS)})"
    add("--robot", choices=(*ROBOTS, BI_SO101), default=argparse.SUPPRESS, help=usual)
    add("--codec", choices=CODECS, default="av1", help="of the videos")
    add("--noise", type=float, default=0.0, help="of the sensors, in demonstrations")
    add("--true-poses", action="store_true", help="demonstrations with the poses of objects")
    add("--hand", choices=HANDS, default=HANDS[1], help=f"that has the tags, {motion}")
    add("--offset-deg", type=float, default=0.0, help=f"constant, of joints, {motion}")
    add("--noise-deg", type=float, default=0.0, help=f"of joints, {motion}")
    given = vars(parser.parse_args(arguments))
    task, given["size"] = given["task"], tuple(given["size"])
    others = ("noise", "true_poses"), ("hand", "offset_deg", "noise_deg")
    for name in others[task != CALIBRATION]:
        if given.pop(name) != parser.get_default(name):
            parser.error(f"--{name.replace('_', '-')} is no option of the task {task}")
    _report_errors_alone()
    try:
        if task == CALIBRATION:
            del given["task"]
            record_calibration(**given)
        else:
            record(**given, progress=partial(print, file=sys.stderr, flush=True))
    except TPGMMError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"recorded {given['out']}")
    return 0


def _report_errors_alone() -> None:
    """Quieten libraries: progress is what this command says."""
    import av
    from datasets.utils.logging import disable_progress_bar

    av.logging.set_libav_level(av.logging.WARNING)
    os.environ.setdefault("SVT_LOG", "1")
    logging.getLogger("lerobot").setLevel(logging.ERROR)
    disable_progress_bar()


if __name__ == "__main__":
    sys.exit(main())

"""A picture of each task of the suite: three moments of an expert's episode, side by side.

    python examples/suite_pictures.py docs/images/suite
    python examples/suite_pictures.py docs/images/suite lid --robot viperx

It needs the plugin with its extra ``environments``, and EGL or OSMesa to draw with.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.names import ROBOTS, SUITE, UPPER_BODY
from lerobot_env_bimanual.suite.tasks import suite_task

SEED, FPS = 1, 25
#: Of the camera's picture, and the part of it that is shown: robot and things [pixels].
WIDTH, HEIGHT = 422, 343
SHOWN = {
    UPPER_BODY: (slice(5, 265), slice(100, 356)),
    "viperx": (slice(70, 320), slice(5, 400)),
    "g1": (slice(5, 265), slice(100, 356)),
}


def moments(name: str, robot: str) -> list[NDArray[np.uint8]]:
    """Pictures of when objects are held, of halfway from there to the end, and of the end."""
    task = suite_task(name, robot)
    size = {"render_width": WIDTH, "render_height": HEIGHT}
    env = SuiteEnv(name, robot, fps=FPS, render_mode="rgb_array", **size)
    rng = np.random.default_rng(SEED)
    poses, joints = task.draw(rng), task.start_posture(rng)
    path = task.nominal(poses, joints, FPS).joints.numpy()
    env.reset(seed=SEED, options={**poses, "joints": joints})
    ends, last = task.ends(), [*task.phases][-2]
    held, done = round(FPS * ends[task.grasp]), round(FPS * ends[last])
    wanted, pictures = (held, (held + done) // 2, done), []
    for step in range(1, env.episode_length + 1):
        *_, info = env.step(path[min(step, len(path) - 1)])
        if step in wanted:
            picture = env.render()
            assert picture is not None
            pictures.append(picture[SHOWN[robot]])
    print(f"{name}: {'success' if info['is_success'] else 'failure'}")
    return pictures


def main() -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("tasks", nargs="*", default=[*SUITE])
    parser.add_argument("--robot", choices=ROBOTS, default=UPPER_BODY)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.tasks:
        strip = Image.fromarray(np.concatenate(moments(name, arguments.robot), axis=1))
        whose = "" if arguments.robot == UPPER_BODY else f"-{arguments.robot}"
        strip.save(arguments.out / f"{name}{whose}.webp", quality=75, method=6)


if __name__ == "__main__":
    main()

"""Moving pictures of a skill in new situations, and while things go wrong, as WebP files.

The simulated robot shakes bottles that stand in three poses, side by side, beginning in three
postures. Then it shakes one in episodes of the environment ``bottle_shaking`` in which
it is stopped, is pushed back, or in which somebody moves the bottle; and it carries one that
slides in its hands to a tray, in ``carry_and_put``; beside it, over time, the controller's
progress in the skill, and how stiff the model wants the arms to be.

    python examples/moving_pictures.py docs/images

It needs the plugin with its extra ``environments``, and EGL or OSMesa to draw with.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lerobot_env_bimanual.bottle.carrying import CarryAndPutEnv
from lerobot_env_bimanual.bottle.handling import BottleEnv
from lerobot_env_bimanual.bottle.shaking import BottleShakingEnv
from tpgmm_control import Controller
from tpgmm_control.impedance.stiffness import Impedance
from tpgmm_control.loop.command import Command, Status
from tpgmm_evaluation.benchmarks import BottleBenchmark, CarryBenchmark
from tpgmm_tools.plotting import BLUE, VERMILION
from tpgmm_torch import Frame, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping

#: File, task, condition of the environment, what happens.
EPISODES = {
    "stopped": ("shake", "stopped-3@6+live", "stopped for 3 s"),
    "pushed": ("shake", "pushed-back-2@8+live", "pushed back by 2 s"),
    "moved": ("shake", "moved-slowly+live", "the bottle is moved on the way"),
    "carried": ("carry", "nominal", "the bottle slides in the hands"),
}
#: The environment of each task, and its generator and operators.
TASKS: dict[str, tuple[type[BottleEnv], type[BottleBenchmark] | type[CarryBenchmark]]] = {
    "shake": (BottleShakingEnv, BottleBenchmark),
    "carry": (CarryAndPutEnv, CarryBenchmark),
}
SEED = 10003
#: Poses of the bottle, none of them demonstrated: near and left, far and low, right and high.
SEEDS = 10020, 10043, 10046
#: Pictures per second of the episode, and how fast they are shown.
PICTURES, SPEED = 5, 2.0
#: Of the picture of the robot, and of the curves beside it [pixels].
HEIGHT, WIDTH, CURVES = 180, 200, 220


def learned(task: str) -> TaskParameterizedGMM:
    """A skill from ten generated demonstrations."""
    bench = TASKS[task][1](rate=25)
    demonstrations = bench.skill.demonstrations(10, seed=0)
    aligned = DynamicTimeWarping(robot=bench.robot).fit_transform(demonstrations)
    operators = bench.operators(orientation=True)
    return TaskParameterizedGMM(bench.n_components, operators, bench.robot).fit(aligned)


def observed(
    observation: dict[str, Any], names: Sequence[str] = ("bottle",)
) -> tuple[NDArray[np.float64], dict[str, Frame]]:
    """Posture and objects of an observation."""
    poses = observation["environment_state"].reshape(-1, 7)
    frames = {name: Frame(pose[:3], pose[3:]) for name, pose in zip(names, poses, strict=True)}
    return observation["agent_pos"], frames


def run(
    model: TaskParameterizedGMM,
    task: str,
    condition: str = "nominal",
    length: int | None = None,
    seed: int = SEED,
) -> Iterator[tuple[float, Command, NDArray[np.uint8]]]:
    """Time, command and picture, ``PICTURES`` times a second of an episode of some ticks."""
    made, bench = TASKS[task]
    env = made(
        condition=condition,
        episode_length=length,
        render_mode="rgb_array",
        render_width=WIDTH,
        render_height=HEIGHT,
    )
    observation, _ = env.reset(seed=seed)
    impedance = Impedance(model.kinematics_)
    controller = Controller(
        model.skill, *observed(observation, bench.objects), impedance=impedance
    )
    over, step = False, 0
    while not over:
        command = controller.step(1 / env.fps, *observed(observation, bench.objects))
        if step % (env.fps // PICTURES) == 0:
            yield step / env.fps, command, env.render()
        observation, _, ended, cut, info = env.step(controller.reference.numpy())
        over, step = ended or cut, step + 1
    print(f"{task}, {condition}: {'success' if info['is_success'] else 'failure'}")


class Curves:
    """Progress and stiffness over time, up to now."""

    def __init__(self, title: str, seconds: float, length: float) -> None:
        mpl.rcParams.update(
            {"font.size": 7, "axes.spines.top": False, "axes.spines.right": False}
        )
        figure = Figure((CURVES / 100, HEIGHT / 100), dpi=100, layout="constrained")
        self._canvas = FigureCanvasAgg(figure)
        above, below = figure.subplots(2, sharex=True)
        figure.suptitle(title, fontsize=7)
        for axes in (above, below):
            axes.spines[["top", "right"]].set_visible(False)
        above.plot((0, length), (0, length), color="0.8", linewidth=1)
        above.set(ylabel="progress [s]", ylim=(0, 1.05 * length), xlim=(0, seconds))
        below.set(ylabel="stiffness\n[N m/rad]", xlabel="time [s]", ylim=(0, 420))
        self._lines = above.plot([], [], "k")[0], below.plot([], [], color=BLUE)[0]
        self._status = above.text(0.02, 0.82, "", transform=above.transAxes, color=VERMILION)
        self._points: list[tuple[float, float, float]] = []

    def __call__(self, time: float, command: Command) -> NDArray[np.uint8]:
        """The picture (height, width, 3) at the next instant."""
        self._points.append((time, float(command.time), float(command.stiffness.mean())))
        times, *curves = np.array(self._points).T
        for line, curve in zip(self._lines, curves, strict=True):
            line.set_data(times, curve)
        self._status.set_text("" if command.status == Status.RUNNING else command.status.value)
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3]


def write(
    path: Path,
    model: TaskParameterizedGMM,
    task: str,
    condition: str,
    title: str,
    length: int | None = None,
) -> None:
    """One episode as a file."""
    moments = list(run(model, task, condition, length))
    curves = Curves(title, moments[-1][0], float(model.time_[-1]))
    save(path, [np.hstack((now, curves(time, command))) for time, command, now in moments])


def write_poses(path: Path, model: TaskParameterizedGMM) -> None:
    """Episodes that differ in the bottle's pose side by side as a file."""
    episodes = []
    for seed in SEEDS:
        observation, _ = BottleShakingEnv().reset(seed=seed)
        place = observed(observation)[1]["bottle"]
        w, _, _, z = place.orientation.tolist()  # turned about the vertical alone
        x, y, height = (100 * place.position).tolist()
        angle = np.degrees(2 * np.arctan2(z, w))
        title = f"x {x:.0f} cm, y {y:.0f} cm, z {height:.0f} cm\nturned {angle:.0f} deg"
        pictures = [Image.fromarray(picture) for *_, picture in run(model, "shake", seed=seed)]
        for picture in pictures:
            ImageDraw.Draw(picture).text((6, 4), title, fill="black")
        episodes.append([np.asarray(picture) for picture in pictures])
    save(path, [np.hstack(side_by_side) for side_by_side in zip(*episodes, strict=True)])


def save(path: Path, moments: Sequence[NDArray[np.uint8]]) -> None:
    """Pictures (height, width, 3) as a file that starts again after the last."""
    pictures = [Image.fromarray(moment) for moment in moments]
    shown = round(1000 / (PICTURES * SPEED))
    durations = [shown] * (len(pictures) - 1) + [1500]  # the last one stands
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=durations, loop=0,
        quality=35, method=6, minimize_size=True,
    )  # fmt: skip
    print(f"{path}: {len(pictures)} pictures, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="where the files go")
    parser.add_argument("--only", choices=("poses", *EPISODES), help="one of them")
    options = parser.parse_args()
    torch.set_num_threads(1)
    skills = {}
    if options.only in (None, "poses"):
        skills["shake"] = learned("shake")
        write_poses(options.folder / "poses.webp", skills["shake"])
    for name, (task, *shown) in EPISODES.items():
        if options.only in (None, name):
            skills[task] = skills.get(task) or learned(task)
            write(options.folder / f"{name}.webp", skills[task], task, *shown)

"""Drawn scenes in the way of a skill: what references touch without and with obstacles.

    python -m benchmarks.obstacle_scenes --scenes 200 --rates 25,100

A skill for two hands is learned from ten demonstrations. Each scene has another situation and
something in the way, of five kinds in turns: a ball or a box where a hand or a forearm passes,
a table that is too high on one side, the other arm, which is led where the first one passes,
and a ball that what the hands carry would meet. Every reference of a controller is examined,
without and with the scene. The object of the task is not in it.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from tpgmm_control import Controller
from tpgmm_control.obstacles import Scene, Shape
from tpgmm_datasets.bottle.skill import HANDS, BottleShaking, bottle_operators
from tpgmm_evaluation.report.tables import wilson
from tpgmm_torch import Demonstration, Frame, Hold, TaskParameterizedGMM, ViaPoints
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.robots.held_objects import held_objects
from tpgmm_torch.skills.via_points import ViaPoint

KINDS = ("ball", "box", "table", "arms", "carried")
#: The bottle as a solid, half its height [m], and what touches it when it is held.
RADIUS, HALF = 0.04, 0.11
TOUCH = [
    ("bottle", f"{side}_{part}") for side in "lr" for part in ("hand", "wrist_1", "wrist_2")
]
#: How near hands have to be to be where they should [m], and how long a run may take [s].
THERE, LONGEST = 0.01, 16.0


@cache
def learn_skill() -> tuple[Any, tuple[Demonstration, ...], float, float]:
    """Learn the skill; return it, its demonstrations, and when hands close and arrive."""
    recorded = BottleShaking(rate=20).demonstrations(10, seed=0)
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(recorded)
    robot = BottleShaking().robot
    model = TaskParameterizedGMM(20, bottle_operators(), robot).fit(aligned)
    closed, brought = (
        float(np.mean([shown.events[name] for shown in aligned])) for name in ("grasp", "shake")
    )
    return model.skill, tuple(aligned), closed, brought


@dataclass(frozen=True)
class Drawn:
    """A scene, and what runs in it."""

    kind: str
    skill: Any
    scene: Scene
    end: float
    begin: float | None = None
    joints: Tensor | None = None
    frames: Mapping[str, Frame] = field(default_factory=dict)

    @property
    def held(self) -> bool:
        """True if the hands hold the bottle."""
        return self.kind == "carried"


def draw_scene(number: int) -> Drawn:
    """Draw a scene by its number: nothing is in the way at first, and something later."""
    rng = np.random.default_rng((7, number))
    for _ in range(100):
        scene = _draw(KINDS[number % len(KINDS)], rng)
        part = scene.begin, scene.end
        run = _run(scene.skill, scene.joints, scene.frames, None, 0.04, part, scene.held)
        distances = _distances(scene, run["references"]).values()
        if all(d[0] > 0 for d in distances) and any((d < 0).any() for d in distances):
            return scene
    raise RuntimeError(f"nothing is in the way in scene {number}")


def _draw(kind: str, rng: np.random.Generator) -> Drawn:
    skill, demonstrations, closed, brought = learn_skill()
    robot = skill.kinematics
    [situation] = BottleShaking().situations(1, seed=int(rng.integers(10**6)))
    free = _run(skill, situation.joints, situation.frames, None, 0.04, (0.0, brought))
    references, states = free["references"], robot.state(free["references"])
    at = int(rng.uniform(0.3, 0.85) * closed / 0.04)
    side = HANDS[int(rng.integers(2))]
    if kind == "carried":
        begin, (frames, solid) = int(closed / 0.04), _draw_on_the_way_of_the_bottle(rng, states)
        bottle = Shape.cylinder("bottle", RADIUS, 2 * HALF, [0, 0, 0], carrier="bottle")
        scene = Scene(robot, [solid, bottle], visuals=True, allowed=TOUCH)
        scene = scene.allowing(demonstrations)
        return Drawn(kind, skill, scene, brought, closed, references[begin], frames)
    solids: list[Shape] = []
    if kind == "arms":
        other = HANDS[side == HANDS[0]]
        target = states.position(side)[at] + torch.from_numpy(rng.normal(0, 0.01, 3))
        target[1] *= 0.5
        skill = ViaPoints(skill, [ViaPoint(0.04 * at, f"position:{other}", target)])
    else:
        place = states.position(side)[at].numpy()
        if kind != "table":
            if rng.random() < 0.4:
                place = 0.5 * (place + _elbow(references[at], side))
            place = place + rng.normal(0, 0.01, 3)
        solids.append(_draw_solid(kind, rng, place))
    scene = Scene(robot, solids, visuals=True, allowed=()).allowing(demonstrations)
    start = situation.joints, situation.frames
    return Drawn(kind, skill, scene, closed + 0.5, None, *start)


def _draw_solid(kind: str, rng: np.random.Generator, place: Any) -> Shape:
    """Draw a ball or a box, or a table beside a hand, which comes down from the side."""
    if kind == "table":
        x, y, z = place
        edge = y + np.sign(y) * rng.uniform(-0.03, 0.03)
        centre = [x, edge + np.sign(y) * 0.1, z - rng.uniform(-0.02, 0.02)]
        return Shape.box("table", [0.25, 0.2, 0.02], centre)
    size = rng.uniform(0.02, 0.04)
    if kind == "ball":
        return Shape.sphere("ball", size, place)
    turn = rng.standard_normal(4)
    turn /= np.linalg.norm(turn)
    edges = 2 * rng.uniform(0.02, 0.04, 3)
    return Shape.box("box", edges, place, orientation=turn)


def _draw_on_the_way_of_the_bottle(
    rng: np.random.Generator, states: Any
) -> tuple[dict[str, Frame], Shape]:
    """Draw a ball that the bottle would meet; return it with where the bottle is."""
    *_, closed, brought = learn_skill()
    start = int(closed / 0.04)
    middle = (0.5 * (states.position(HANDS[0]) + states.position(HANDS[1]))).numpy()
    along = start + int(rng.uniform(0.4, 0.8) * (brought - closed) / 0.04)
    way, size = middle[along] - middle[start], rng.uniform(0.015, 0.03)
    ahead = way / np.linalg.norm(way) * (RADIUS + size - rng.uniform(0.01, 0.03))
    return {"bottle": Frame(middle[start])}, Shape.sphere("ball", size, middle[along] + ahead)


def _elbow(joints: Tensor, hand: str) -> Any:
    """Compute where the forearm of a hand begins."""
    robot = BottleShaking().robot
    config = {**robot.config(), "links": [f"{hand[0]}_forearm"]}
    return type(robot).from_config(config).state(joints).positions[0].numpy()


def _run(
    skill: Any, joints: Tensor, frames: Mapping[str, Frame], scene: Scene | None, dt: float,
    part: tuple[float | None, float], held: bool = False, stop: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Run a controller; return its references, reasons and durations of ticks."""
    begin, end = part
    clock = "even" if stop is None else f"waiting:arrivals={stop}"
    running = Controller(
        skill, joints, frames, clock=clock, trust=None, smoothing=None, obstacles=scene,
        begin=begin, end=end,
    )  # fmt: skip
    sent, reasons, ticks = [], [], []
    holds = {"holds": {"bottle": "l_hand"}} if held else {}
    for _ in range(round(LONGEST / dt)):
        began = time.process_time()
        command = running.step(dt, **holds)
        ticks.append(time.process_time() - began)
        sent.append(command.reference)
        reasons.append((str(command.status), command.reason()))
        if running.finished:
            break
    return {
        "references": torch.stack(sent), "reasons": reasons, "ticks": ticks,
        "finished": running.finished,
    }  # fmt: skip


def _distances(one: Drawn, references: Tensor) -> dict[tuple[str, str], Any]:
    """Compute distances of pairs in a motion, with what the hands hold."""
    time = torch.arange(len(references), dtype=torch.float64)
    holds = [Hold("bottle", "l_hand", 0.0, len(references))] if one.held else []
    robot = one.skill.kinematics
    state, places = held_objects(robot.state(references), time, one.frames, holds)
    return one.scene.distances(references, places, 0.05, state)


def examine_scene(number: int, dt: float) -> dict[str, Any]:
    """Measure one scene: without obstacles, and with them."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    one = draw_scene(number)
    given = one.skill, one.joints, one.frames
    part = one.begin, one.end
    bare = _run(*given, None, dt, part, one.held)
    kept = _run(*given, one.scene, dt, part, one.held, stop=one.end - 0.5)
    states = [one.skill.kinematics.state(run["references"][-1]) for run in (bare, kept)]
    off = (states[0].positions - states[1].positions).norm(dim=-1).max()
    needed = dict(zip(one.scene.pairs, one.scene.needed, strict=True))
    turns = kept["references"].diff(n=2, dim=0).abs().max(1).values
    waiting = np.array([status == "waiting" for status, _ in kept["reasons"]][2:])
    calm = turns[waiting][-round(2 / dt) :].median() if waiting[-10:].all() else None
    bounds, shares = one.skill.motion_bounds, []
    for order, name in enumerate(("velocity", "acceleration", "jerk"), 1):
        speed = kept["references"].diff(n=order, dim=0) / dt**order
        shares.append(float((speed.abs() / getattr(bounds, name)).max()))
    found = {"number": number, "kind": one.kind, "dt": dt, "bounds": max(shares)}
    distances = {}
    for name, run in (("bare", bare), ("kept", kept)):
        distances[name] = _distances(one, run["references"])
        deepest = ((float(d.min()), " / ".join(pair)) for pair, d in distances[name].items())
        distance, found[f"{name}_pair"] = min(deepest, default=(np.inf, ""))
        found[f"{name}_mm"] = 1e3 * distance
        found[f"{name}_ms"] = 1e3 * float(np.median(run["ticks"]))
    return found | {
        "finished": kept["finished"],
        "off_mm": 1e3 * float(off),
        "possible": all(
            values[-1] >= needed[pair] for pair, values in distances["bare"].items()
        ),
        "reason": kept["reasons"][-1][1] or "",
        "trembles": None if calm is None else float(calm),
    }


def _share(found: int, of: int) -> str:
    if not of:
        return "none"
    low, high = wilson(found, of)
    return f"{found} of {of} ({100 * low:.0f} to {100 * high:.0f} %)"


def summarize(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Format some lines for each rate and kind, and all kinds."""
    found = pd.DataFrame(rows)
    for dt, group in found.groupby("dt"):
        for kind in (*KINDS, "all"):
            some = group if kind == "all" else group[group.kind == kind]
            if not some.empty:
                yield f"{1 / dt:.0f} Hz, {kind}, {len(some)} scenes"
                yield from _lines(some)


def _lines(scenes: pd.DataFrame) -> Iterator[str]:
    possible = scenes[scenes.possible]
    there = possible.finished & (possible.off_mm <= 1e3 * THERE)
    held = scenes[~scenes.finished]
    trembling = held.trembles.dropna().astype(float)
    calm = trembling if len(trembling) else pd.Series([0.0])
    yield (
        f"  penetrate: {(scenes.bare_mm < 0).sum()} without, "
        f"{(scenes.kept_mm < 0).sum()} with (least {scenes.kept_mm.min():.1f} mm)"
    )
    yield f"  within 10 mm where possible: {_share(int(there.sum()), len(possible))}"
    yield (
        f"  held: {len(held)}, {(held.reason == '').sum()} without a reason; "
        f"second differences there {calm.median():.4f}, at most {calm.max():.4f} rad"
    )
    yield (
        f"  bounds used: {scenes.bounds.max():.4f}; a tick {scenes.bare_ms.median():.2f} ms "
        f"without, {scenes.kept_ms.median():.2f} with"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.obstacle_scenes")
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--rates", default="25,100", help="Hz, with commas")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, help="a JSON line for each scene and rate")
    given = parser.parse_args(arguments)
    numbers, rows = range(given.first, given.first + given.scenes), []
    with get_context("forkserver").Pool(given.workers) as pool:
        for rate in map(float, given.rates.split(",")):
            for row in pool.imap(partial(examine_scene, dt=1 / rate), numbers):
                rows.append(row)
                if given.out is not None:
                    with given.out.open("a") as file:
                        print(json.dumps(row), file=file)
    print(*summarize(rows), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

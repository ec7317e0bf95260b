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
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
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
def learned() -> tuple[Any, tuple[Demonstration, ...], float, float]:
    """The skill, its demonstrations, when hands have closed, and when the bottle is there."""
    recorded = BottleShaking(rate=20).demonstrations(10, seed=0)
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(recorded)
    robot = BottleShaking().robot
    model = TaskParameterizedGMM(20, bottle_operators(), robot).fit(aligned)
    closed, brought = (
        float(np.mean([one.events[name] for one in aligned])) for name in ("grasp", "shake")
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
        """Whether the hands hold the bottle."""
        return self.kind == "carried"


def drawn(number: int) -> Drawn:
    """A scene by its number: nothing is in the way at first, and something later."""
    rng = np.random.default_rng((7, number))
    for _ in range(100):
        one = _drawn(number, rng)
        run = _run(
            one.skill, one.joints, one.frames, None, 0.04, (one.begin, one.end), one.held
        )
        distances = _distances(one, run["references"]).values()
        if all(d[0] > 0 for d in distances) and any((d < 0).any() for d in distances):
            return one
    raise RuntimeError(f"nothing is in the way in scene {number}")


def _drawn(number: int, rng: np.random.Generator) -> Drawn:
    kind = KINDS[number % len(KINDS)]
    skill, demonstrations, closed, brought = learned()
    robot = skill.kinematics
    [situation] = BottleShaking().situations(1, seed=int(rng.integers(10**6)))
    bottle = Shape.cylinder("bottle", RADIUS, 2 * HALF, [0, 0, 0], carrier="bottle")
    carried = kind == "carried"
    begin, joints, frames = None, situation.joints, situation.frames
    free = _run(skill, joints, frames, None, 0.04, (0.0, brought))
    at = int(rng.uniform(0.3, 0.85) * closed / 0.04)
    states = robot.state(free["references"])
    side = HANDS[int(rng.integers(2))]
    place = states.position(side)[at].numpy()
    solids: list[Shape] = []
    if kind in ("ball", "box"):
        if rng.random() < 0.4:
            place = 0.5 * (place + _elbow(free["references"][at], side))
        place = place + rng.normal(0, 0.01, 3)
        size = rng.uniform(0.02, 0.04)
        if kind == "ball":
            solids.append(Shape.sphere("ball", size, place))
        else:
            turn = rng.standard_normal(4)
            turn /= np.linalg.norm(turn)
            edges = 2 * rng.uniform(0.02, 0.04, 3)
            solids.append(Shape.box("box", edges, place, orientation=turn))
    elif kind == "table":
        # hands come down to the bottle from the side
        x, y, z = place
        edge = y + np.sign(y) * rng.uniform(-0.03, 0.03)
        centre = [x, edge + np.sign(y) * 0.1, z - rng.uniform(-0.02, 0.02)]
        solids.append(Shape.box("table", [0.25, 0.2, 0.02], centre))
    elif kind == "arms":
        other = HANDS[side == HANDS[0]]
        target = states.position(side)[at] + torch.from_numpy(rng.normal(0, 0.01, 3))
        target[1] *= 0.5
        skill = ViaPoints(skill, [ViaPoint(0.04 * at, f"position:{other}", target)])
    else:
        begin = closed
        start = int(closed / 0.04)
        joints = free["references"][start]
        middle = (0.5 * (states.position(HANDS[0]) + states.position(HANDS[1]))).numpy()
        frames = {"bottle": Frame(middle[start])}
        along = start + int(rng.uniform(0.4, 0.8) * (brought - closed) / 0.04)
        way, size = middle[along] - middle[start], rng.uniform(0.015, 0.03)
        ahead = way / np.linalg.norm(way) * (RADIUS + size - rng.uniform(0.01, 0.03))
        solids.append(Shape.sphere("ball", size, middle[along] + ahead))
    solids += [bottle] * carried
    scene = Scene(robot, solids, visuals=True, allowed=TOUCH if carried else ())
    return Drawn(
        kind, skill, scene.allowing(demonstrations),
        brought if carried else closed + 0.5, begin, joints, frames,
    )  # fmt: skip


def _elbow(joints: Tensor, hand: str) -> Any:
    """Where the forearm of a hand begins."""
    robot = BottleShaking().robot
    config = {**robot.config(), "links": [f"{hand[0]}_forearm"]}
    return type(robot).from_config(config).state(joints).positions[0].numpy()


def _run(
    skill: Any, joints: Tensor, frames: Mapping[str, Frame], scene: Scene | None, dt: float,
    part: tuple[float | None, float], held: bool = False, stop: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    """References of a controller, and what else is asked of them."""
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
    """Distances of pairs in a motion, with what the hands hold."""
    time = torch.arange(len(references), dtype=torch.float64)
    holds = [Hold("bottle", "l_hand", 0.0, len(references))] if one.held else []
    robot = one.skill.kinematics
    state, places = held_objects(robot.state(references), time, one.frames, holds)
    return one.scene.distances(references, places, 0.05, state)


def _deepest(distances: Mapping[tuple[str, str], Any]) -> tuple[float, str]:
    """The least distance in a motion [m], and of which pair."""
    every = ((float(d.min()), " / ".join(pair)) for pair, d in distances.items())
    return min(every, default=(np.inf, ""))


def examined(number: int, dt: float) -> dict[str, Any]:
    """Figures of one scene: without obstacles, and with them."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    one = drawn(number)
    given = one.skill, one.joints, one.frames
    part = one.begin, one.end
    bare = _run(*given, None, dt, part, one.held)
    kept = _run(*given, one.scene, dt, part, one.held, stop=one.end - 0.5)
    states = [one.skill.kinematics.state(run["references"][-1]) for run in (bare, kept)]
    off = (states[0].positions - states[1].positions).norm(dim=-1).max()
    distances = {
        name: _distances(one, run["references"])
        for name, run in (("bare", bare), ("kept", kept))
    }
    needed = dict(zip(one.scene.pairs, one.scene.needed, strict=True))
    turns = kept["references"].diff(n=2, dim=0).abs().max(1).values
    waiting = np.array([status == "waiting" for status, _ in kept["reasons"]][2:])
    calm = turns[waiting][-round(2 / dt) :].median() if waiting[-10:].all() else None
    bounds, shares = one.skill.motion_bounds, []
    for order, name in enumerate(("velocity", "acceleration", "jerk"), 1):
        speed = kept["references"].diff(n=order, dim=0) / dt**order
        shares.append(float((speed.abs() / getattr(bounds, name)).max()))
    found = {"number": number, "kind": one.kind, "dt": dt, "bounds": max(shares)}
    for name, run in (("bare", bare), ("kept", kept)):
        distance, found[f"{name}_pair"] = _deepest(distances[name])
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


def summary(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Some lines for each rate and kind, and all kinds."""
    for dt, kind in product(sorted({row["dt"] for row in rows}), (*KINDS, "all")):
        some = [r for r in rows if r["dt"] == dt and kind in (r["kind"], "all")]
        if not some:
            continue
        possible = [r for r in some if r["possible"]]
        there = [r for r in possible if r["finished"] and r["off_mm"] <= 1e3 * THERE]
        held = [r for r in some if not r["finished"]]
        calm = [r["trembles"] for r in held if r["trembles"] is not None] or [0.0]
        of = {key: [r[key] for r in some] for key in ("bare_mm", "kept_mm", "bounds")}
        ticks = [np.median([r[key] for r in some]) for key in ("bare_ms", "kept_ms")]
        yield f"{1 / dt:.0f} Hz, {kind}, {len(some)} scenes"
        yield (
            f"  penetrate: {sum(x < 0 for x in of['bare_mm'])} without, "
            f"{sum(x < 0 for x in of['kept_mm'])} with (least {min(of['kept_mm']):.1f} mm)"
        )
        yield f"  within 10 mm where possible: {_share(len(there), len(possible))}"
        yield (
            f"  held: {len(held)}, {sum(not r['reason'] for r in held)} without a reason; "
            f"second differences there {np.median(calm):.4f}, at most {max(calm):.4f} rad"
        )
        yield (
            f"  bounds used: {max(of['bounds']):.4f}; a tick {ticks[0]:.2f} ms without, "
            f"{ticks[1]:.2f} with"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
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
            for row in pool.imap(partial(examined, dt=1 / rate), numbers):
                rows.append(row)
                if given.out is not None:
                    with given.out.open("a") as file:
                        print(json.dumps(row), file=file)
    print(*summary(rows), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

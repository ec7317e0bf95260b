"""Findings about frames: quaternion order, lost trackers, jumps, places unlike the others."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import torch

from tpgmm_datasets.checks.outliers import set_apart
from tpgmm_datasets.checks.places import Findings, report_at
from tpgmm_datasets.checks.recording_summaries import Recordings
from tpgmm_torch import quaternions
from tpgmm_torch.checks.report import Finding
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.robots.robot import Robot

#: Objects within this distance [m] or angle [rad] of the usual place are where others are.
NEAR, ALIKE = 0.15, float(np.deg2rad(60.0))
#: A hand that handles an object comes so near to its origin [m].
REACHED = 0.2
#: A tracker that jumps does so by this [m], at this speed [m/s], so many times its usual steps.
JUMP, JUMP_SPEED, JUMP_STEPS = 0.1, 5.0, 10.0
#: Of this many orientations the one that is nearest to the others is the usual one.
MOST_COMPARED = 500


def pose_findings(
    episodes: Recordings, other_units: Collection[str], robot: Kinematics | None = None
) -> Findings:
    """Find other quaternion orders, lost trackers, jumps, and places out of reach or unusual.

    Parameters
    ----------
    episodes : sequence of RecordingSummary
        With the same frames.
    other_units : collection of str
        Frames whose positions are not in metres: these say nothing more.
    robot : Kinematics, optional
        Whose links come near objects.
    """
    if isinstance(robot, Robot) and robot.links and episodes[0].frames and not other_units:
        yield from _check_reach(episodes, robot)
    for name in episodes[0].frames:
        if name not in other_units:
            yield from _check_places(name, episodes)
            yield from _check_angles(name, episodes)
            yield from _check_jumps(name, episodes)
        yield from _check_quaternion_order(name, episodes)


def _check_places(name: str, episodes: Recordings) -> Findings:
    """Find episodes in which the object is where it never is otherwise."""
    first = np.stack([episode.frames[name].position for episode in episodes])
    usual = np.median(first, axis=0)
    distances = np.linalg.norm(first - usual, axis=1)
    lost = np.flatnonzero((first == 0).all(axis=1))
    odd = {*set_apart(distances, NEAR), *(lost.tolist() if len(lost) < len(first) / 2 else ())}
    if odd:
        within = float(np.delete(distances, [*odd]).max())
        centre, *spots = (", ".join(f"{x:.3g}" for x in place) for place in (usual, *first))
        places = [
            (f"{distances[i]:.3g} m away in demonstration {i} ({spots[i]})", i, name)
            for i in sorted(odd)
        ]
        message = f"frame {name!r} is usually within {within:.2g} m of ({centre}), but"
        remedy = "Was the object tracked, and in the same base frame? Leave the episode out"
        yield from report_at("frames", message, remedy, places)


def _check_reach(episodes: Recordings, robot: Robot) -> Findings:
    """Find objects that no hand comes near, and the base in whose frame one would."""
    gaps = _measure_gaps(episodes, robot)
    best = min(gaps, key=lambda base: gaps[base])
    if gaps[""] <= REACHED:
        return
    message = (
        f"none of the links {list(robot.links)} comes nearer than {gaps['']:.2f} m to one of "
        f"the objects {list(episodes[0].frames)}"
    )
    remedy = "Are poses in metres, in the robot's base frame, and are these the hands?"
    if gaps[best] <= REACHED:
        remedy = (
            f"If poses were in the frame of {best!r}, one would come to {gaps[best]:.2f} m: "
            "put that base at the origin (combine: base=...), or convert the poses"
        )
    yield Finding("distance", message, remedy, (*episodes[0].frames,), value=gaps[""])


def _measure_gaps(episodes: Recordings, robot: Robot) -> dict[str, float]:
    """Measure how near hands come to objects [m], were poses in the frame of each base."""
    paths = np.stack([episode.path for episode in episodes])
    hands = as_array(robot.state(paths).positions)[:, :, None]
    places = np.array([[one.position for one in e.frames.values()] for e in episodes])
    root = robot.config()["base"]
    fixed = (j for j in robot.model.joints if j.type == "fixed" and j.parent == root)
    bases = {"": np.eye(4)} | {joint.child: joint.origin for joint in fixed}
    gaps = {}
    for base, pose in bases.items():
        there = (places @ pose[:3, :3].T + pose[:3, 3])[:, None, :, None]
        gaps[base] = float(np.linalg.norm(hands - there, axis=-1).min())
    return gaps


def _check_angles(name: str, episodes: Recordings) -> Findings:
    """Find episodes in which the object is turned as it never is otherwise."""
    turns = np.stack([episode.frames[name].orientation for episode in episodes])
    some = turns[:MOST_COMPARED]
    angles = 2 * np.arccos(np.abs(turns @ some.T).clip(max=1))
    angles = angles[:, np.median(angles[: len(some)], axis=0).argmin()]
    if odd := set_apart(angles, ALIKE):
        degrees = np.rad2deg(angles)
        places = [(f"by {degrees[i]:.0f} deg in demonstration {i}", i, name) for i in odd]
        usual = f"usually within {np.delete(degrees, odd).max():.0f} deg"
        message = f"frame {name!r} is {usual}, but turned unlike in the others"
        remedy = "Was the object tracked, and are all quaternions (w, x, y, z)? Leave it out"
        yield from report_at("frames", message, remedy, places)


def _check_jumps(name: str, episodes: Recordings) -> Findings:
    leaps = [(*episode.leaps[name], episode.step) for episode in episodes]
    places = [
        (f"by {size:.3g} m at {at:.4g} s of demonstration {i}", i, name)
        for i, (size, usual, at, step) in enumerate(leaps)
        if size > max(JUMP, JUMP_STEPS * usual, JUMP_SPEED * step)
    ]
    remedy = "Did the tracker lose it? Leave the episode out, or give one pose for all of it"
    yield from report_at("frames", f"frame {name!r} jumps", remedy, places)


def _check_quaternion_order(name: str, episodes: Recordings) -> Findings:
    """Find half-turns that would be turns about the vertical, were w the last number."""
    given = np.concatenate([episode.turns[name] for episode in episodes])
    upright, spread = _upright(given)
    meant, _ = _upright(np.roll(given, 1, axis=-1))
    half_turns = np.median(np.abs(given[:, 0])) < 0.2
    if spread > np.deg2rad(2) and meant > 0.97 and upright < 0.5 and half_turns:
        message = (
            f"frame {name!r} is turned by half turns about ever other axes; read as "
            "(x, y, z, w), its quaternions are turns about the vertical"
        )
        remedy = (
            "Quaternions are (w, x, y, z): give q[..., [3, 0, 1, 2]] "
            "(load_lerobot: FramePose(..., rotation='xyzw'))"
        )
        yield Finding("quaternions", message, remedy, (name,))


def _upright(orientations: Array) -> tuple[float, float]:
    """Return the share of scatter about the vertical axis, and the scatter [rad]."""
    given = torch.from_numpy(orientations)
    back = quaternions.conjugate(quaternions.mean(given))
    squares = as_array(quaternions.log(quaternions.product(given, back))) ** 2
    total = max(float(squares.sum()), 1e-12)
    return float(squares[:, 2].sum() / total), float(np.sqrt(total / len(given)))

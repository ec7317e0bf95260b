"""Key poses: where hands are at the instants of a skill that matter, seen from what matters.

A skill is cut where the robot comes to rest or turns back. At the end of each of these moves,
and where the demonstrations go another way than the interpolation, each link
has a key pose: the mean of the demonstrations, in the frame in which it differs least.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain, pairwise, product
from typing import Any

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

from tpgmm_evaluation.policies.aligned import Aligned
from tpgmm_torch import Demonstration, Frame, Hold, find_holds, quaternions
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.frames import LEVER
from tpgmm_torch.events import find_gripper_changes, find_stops
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.robots.robot import Robot

#: A move has begun, or ended, up to this share of its path; minimum-jerk motions are there
#: after this share of their time.
STILL, EDGE = 0.01, 0.1057
#: Shorter moves than this are none [s].
SHORTEST = 0.1
#: A link is rigid with what is held if it moves in it by no more than this [m].
RIGID = 0.01
#: The most key poses on the way of one move.
MOST = 12
#: Frames that are none of the objects: the robot's base; where an object was at first.
BASE, FIRST = "base", "@start"


@dataclass(frozen=True)
class KeyPose:
    """Where a link should be at one instant.

    Parameters
    ----------
    link : str
    frame : str
        ``"base"``, an object, or ``"OBJECT@start"``: where it was at first.
    pose : tuple of float
        x y z and w x y z, in the frame.
    held : str, optional
        The object that is meant to have the pose, with the link rigidly at it.
    """

    link: str
    frame: str
    pose: tuple[float, ...]
    held: str | None = None

    def target(self, frames: Mapping[str, Frame], link: Frame) -> Frame:
        """Compute the link's pose in the base frame, now.

        Parameters
        ----------
        frames : mapping of str to Frame
            Where the frames are seen.
        link : Frame
            Where the link is.
        """
        values = torch.tensor(self.pose, dtype=torch.float64)
        wanted = frames[self.frame].compose(Frame(values[:3], values[3:]))
        if self.held is None:
            return wanted
        return wanted.compose(link.seen_from(frames[self.held]))


@dataclass(frozen=True)
class Move:
    """A part of the skill from one rest to the next.

    Parameters
    ----------
    look, begin, arrive, end : int
        The steps at which objects are looked at, at which the motion begins, at which it is
        over, and at which the next one begins.
    steps : tuple of int
        After ``begin``, those of the key poses; the last is ``arrive``.
    poses : tuple of tuple of KeyPose
        At each of these, of each link.
    """

    look: int
    begin: int
    arrive: int
    end: int
    steps: tuple[int, ...]
    poses: tuple[tuple[KeyPose, ...], ...]

    def config(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return asdict(self)

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Move:
        """Make the move that gave this :meth:`config`."""
        poses = tuple(
            tuple(KeyPose(**{**pose, "pose": tuple(pose["pose"])}) for pose in at)
            for at in config["poses"]
        )
        return cls(**{**config, "steps": tuple(config["steps"]), "poses": poses})

    def targets(
        self,
        links: Mapping[str, Frame],
        frames: Mapping[str, Frame],
        first: Mapping[str, Frame],
    ) -> dict[str, list[Frame]]:
        """Compute the poses of each link in the base frame at ``steps``.

        Parameters
        ----------
        links : mapping of str to Frame
            Where the links are as the objects are seen.
        frames, first : mapping of str to Frame
            Where the objects are, and were at first.
        """
        known = {BASE: Frame(torch.zeros(3, dtype=torch.float64)), **frames}
        known |= {f"{name}{FIRST}": pose for name, pose in first.items()}
        targets: dict[str, list[Frame]] = {link: [] for link in links}
        for key in chain.from_iterable(self.poses):
            targets[key.link].append(key.target(known, links[key.link]))
        return targets


def minimum_jerk_path(
    start: Frame, poses: Sequence[Frame], steps: Sequence[int], at: Array
) -> Frame:
    """Interpolate poses by the smoothest path, at rest at both ends.

    Parameters
    ----------
    start : Frame
        At step 0.
    poses : sequence of Frame
        The others.
    steps : sequence of int
        When they are reached, increasing.
    at : ndarray of shape (n,)
        The steps at which the path is wanted.

    Returns
    -------
    Frame
        Of shape (n,). Positions are the quintic spline that minimises the integral of the
        squared jerk; so are rotation vectors from the first orientation.
    """
    knots = np.array([0, *steps], dtype=np.float64)
    positions = as_array(torch.stack([start.position, *(pose.position for pose in poses)]))
    back = quaternions.conjugate(start.orientation)
    turns = torch.stack([quaternions.product(pose.orientation, back) for pose in poses])
    vectors = np.vstack((np.zeros(3), as_array(_unwind(quaternions.log(turns)))))
    still = [(1, np.zeros(6)), (2, np.zeros(6))]
    columns = np.hstack((positions, vectors))
    spline = make_interp_spline(knots, columns, k=5, bc_type=(still, still))
    values = torch.from_numpy(spline(np.clip(at, 0, knots[-1])))
    turned = quaternions.product(quaternions.exp(values[:, 3:]), start.orientation)
    return Frame(values[:, :3], turned)


def _unwind(vectors: Tensor) -> Tensor:
    """Add whole turns to rotation vectors, so that each is nearest to the one before."""
    near = [vectors[0]]
    for vector in vectors[1:]:
        angle = float(vector.norm())
        if angle > 1e-9:
            axis = vector / angle
            turns = torch.round((near[-1] @ axis - angle) / (2 * torch.pi))
            vector = vector + 2 * torch.pi * turns * axis
        near.append(vector)
    return torch.stack(near)


def find_moves(aligned: Aligned, tolerance: float | None = 0.005) -> list[Move]:
    """Find the moves of a skill, with the key poses of all links.

    Parameters
    ----------
    aligned : Aligned
        Demonstrations, of a :class:`~tpgmm_torch.Robot`. With one alone, the nearest frame
        counts, and the robot's base only where there are no objects.
    tolerance : float, optional
        How far links may be from their path, in the mean of the demonstrations, before there
        is one more key pose on the way [m]; a radian counts as 0.2 m. None sets none.

    Raises
    ------
    DataError
        If the kinematics are no Robot with links, which inverse kinematics needs, or nothing
        moves.
    """
    if not isinstance(aligned.robot, Robot) or not aligned.robot.links:
        raise DataError(
            "key poses need the links of a tpgmm_torch.Robot, made from a URDF or an MJCF, "
            f"got {aligned.robot!r}"
        )
    moves = list(_Shown(aligned).moves(tolerance))
    if not moves:
        raise DataError("the mean of the demonstrations does not move: it has no key poses")
    return moves


class _Shown:
    """Links and frames in all demonstrations, at all steps."""

    def __init__(self, aligned: Aligned) -> None:
        self.fps, self.n = aligned.fps, len(aligned.demonstrations)
        self.mean = _mean(aligned)
        self.robot: Kinematics = aligned.robot
        demonstrations = aligned.demonstrations
        length = len(self.mean)
        states = [self.robot.state(d.joints) for d in demonstrations]
        self.links = {
            link: _stack([Frame(s.position(link), s.orientation(link)) for s in states])
            for link in self.robot.links
        }
        objects = {
            name: _stack([_at_all(d.frame(name), length) for d in demonstrations])
            for name in demonstrations[0].frames
        }
        self.objects = tuple(objects)
        base = Frame(torch.zeros(3, dtype=torch.float64)).expand((self.n, length))
        self.frames = {BASE: base, **objects}
        for name, pose in objects.items():
            self.frames[f"{name}{FIRST}"] = pose[:, :1].expand((self.n, length))
        self.holds: tuple[Hold, ...] = find_holds(demonstrations, self.robot)

    def moves(self, tolerance: float | None) -> Iterator[Move]:
        spans = list(self._spans())
        ends = [begin for begin, _ in spans[1:]] + [len(self.mean)]
        for number, ((begin, arrive), end) in enumerate(zip(spans, ends, strict=True)):
            steps = self._steps(begin, arrive, tolerance)
            poses = tuple(self._poses(begin, step) for step in steps)
            yield Move(begin if number else 0, begin, arrive, end, steps, poses)

    def _spans(self) -> Iterator[tuple[int, int]]:
        """Find from when to when the mean motion moves, between rests."""
        rests = [0.0, *(stop.time for stop in find_stops(self.mean, self.robot, dwell=0.0))]
        rests.append(float(self.mean.time[-1]))
        path = self._path()
        time = as_array(self.mean.time)
        for before, after in pairwise(rests):
            low, high = np.searchsorted(time, (before, after))
            part, seconds = path[low : high + 1], time[low : high + 1]
            if len(part) < 3 or part[-1] == part[0]:
                continue
            shares = (part - part[0]) / (part[-1] - part[0])
            first, last = np.interp((STILL, 1 - STILL), shares, seconds)
            margin = EDGE / (1 - 2 * EDGE) * (last - first)
            begin, arrive = max(before, first - margin), min(after, last + margin)
            if arrive - begin >= SHORTEST:
                yield round(begin * self.fps), round(arrive * self.fps)

    def _path(self) -> Array:
        """Measure the way of all links of the mean motion together up to each step [m]."""
        state = self.robot.state(self.mean.joints)
        columns = []
        for link in self.robot.links:
            turn = quaternions.continuous(state.orientation(link))
            columns += [as_array(state.position(link)), 2 * LEVER * as_array(turn)]
        moved = np.linalg.norm(np.diff(np.concatenate(columns, axis=1), axis=0), axis=1)
        # noise must not walk
        return np.concatenate(([0.0], np.cumsum(moved + 1e-12)))

    def _steps(self, begin: int, arrive: int, tolerance: float | None) -> tuple[int, ...]:
        """Place key poses at the end, at events, and where paths leave the demonstrations."""
        events = [*self.mean.events.values()]
        events += [change.time for change in find_gripper_changes(self.mean)]
        margin = round(SHORTEST * self.fps)
        steps = {round(at * self.fps) for at in events}
        steps = {s for s in steps if begin + margin < s < arrive - margin} | {arrive}
        while tolerance is not None and len(steps) <= MOST:
            deviation = self._deviation(begin, sorted(steps))
            deviation[self._neighbourhood(begin, steps, margin)] = 0.0
            worst = int(deviation.argmax())
            if deviation[worst] <= tolerance:
                break
            steps.add(begin + worst)
        return tuple(sorted(steps))

    @staticmethod
    def _neighbourhood(begin: int, steps: Iterable[int], margin: int) -> list[int]:
        """Return the rows, counted from ``begin``, near it or near a key pose."""
        last = max(steps)
        around = product((begin, *steps), range(-margin, margin + 1))
        return [step + by - begin for step, by in around if begin <= step + by <= last]

    def _deviation(self, begin: int, steps: Sequence[int]) -> Array:
        """Compute the mean distance of demonstrations from paths through their key poses.

        Of the links, that of the farthest.
        """
        rows = np.arange(steps[-1] - begin + 1, dtype=np.float64)
        ways = []
        for shown in self.links.values():
            apart: Array = np.zeros(len(rows))
            for i in range(self.n):
                poses = [shown[i, step] for step in steps]
                path = minimum_jerk_path(
                    shown[i, begin], poses, [step - begin for step in steps], rows
                )
                apart += as_array(_distance(path, shown[i, begin : steps[-1] + 1])) / self.n
            ways.append(apart)
        return np.max(ways, axis=0)

    def _poses(self, begin: int, step: int) -> tuple[KeyPose, ...]:
        """Choose for each link the frame in which its pose differs least."""
        chosen = []
        for link, shown in self.links.items():
            held = self._find_carried_objects(shown, begin, step)
            candidates: list[tuple[float, KeyPose]] = []
            for name, frame in self.frames.items():
                if name not in held:  # the hand stays with what it holds: no news
                    candidates.append(self._candidate(link, shown, name, frame, begin, step))
                for thing in held:
                    if name != thing:
                        pose = self.frames[thing]
                        candidates.append(
                            self._candidate(link, pose, name, frame, begin, step, thing)
                        )
            chosen.append(min(candidates, key=lambda pair: pair[0])[1])
        return tuple(chosen)

    def _find_carried_objects(self, shown: Frame, begin: int, step: int) -> list[str]:
        """Find the objects that a link carries from the beginning to a step."""
        times = [at / self.fps for at in (begin, step)]
        held = []
        for hold in self.holds:
            if hold.begin <= times[0] and times[1] <= hold.end:
                inner = shown.seen_from(self.frames[hold.frame])[:, begin : step + 1]
                moved = (inner.position - inner.position[:, :1]).norm(dim=-1)
                if float(moved.max(dim=1).values.median()) < RIGID:
                    held.append(hold.frame)
        return held

    def _candidate(
        self,
        link: str,
        shown: Frame,
        name: str,
        frame: Frame,
        begin: int,
        step: int,
        held: str | None = None,
    ) -> tuple[float, KeyPose]:
        """Compute the spread of a pose in a frame seen at the beginning, and its mean."""
        inner = shown[:, step].seen_from(frame[:, begin])
        mean = Frame(inner.position.mean(0), quaternions.mean(inner.orientation))
        spread = float(_distance(inner, mean.expand((self.n,))).square().mean())
        if self.n == 1:  # no spread: what is near counts, the base where nothing else is
            spread = float(inner.position.square().sum()) + (1e6 if name == BASE else 0.0)
        values = (*mean.position.tolist(), *mean.orientation.tolist())
        return spread, KeyPose(link, name, values, held)


def _distance(poses: Frame, others: Frame) -> Tensor:
    """Compute the distance of poses from others, turns included [m]."""
    turn = quaternions.product(quaternions.conjugate(poses.orientation), others.orientation)
    angle = quaternions.log(turn).norm(dim=-1)
    return (
        (poses.position - others.position).square().sum(-1) + (LEVER * angle).square()
    ).sqrt()


def _at_all(frame: Frame, length: int) -> Frame:
    return frame if frame.batch_shape else frame.expand((length,))


def _stack(frames: Sequence[Frame]) -> Frame:
    """Join N frames of shape (T,) to one of shape (N, T)."""
    return Frame(
        torch.stack([frame.position for frame in frames]),
        torch.stack([frame.orientation for frame in frames]),
    )


def _mean(aligned: Aligned) -> Demonstration:
    """Average the motions, and the events that all of them have."""
    first, *others = aligned.demonstrations
    shared = set(first.events).intersection(*(d.events for d in others))
    events = {
        name: float(np.mean([d.events[name] for d in (first, *others)])) for name in shared
    }
    return Demonstration(
        first.time, aligned.mean, joint_names=aligned.robot.joint_names, events=events
    )

"""Summary of the demonstrations of a model, and the distance of a situation from them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
import torch

from tpgmm_torch import quaternions
from tpgmm_torch.checks.report import Finding, shorten_list
from tpgmm_torch.checks.training import EpisodeSummary, PathSummary, differing
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import FEWEST
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.data.pose_names import quaternion_groups
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["TrainingSummary"]

#: Situations that differ by less are the same: [rad or m], [m], [rad].
ALIKE = {"start": 0.02, "place": 0.01, "turn": 0.05}
#: Where too few demonstrations show the spread, it is taken for this standard deviation.
SPREAD = {"start": 0.2, "place": 0.05, "turn": float(np.deg2rad(20.0))}
#: The unit of novelty is the distance of the furthest demonstration (1 is the edge of the
#: region of the others), but at least and at most this: demonstrations that hardly differ, and
#: one that is unlike the others, say little of how far new situations may be.
LIMITS = 0.5, 2.0
#: So many demonstrations, evenly chosen, are left out one at a time: more take long.
MOST_LEFT_OUT = 200
#: A situation is unlikely beyond this novelty: of generated situations like the demonstrations,
#: 2 % are with 3 to 6 demonstrations, and less than 0.1 % with 8 or more.
UNLIKELY = 1.5


@dataclass(frozen=True)
class Region:
    """Where new vectors like those of the demonstrations are expected.

    Parameters
    ----------
    mean : sequence of float
        Of shape (D,).
    covariance : sequence of sequence of float
        Of a new vector (D, D).
    """

    mean: Sequence[float]
    covariance: Sequence[Sequence[float]]

    def __post_init__(self) -> None:
        d = len(self.mean)
        _check_numbers(self, mean=(d,), covariance=(d, d) if d else (0,))
        matrix = np.reshape(self.covariance, (d, d))
        if d and (not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix)[0] <= 0):
            raise DataError("a covariance is not symmetric and positive definite")

    @classmethod
    def of(cls, vectors: Array, kind: str, fewest: int = FEWEST + 1) -> Self:
        """Estimate the region of vectors (N, D), of start postures, places or turns.

        The covariance S of N - 1 degrees of freedom is joined with D of a round one of the same
        size, so that directions in which few demonstrations do not differ are not taken for
        certain: ``(1 + 1/N) ((D s^2 I + (N - 1) S) / (D + N - 1) + a^2 I)``,
        ``s^2 = tr(S) / D``, a from ``ALIKE``. Of less than ``fewest`` vectors it is ``SPREAD``.
        """
        n, d = vectors.shape
        mean = vectors.mean(axis=0)
        if n < fewest:
            return cls(mean.tolist(), (SPREAD[kind] ** 2 * np.eye(d)).tolist())
        scatter = (vectors - mean).T @ (vectors - mean)  # (N - 1) S
        size = np.trace(scatter) / (n - 1)  # D s^2
        covariance = (size * np.eye(d) + scatter) / (d + n - 1) + ALIKE[kind] ** 2 * np.eye(d)
        return cls(mean.tolist(), ((1 + 1 / n) * covariance).tolist())

    def distance(self, vectors: Array) -> Array:
        """Compute the Mahalanobis distance of vectors (..., D), about 1 at the likely edge.

        ``sqrt(d^2 / (D + 2 sqrt(2 D)))``: d^2 of D numbers has about the mean D, and the
        standard deviation sqrt(2 D).
        """
        d = len(self.mean)
        offset = vectors - np.array(self.mean)
        precision = np.linalg.inv(np.array(self.covariance).reshape(d, d))
        squared = np.einsum("...i,ij,...j->...", offset, precision, offset)
        return np.asarray(np.sqrt(squared / (d + 2 * np.sqrt(2 * d))))


@dataclass(frozen=True)
class FrameSummary:
    """Poses of a frame in the demonstrations.

    Parameters
    ----------
    low, high : sequence of float
        Range of its position, x, y, z, at all times [m].
    orientation : sequence of float
        Mean of its first orientations (w, x, y, z).
    angle : float
        The largest angle between a first orientation and their mean [rad].
    place, turn : Region
        Of its first positions [m], and of the rotation vectors from ``orientation`` [rad].
    moves : bool
        Whether it moved in a demonstration: it counts where it is at the beginning.
    link : str or None
        The link of the robot that was there at the start of every demonstration: the frame of
        a new situation then follows from its start posture.
    at : str or None
        ``"LINK@EVENT"`` where it was not an object's pose but a link's in every demonstration.
    """

    low: Sequence[float]
    high: Sequence[float]
    orientation: Sequence[float]
    angle: float
    place: Region
    turn: Region
    moves: bool = False
    link: str | None = None
    at: str | None = None

    def __post_init__(self) -> None:
        _check_numbers(self, low=(3,), high=(3,), orientation=(4,), angle=())
        if not len(self.place.mean) == len(self.turn.mean) == 3 or type(self.moves) is not bool:
            raise DataError("a frame has a place and a turn of 3 numbers, and moves or not")
        if "@" not in ("@" if self.at is None else self.at):
            raise DataError(f"a frame is at LINK@EVENT, got {self.at!r:.60}")

    @classmethod
    def of(cls, paths: Sequence[PathSummary], links: Frames) -> Self:
        """Summarise the poses of a frame in all demonstrations.

        Parameters
        ----------
        paths : sequence of PathSummary
            One of each demonstration.
        links : mapping of str to Frame
            Poses of the robot's links at their starts.
        """
        first = _first_poses(paths)
        places, turns = as_array(first.position), as_array(first.orientation)
        # the eigenvector of sum q q^T: F. L. Markley et al., Averaging Quaternions,
        # Journal of Guidance, Control, and Dynamics 30 (2007), eq. (12)
        mean = np.linalg.eigh(turns.T @ turns)[1][:, -1]
        rotations = _rotation_vectors(mean, turns)
        recorded = any(path.recorded for path in paths)
        events = {path.at for path in paths}
        return cls(
            np.min([path.low for path in paths], axis=0).tolist(),
            np.max([path.high for path in paths], axis=0).tolist(),
            mean.tolist(),
            float(np.linalg.norm(rotations, axis=-1).max()),
            Region.of(places, "place"),
            Region.of(rotations, "turn"),
            any(path.moves for path in paths),
            None if recorded else next((n for n, p in links.items() if _same(p, first)), None),
            paths[0].at if len(events) == 1 else None,
        )

    def rotation_vectors(self, orientations: Array) -> Array:
        """Compute rotation vectors [rad] from the mean to orientations (..., 4)."""
        return _rotation_vectors(np.array(self.orientation), orientations)


@dataclass(frozen=True)
class TrainingSummary:
    """Start postures and frames of the demonstrations of a model, and the novelty of others.

    Parameters
    ----------
    n_demonstrations : int
        How many were learned from, at least 1.
    joint_names : tuple of str
        In the order of the model.
    start_low, start_high : sequence of float
        Range of the start postures [rad or m].
    compared : sequence of int
        Columns of the joints that are compared: those that are not parts of a quaternion.
    start : Region
        Of the compared joints of start postures [rad or m].
    limit : float
        The largest distance of a demonstration from the others, within 0.5 and 2: the unit of
        novelty.
    frames : mapping of str to FrameSummary
        Poses by the names of the frames.
    events : mapping of str to float
        Median times of events that all demonstrations have, as shares of the duration.
    postures : sequence of sequence of float
        Some of all demonstrations (P, n_joints), to find links that come near each other; empty
        in files that an earlier release wrote [rad or m].
    """

    n_demonstrations: int
    joint_names: tuple[str, ...]
    start_low: Sequence[float]
    start_high: Sequence[float]
    compared: Sequence[int]
    start: Region
    limit: float
    frames: Mapping[str, FrameSummary]
    events: Mapping[str, float]
    postures: Sequence[Sequence[float]] = ()

    def __repr__(self) -> str:
        return (
            f"TrainingSummary({self.n_demonstrations} demonstrations, "
            f"frames={sorted(self.frames)})"
        )

    def __post_init__(self) -> None:
        n, count = len(self.joint_names), self.n_demonstrations
        compared = sum(type(value) is int and 0 <= value < n for value in {*self.compared})
        _check_numbers(
            self,
            n_demonstrations=(),
            limit=(),
            start_low=(n,),
            start_high=(n,),
            compared=(compared,),
            postures=(len(self.postures), n) if self.postures else (0,),
        )
        if type(count) is not int or count < 1 or self.limit <= 0:
            raise DataError(f"there are {count} demonstrations, and the limit is {self.limit}")
        if len(self.start.mean) != compared:
            raise DataError(f"{len(self.start.mean)} joints are compared, not {compared}")
        if not all(0 <= at <= 1 for at in self.events.values()):
            raise DataError(f"events are shares of the duration, got {self.events}")

    @classmethod
    def of(cls, episodes: Sequence[EpisodeSummary], kinematics: Kinematics) -> Self:
        """Summarise demonstrations.

        Parameters
        ----------
        episodes : sequence of EpisodeSummary
            With their joints in the order of the kinematics.
        kinematics : Kinematics
            Of the model.
        """
        starts = np.stack([episode.start for episode in episodes])
        state = kinematics.state(starts)
        links = {link: state.pose(link) for link in kinematics.links}
        compared = _compared_joints(kinematics)
        vectors, frames = [("start", starts[:, compared])], dict[str, FrameSummary]()
        for name in episodes[0].frames:
            paths = [episode.frames[name] for episode in episodes]
            first, frames[name] = _first_poses(paths), FrameSummary.of(paths, links)
            rotations = frames[name].rotation_vectors(as_array(first.orientation))
            vectors += [("place", as_array(first.position)), ("turn", rotations)]
        return cls(
            len(episodes),
            tuple(kinematics.joint_names),
            starts.min(axis=0).tolist(),
            starts.max(axis=0).tolist(),
            compared,
            Region.of(starts[:, compared], "start"),
            _largest_distance(vectors),
            frames,
            _median_events(episodes),
            differing(np.concatenate([one.postures for one in episodes])).round(4).tolist(),
        )

    def novelty(self, joints: Any = None, frames: Frames | None = None) -> Array:
        """Measure the distance from the demonstrations, in units of the furthest of these.

        It is the 4-norm of the distances of the start posture, of each frame's position and of
        each frame's orientation from their regions, there where the skill begins, divided by
        ``limit``, the largest such distance of a demonstration from the region of the others,
        within 0.5 and 2: one that is unlike the others does not make all situations likely.
        Of N + 1 situations of one kind the new one is the furthest with the chance 1 / (N + 1):
        about so often, or less, novelty is above 1 for what is like the demonstrations.

        Parameters
        ----------
        joints : array-like of shape (..., n_joints), optional
            Start postures; one with NaN does not count.
        frames : mapping of str to Frame, optional
            Of shapes that broadcast with the joints, where the skill begins; those that were
            not in the demonstrations do not count.

        Returns
        -------
        array of shape (...)
            From 0 on.
        """
        return _norm(self._distances(joints, frames or {}).values()) / self.limit

    def start_frames(
        self, joints: Any, kinematics: Kinematics, given: Collection[str] = ()
    ) -> dict[str, Frame]:
        """Compute the frames that follow from a start posture: poses of links.

        Parameters
        ----------
        joints : array-like of shape (..., n_joints)
            Start postures.
        kinematics : Kinematics
            Of the model.
        given : collection of str
            Frames that are known.

        Returns
        -------
        dict of str to Frame
            Of shape (...).
        """
        links = {
            name: frame.link
            for name, frame in self.frames.items()
            if frame.link is not None and name not in given
        }
        if not links:
            return {}
        state = kinematics.state(joints)
        return {name: state.pose(link) for name, link in links.items()}

    def findings(self, joints: Any, frames: Frames, label: str = "") -> list[Finding]:
        """Name the coordinates of one situation that make it unlike the demonstrations.

        Parameters
        ----------
        joints : array-like of shape (n_joints,), or None
            The start posture.
        frames : mapping of str to Frame
            Each one pose.
        label : str, default=""
            Before each name in the messages, for example ``"situation 2, "``.

        Returns
        -------
        list of Finding
            Empty where the novelty is at most 1.5.
        """
        distances = self._distances(joints, frames)
        ratios = {key: float(value) / self.limit for key, value in distances.items()}
        if not _norm(distances.values()) > UNLIKELY * self.limit:
            return []
        least = min(UNLIKELY, max(ratios.values()))
        describe = {"start": self._start, "place": self._place, "turn": self._turn}
        found = []
        for (kind, name), ratio in ratios.items():
            if ratio >= least:
                value = joints if kind == "start" else frames[name]
                message, remedy, names = describe[kind](name, value)
                text = f"{label}{message}"
                found.append(Finding(kind, text, remedy, names or (name,), value=ratio))
        return found

    def config(self) -> dict[str, Any]:
        """Describe all of it, ready for JSON."""
        return asdict(self) | {"joint_names": list(self.joint_names)}

    @classmethod
    def from_config(cls, config: Mapping[str, Any], kinematics: Kinematics) -> Self:
        """Invert :meth:`config`, for a model of these kinematics.

        Raises
        ------
        DataError
            If a field is missing or unknown, is of another type or shape, or is no such number.
        """
        try:
            fields = dict(config)
            fields["joint_names"] = tuple(fields["joint_names"])
            fields["start"] = Region(**fields["start"])
            fields["frames"] = {
                name: FrameSummary(**frame | {k: Region(**frame[k]) for k in ("place", "turn")})
                for name, frame in fields["frames"].items()
            }
            summary = cls(**fields)
            linked = {frame.link for frame in summary.frames.values()} - {None}
            if summary.joint_names != tuple(kinematics.joint_names):
                raise DataError(f"joint_names are not {kinematics.joint_names}")
            if not linked <= {*kinematics.links}:
                raise DataError(f"links {linked} are not among {kinematics.links}")
        except (AttributeError, DataError, KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"the summary of the demonstrations is damaged: {error!r:.200}"
            ) from error
        return summary

    def _distances(self, joints: Any, frames: Frames) -> dict[tuple[str, str], Array]:
        """Compute distances (...) of situations from each region, by its kind and frame."""
        found: dict[tuple[str, str], Array] = {}
        if joints is not None and len(self.compared):
            found["start", ""] = self.start.distance(_rows(joints)[..., list(self.compared)])
        for name, frame in frames.items():
            if name in self.frames:
                known = self.frames[name]
                found["place", name] = known.place.distance(as_array(frame.position))
                turn = known.rotation_vectors(as_array(frame.orientation))
                found["turn", name] = known.turn.distance(turn)
        return found

    def _start(self, _: str, joints: Any) -> tuple[str, str, tuple[str, ...]]:
        bounds = np.stack((self.start_low, self.start_high, _rows(joints)))[:, self.compared]
        low, high, values = bounds
        names = [self.joint_names[i] for i in self.compared]
        outside, odd = _outside(names, low, high, values)
        remedy = (
            "Is it in radians and in the order of the model's joint_names? Start nearer, or "
            "show the skill from there"
        )
        return f"start posture: {outside} rad (or m)", remedy, odd

    def _place(self, name: str, frame: Frame) -> tuple[str, str, tuple[str, ...]]:
        low, high = np.array(self.frames[name].low), np.array(self.frames[name].high)
        outside, _ = _outside("xyz", low, high, as_array(frame.position))
        remedy = "Is it in metres, in the same base frame? Else show the skill there too"
        return f"{name}: {outside} m", remedy, ()

    def _turn(self, name: str, frame: Frame) -> tuple[str, str, tuple[str, ...]]:
        known, orientation = self.frames[name], as_array(frame.orientation)
        angle = np.linalg.norm(known.rotation_vectors(orientation))
        swapped = known.rotation_vectors(np.roll(orientation, 1))  # as if it were (x, y, z, w)
        remedy = "Is the quaternion (w, x, y, z)? Else show the skill so too"
        if known.turn.distance(swapped) <= UNLIKELY * self.limit:
            remedy = "Read as (x, y, z, w) it would fit: quaternions are (w, x, y, z)"
        if known.at is not None:
            remedy = (
                f"It was the pose of {known.at.replace('@', ' at ')} in the demonstrations: "
                "give where that is to be, and not an object's pose; or learn the object's, "
                f"LinkPose(..., offset=Frame(...)) (--frame {name}={known.at}+X,Y,Z,YAW)"
            )
        degrees = f"{np.rad2deg(angle):.0f} deg from the mean, shown up to "
        return f"{name}: turned by {degrees}{np.rad2deg(known.angle):.0f}", remedy, ()


def _compared_joints(kinematics: Kinematics) -> list[int]:
    """List the columns of the joints that are no parts of a quaternion."""
    turns = [
        *(range(first, first + 4) for first in kinematics.quaternion_starts),
        *quaternion_groups(kinematics.joint_names),
    ]
    return np.setdiff1d(range(kinematics.n_joints), np.ravel(turns)).tolist()


def _median_events(episodes: Sequence[EpisodeSummary]) -> dict[str, float]:
    """Compute median times of the events that all demonstrations have."""
    return {
        name: float(np.median([episode.events[name] for episode in episodes]))
        for name in episodes[0].events
        if all(name in episode.events for episode in episodes)
    }


def _largest_distance(vectors: Sequence[tuple[str, Array]]) -> float:
    """Compute the largest distance of a demonstration from the regions of the others."""
    n = len(vectors[0][1])
    if n <= FEWEST:
        return 1.0
    tried = np.unique(np.linspace(0, n - 1, min(n, MOST_LEFT_OUT)).round().astype(int))
    distances = [
        _norm(
            Region.of(np.delete(given, i, axis=0), kind, FEWEST).distance(given[i])
            for kind, given in vectors
            if given.shape[1]
        )
        for i in tried
    ]
    return float(np.clip(max(distances), *LIMITS))


def _norm(distances: Iterable[Array]) -> Array:
    """Compute the 4-norm of distances that broadcast; NaN does not count.

    It is nearly the largest, and more where several are large.
    """
    total = np.zeros(())
    for distance in distances:
        total = total + np.where(np.isnan(distance), 0.0, distance) ** 4
    return np.asarray(total ** (1 / 4))


def _rows(joints: Any) -> Array:
    return as_array(torch.as_tensor(joints))


def _same(pose: Frame, other: Frame) -> bool:
    """Check whether poses (N,) are equal up to rounding."""
    other = other.to(pose.position)
    turn = quaternions.match_hemisphere(other.orientation, pose.orientation)
    differences = as_array(pose.position - other.position), as_array(pose.orientation - turn)
    rounding = 1e2 * np.finfo(np.float32).eps  # of positions of about a metre, and of 1
    return all(bool((np.abs(one) < rounding).all()) for one in differences)


def _outside(
    names: Sequence[str], low: Array, high: Array, values: Array
) -> tuple[str, tuple[str, ...]]:
    """Describe and name the coordinates that are outside a range, the furthest first."""
    excess = np.maximum(low - values, values - high)
    odd = [i for i in np.argsort(-excess) if excess[i] > 0]
    places = [f"{names[i]} = {values[i]:.4g}, shown {low[i]:.4g} to {high[i]:.4g}" for i in odd]
    beside = f"beside those shown, at {', '.join(f'{x:.3g}' for x in values)}"
    return shorten_list(places) or beside, tuple(names[i] for i in odd)


def _first_poses(paths: Sequence[PathSummary]) -> Frame:
    """Collect the first pose of a frame in each demonstration, (N,)."""
    positions = np.stack([path.position for path in paths])
    return Frame(positions, np.stack([path.orientation for path in paths]))


def _rotation_vectors(mean: Array, orientations: Array) -> Array:
    turns = quaternions.product(
        quaternions.conjugate(torch.from_numpy(mean)), torch.from_numpy(np.array(orientations))
    )
    return as_array(quaternions.log(turns))


def _check_numbers(thing: Any, **shapes: tuple[int, ...]) -> None:
    """Refuse fields that are no finite numbers of these shapes."""
    for name, shape in shapes.items():
        array = np.asarray(getattr(thing, name))
        numeric = array.dtype.kind in "iuf" or not array.size
        if not numeric or array.shape != shape or not np.isfinite(array).all():
            raise DataError(f"{name} is {str(getattr(thing, name))[:60]}")

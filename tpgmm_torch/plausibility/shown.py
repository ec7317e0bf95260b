"""What a model has seen, and how far a situation is from it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Self

import numpy as np
from scipy.special import fdtri

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.novelty import Novelty
from tpgmm_torch.plausibility.findings import Finding, listed
from tpgmm_torch.plausibility.poses import angles_to, mean_orientation, other_order
from tpgmm_torch.plausibility.summaries import (
    EpisodeSummary,
    PoseSummary,
    poses_among,
    quaternion_columns,
)
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["Shown", "ShownFrame"]

#: Chance that one coordinate of a situation like those shown is called unlike them.
CHANCE = 0.002
#: With few demonstrations, no further than this many of the ranges shown.
MOST_RANGES = 3.0
#: What is not further outside than this is near enough [m], [rad], [rad or m].
NEAR, LIKE, POSTURE = 0.05, float(np.deg2rad(20.0)), 0.5
#: Objects on a line or a table are not exactly so [m].
FLAT = 0.02
#: Fewer demonstrations say nothing about which coordinates go together.
FEWEST = 6
AXES = "xyz"
#: A frame that is a link's pose at the start is so up to rounding, that of float32 too.
ROUNDING = 1e-5
#: What moves by less stands still [m], [rad].
STILL, STILL_ANGLE = 0.02, 0.1


@dataclass(frozen=True)
class ShownFrame:
    """Where a frame was, at the beginning of the demonstrations and on its way.

    Parameters
    ----------
    low, high : sequence of float
        Range of its position, x, y, z, over all of the time [m].
    mean : sequence of float
        Of its first positions [m].
    covariance : sequence of sequence of float
        Of the same [m^2].
    orientation : sequence of float
        Mean of its first orientations (w, x, y, z).
    angle : float
        How far one of them was turned from there, at most [rad].
    link : str or None
        The link of the robot that was there at the start of every demonstration: the frame of
        a new situation then follows from its start posture.
    """

    low: Sequence[float]
    high: Sequence[float]
    mean: Sequence[float]
    covariance: Sequence[Sequence[float]]
    orientation: Sequence[float]
    angle: float
    link: str | None = None


@dataclass(frozen=True)
class Shown:
    """What a model was shown: enough to tell how far a situation is from it.

    Parameters
    ----------
    n_demonstrations : int
    joint_names : tuple of str
    start_low, start_high : sequence of float
        Range of the start postures [rad or m].
    compared : sequence of bool
        Which joints are compared: not those that are parts of a quaternion.
    frames : mapping of str to ShownFrame
    novelty : Novelty, optional
        Tells how new a situation is; None in what versions before this one kept.
    events : mapping of str to float
        When what all demonstrations name happens, the median, as shares of the duration.
    """

    n_demonstrations: int
    joint_names: tuple[str, ...]
    start_low: Sequence[float]
    start_high: Sequence[float]
    compared: Sequence[bool]
    frames: Mapping[str, ShownFrame]
    novelty: Novelty | None = None
    events: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Shown({self.n_demonstrations} demonstrations, frames={sorted(self.frames)})"

    @classmethod
    def of(cls, episodes: Sequence[EpisodeSummary], kinematics: Kinematics) -> Self:
        """Summarise demonstrations.

        Parameters
        ----------
        episodes : sequence of EpisodeSummary
            With their joints in the order of the kinematics.
        kinematics : Kinematics
        """
        starts = np.stack([e.path[0] for e in episodes])
        state = kinematics.state(starts)
        links = {
            link: (as_array(state.position(link)), as_array(state.orientation(link)))
            for link in kinematics.links
        }
        frames, first_poses, moving = {}, {}, []
        ways = {name: [e.frames[name] for e in episodes] for name in episodes[0].frames}
        for name, poses in ways.items():
            every = np.concatenate([pose.positions for pose in poses])
            first = np.stack([pose.positions[0] for pose in poses])
            turns = np.stack([pose.orientations[0] for pose in poses])
            mean = mean_orientation(turns)
            covariance = np.cov(first.T) if len(first) > 1 else np.zeros((3, 3))
            first_poses[name] = first, turns, mean
            if any(_moves(pose) for pose in poses):
                moving.append(name)
            still = all(len(pose.positions) == 1 for pose in poses)
            same = [link for link, pose in links.items() if _same(pose, (first, turns))]
            frames[name] = ShownFrame(
                every.min(axis=0).tolist(),
                every.max(axis=0).tolist(),
                first.mean(axis=0).tolist(),
                covariance.tolist(),
                mean.tolist(),
                float(angles_to(turns, mean).max()),
                same[0] if still and same else None,
            )
        names, width = kinematics.joint_names, kinematics.n_joints
        compared = ~quaternion_columns(names, width, kinematics.quaternion_starts)
        return cls(
            len(episodes),
            tuple(names),
            starts.min(axis=0).tolist(),
            starts.max(axis=0).tolist(),
            compared.tolist(),
            frames,
            Novelty.of(starts, compared, first_poses, moving),
            {
                name: float(np.median([e.events[name] for e in episodes]))
                for name in episodes[0].events
                if all(name in e.events for e in episodes)
            },
        )

    def and_also(self, other: Shown) -> Shown:
        """What was shown, by demonstrations that came first and by ``other``, later ones."""
        share = other.n_demonstrations / (self.n_demonstrations + other.n_demonstrations)
        frames = {}
        for name, one in self.frames.items():
            two = other.frames.get(name, one)
            mean, more = np.array(one.mean), np.array(two.mean)
            away = more - mean
            covariance = (1 - share) * np.array(one.covariance) + share * (
                np.array(two.covariance) + (1 - share) * np.outer(away, away)
            )
            centre = np.array(one.orientation)
            turned = float(angles_to(np.array([two.orientation]), centre).max()) + two.angle
            frames[name] = ShownFrame(
                np.minimum(one.low, two.low).tolist(),
                np.maximum(one.high, two.high).tolist(),
                (mean + share * away).tolist(),
                covariance.tolist(),
                one.orientation,
                max(one.angle, turned),
                one.link if one.link == two.link else None,
            )
        return replace(
            self,
            n_demonstrations=self.n_demonstrations + other.n_demonstrations,
            start_low=np.minimum(self.start_low, other.start_low).tolist(),
            start_high=np.maximum(self.start_high, other.start_high).tolist(),
            frames=frames,
        )

    def config(self) -> dict[str, Any]:
        """All of it, ready for JSON."""
        return asdict(self) | {"joint_names": list(self.joint_names)}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`config`.

        Raises
        ------
        DataError
            If it does not fit together.
        """
        try:
            fields = dict(config)
            fields["joint_names"] = tuple(fields["joint_names"])
            fields["frames"] = {n: ShownFrame(**f) for n, f in fields["frames"].items()}
            if fields.get("novelty") is not None:
                fields["novelty"] = Novelty.from_config(fields["novelty"])
            shown = cls(**fields)
            n = len(shown.joint_names)
            shapes = [np.shape(shown.start_low), np.shape(shown.start_high)]
            shapes += [np.shape(shown.compared)]
            fits = all(shape == (n,) for shape in shapes) and all(
                np.shape(f.low) == np.shape(f.high) == np.shape(f.mean) == (3,)
                and np.shape(f.covariance) == (3, 3)
                and np.shape(f.orientation) == (4,)
                for f in shown.frames.values()
            )
            fits = fits and all(0 <= at <= 1 for at in shown.events.values())
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise DataError(f"this does not describe what was shown: {error!r}") from error
        if not fits:
            raise DataError("what was shown does not fit together: shapes differ")
        return shown

    @property
    def ranges(self) -> float:
        """How far outside, in ranges, a coordinate like those shown hardly ever is.

        The ranges of N numbers of one uniform law, however wide, are exceeded at one end by
        more than r of themselves with the chance ``(1 + r)^(1 - N) / (N + 1)``.
        """
        n = self.n_demonstrations
        if n == 1:
            return MOST_RANGES
        return float(min(MOST_RANGES, (CHANCE * (n + 1)) ** (-1 / (n - 1)) - 1))

    def start_frames(
        self, joints: Any, kinematics: Kinematics, given: Collection[str] = ()
    ) -> dict[str, Frame]:
        """The frames that follow from a start posture: where a link is then.

        Parameters
        ----------
        joints : array-like of shape (..., n_joints)
            Start postures.
        kinematics : Kinematics
        given : collection of str
            Frames that are not wanted.

        Returns
        -------
        dict of str to Frame
            Of shape (...).
        """
        links = {name: f.link for name, f in self.frames.items() if name not in given}
        wanted = {name: link for name, link in links.items() if link is not None}
        if not wanted:
            return {}
        state = kinematics.state(joints)
        return {n: Frame(state.position(x), state.orientation(x)) for n, x in wanted.items()}

    def distance(self, joints: Any = None, frames: Mapping[str, Frame] | None = None) -> Array:
        """How far a state is from those that demonstrations began in; 1 is the limit.

        Parameters
        ----------
        joints : array-like of shape (..., n_joints), optional
        frames : mapping of str to Frame, optional
            Of shapes that broadcast with the joints; those that were not shown do not count.

        Returns
        -------
        array of shape (...)
            The largest, over all coordinates, of how far it is outside what was shown as a
            share of what is plausible, and of its Mahalanobis distance: above 1 it is
            implausible.
        """
        found: list[Array] = [np.zeros(())]
        if joints is not None:
            found.append(self._posture(_array(joints)).max(axis=-1, initial=0))
        for name, frame in poses_among(frames or {}).items():
            if name in self.frames:
                shown = self.frames[name]
                position, orientation = as_array(frame.position), as_array(frame.orientation)
                found += [
                    self._place(shown, position).max(axis=-1, initial=0),
                    self._turn(shown, orientation),
                    self._together(shown, position),
                ]
        largest = found[0]
        for one in found[1:]:
            largest = np.maximum(largest, one)
        return largest

    def findings(
        self, joints: Any, frames: Mapping[str, Frame], label: str = ""
    ) -> list[Finding]:
        """Name what is implausible about one situation, per coordinate.

        Parameters
        ----------
        joints : array-like of shape (n_joints,), or None
            The start posture.
        frames : mapping of str to Frame
            Each one pose, or one per time step.
        label : str, default=""
            What comes before each name in the messages, for example ``"situation 2, "``.
        """
        poses = poses_among(frames)
        return [
            *([] if joints is None else self._posture_findings(_array(joints), label)),
            *(
                finding
                for name, shown in self.frames.items()
                if name in poses
                for finding in self._frame_findings(name, shown, poses[name], label)
            ),
        ]

    def _posture_findings(self, joints: Array, label: str) -> list[Finding]:
        scores = self._posture(joints)
        odd = [int(j) for j in np.argsort(-scores) if scores[j] > 1]
        if not odd:
            return []
        places = [
            f"{self.joint_names[j]} = {joints[j]:.4g}, shown {self.start_low[j]:.4g} to "
            f"{self.start_high[j]:.4g}"
            for j in odd
        ]
        return [
            Finding(
                "start",
                "unlikely",
                f"{label}start posture: {listed(places)} rad (or m)",
                "Is it in radians and in the order of the model's joint_names? Start nearer, "
                "or show the skill from there",
                tuple(self.joint_names[j] for j in odd),
                value=float(scores[odd[0]]),
            )
        ]

    def _frame_findings(
        self, name: str, shown: ShownFrame, frame: Frame, label: str
    ) -> list[Finding]:
        positions = np.atleast_2d(as_array(frame.position))
        orientation = np.atleast_2d(as_array(frame.orientation))[0]
        scores = self._place(shown, positions)
        worst = scores.argmax(axis=0)
        remedy = "Is it in metres, in the same base frame? Else show the skill there too"
        places = [
            f"{name}: {axis} = {positions[worst[i], i]:.4g} m, shown {shown.low[i]:.4g} to "
            f"{shown.high[i]:.4g}"
            for i, axis in enumerate(AXES)
            if scores[worst[i], i] > 1
        ]
        found = []
        if places:
            found.append(
                Finding(
                    "place",
                    "unlikely",
                    f"{label}{'; '.join(places)}",
                    remedy,
                    (name,),
                    value=float(scores.max()),
                )
            )
        elif (score := float(self._together(shown, positions[0]))) > 1:
            at = ", ".join(f"{x:.3g}" for x in positions[0])
            found.append(
                Finding(
                    "place",
                    "unlikely",
                    f"{label}{name}: ({at}) m lies beside the places shown, at {score:.2g} "
                    "times the plausible Mahalanobis distance",
                    remedy,
                    (name,),
                    value=score,
                )
            )
        if (turn := float(self._turn(shown, orientation))) > 1:
            angle = angles_to(orientation, np.array(shown.orientation))
            swapped = float(self._turn(shown, other_order(orientation))) <= 1
            found.append(
                Finding(
                    "turn",
                    "unlikely",
                    f"{label}{name}: turned by {np.rad2deg(angle):.0f} deg from the mean, "
                    f"shown up to {np.rad2deg(shown.angle):.0f}",
                    "Read as (x, y, z, w) it would fit: quaternions are (w, x, y, z)"
                    if swapped
                    else "Is the quaternion (w, x, y, z)? Else show the skill so too",
                    (name,),
                    value=turn,
                )
            )
        return found

    def _posture(self, joints: Array) -> Array:
        low, high = np.array(self.start_low), np.array(self.start_high)
        scores: Array = self._outside(joints, low, high, POSTURE) * np.array(self.compared)
        return scores

    def _place(self, shown: ShownFrame, positions: Array) -> Array:
        return self._outside(positions, np.array(shown.low), np.array(shown.high), NEAR)

    def _outside(self, values: Array, low: Array, high: Array, floor: float) -> Array:
        """How far values are outside, as shares of what is plausible."""
        excess = np.maximum(np.maximum(low - values, values - high), 0)
        share: Array = excess / np.maximum(floor, self.ranges * (high - low))
        return share

    def _turn(self, shown: ShownFrame, orientation: Array) -> Array:
        excess = angles_to(orientation, np.array(shown.orientation)) - shown.angle
        share: Array = np.maximum(excess, 0) / max(LIKE, self.ranges * shown.angle)
        return share

    def _together(self, shown: ShownFrame, positions: Array) -> Array:
        """Mahalanobis distance of places, as a share of Hotelling's limit for a new one."""
        n, d = self.n_demonstrations, 3
        if n < FEWEST:
            return np.zeros(positions.shape[:-1])
        # T^2 = (p - m)' ((1 + 1/n) S)^-1 (p - m) ~ d (n - 1) / (n - d) F(d, n - d)
        limit = d * (n - 1) / (n - d) * fdtri(d, n - d, 1 - CHANCE)
        covariance = (1 + 1 / n) * np.array(shown.covariance) + FLAT**2 * np.eye(d)
        apart = positions - np.array(shown.mean)
        squared = np.einsum("...i,ij,...j->...", apart, np.linalg.inv(covariance), apart)
        share: Array = np.sqrt(squared / limit)
        return share


def _array(values: Any) -> Array:
    return as_array(values) if hasattr(values, "detach") else np.asarray(values, np.float64)


def _moves(pose: PoseSummary) -> bool:
    """Whether a frame moves by more than a tracker's noise."""
    away = np.linalg.norm(pose.positions - pose.positions[0], axis=-1)
    turned = angles_to(pose.orientations, pose.orientations[0])
    return bool((away > STILL).any() or (turned > STILL_ANGLE).any())


def _same(pose: tuple[Array, Array], other: tuple[Array, Array]) -> bool:
    """Whether two poses, of positions (N, 3) and orientations (N, 4), are equal."""
    (position, turn), (there, turned) = pose, other
    sign = np.sign((turn * turned).sum(axis=-1, keepdims=True))
    return bool(
        (np.abs(position - there) < ROUNDING).all()
        and (np.abs(turn - sign * turned) < ROUNDING).all()
    )

"""How new a situation is to a model, in units of how much its demonstrations differ."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch import quaternions
from tpgmm_torch.data.affine import Affine
from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError

__all__ = ["Novelty", "Region"]

#: What two situations may differ by and still be the same: [rad or m], [m], [rad].
ALIKE = {"start": 0.02, "place": 0.01, "turn": 0.05}
#: With fewer demonstrations than FEWEST, one standard deviation of what is like them.
UNKNOWN = {"start": 0.2, "place": 0.05, "turn": float(np.deg2rad(20.0))}
FEWEST = 3
#: The furthest of many that are alike is at least so far: what differs less has no meaning.
LEAST = 0.5
#: So many demonstrations, evenly chosen, say how far one is from the others.
MOST = 200
#: Of the norm that joins distances: nearly the largest, and more where several are large.
POWER = 4


@dataclass(frozen=True)
class Region:
    """Where new vectors like those shown are expected.

    Parameters
    ----------
    mean : sequence of float
        Of shape (D,).
    covariance : sequence of sequence of float
        Of a new vector (D, D).
    """

    mean: Sequence[float]
    covariance: Sequence[Sequence[float]]

    @classmethod
    def of(cls, vectors: Array, kind: str) -> Self:
        """Estimate a region from two or more vectors (N, D).

        The covariance S of N - 1 degrees of freedom is joined with D of a round one of the same
        size, so that directions in which few demonstrations do not differ are not taken for
        certain: ``(1 + 1/N) ((D s^2 I + (N - 1) S) / (D + N - 1) + a^2 I)``,
        ``s^2 = tr(S) / D``, a from ``ALIKE``.
        """
        n, d = vectors.shape
        apart = vectors - vectors.mean(axis=0)
        spread = apart.T @ apart  # (N - 1) S
        size = np.trace(spread) / (n - 1)  # D s^2
        covariance = (size * np.eye(d) + spread) / (d + n - 1) + ALIKE[kind] ** 2 * np.eye(d)
        return cls(vectors.mean(axis=0).tolist(), ((1 + 1 / n) * covariance).tolist())

    @classmethod
    def unknown(cls, vectors: Array, kind: str) -> Self:
        """Around vectors (N, D) too few to tell how much they differ: ``UNKNOWN``."""
        covariance = UNKNOWN[kind] ** 2 * np.eye(vectors.shape[1])
        return cls(vectors.mean(axis=0).tolist(), covariance.tolist())

    def distance(self, vectors: Array) -> Array:
        """Mahalanobis distance of vectors (..., D), about 1 at the edge of the likely.

        ``sqrt(d^2 / (D + 2 sqrt(2 D)))``: d^2 of D numbers has about the mean D, and the
        standard deviation sqrt(2 D).
        """
        d = len(self.mean)
        apart = vectors - np.array(self.mean)
        precision = np.linalg.inv(np.array(self.covariance))
        squared = np.einsum("...i,ij,...j->...", apart, precision, apart)
        distance: Array = np.sqrt(squared / (d + 2 * np.sqrt(2 * d)))
        return distance


@dataclass(frozen=True)
class Novelty:
    """Tells how new a situation is: its distance from those shown, calibrated on these.

    The distance is the 4-norm of those of the start posture, of each frame's position and of
    each frame's orientation, there where the skill begins: nearly the largest, and more where
    several are unusual. Leaving out one demonstration after another tells how far each is from
    the others; novelty is the distance in units of the largest of these. Of N + 1 situations of
    one kind the new one is the furthest with the chance 1 / (N + 1): about so often, or less,
    novelty is above 1 for what is like the demonstrations. Less, as those left out are compared
    with one demonstration fewer than a new situation is.

    Parameters
    ----------
    limit : float
        The largest distance of a demonstration from the others.
    compared : sequence of int
        The joints that count: not those that are parts of a quaternion.
    start : Region
        Of start postures [rad or m].
    places, turns : mapping of str to Region
        Of each frame's position [m], and of its rotation vector from ``orientations`` [rad].
    orientations : mapping of str to sequence of float
        Mean orientation of each frame (w, x, y, z).
    moving : sequence of str
        Frames that moved in a demonstration: these count where they are at the beginning.
    """

    limit: float
    compared: Sequence[int]
    start: Region
    places: Mapping[str, Region] = field(default_factory=dict)
    turns: Mapping[str, Region] = field(default_factory=dict)
    orientations: Mapping[str, Sequence[float]] = field(default_factory=dict)
    moving: Sequence[str] = ()

    @classmethod
    def of(
        cls,
        starts: Array,
        compared: NDArray[np.bool_],
        frames: Mapping[str, tuple[Array, Array, Array]],
        moving: Sequence[str] = (),
    ) -> Self:
        """Calibrate on demonstrations.

        Parameters
        ----------
        starts : array of shape (N, n_joints)
            Start postures.
        compared : array of shape (n_joints,)
            Whether a joint counts.
        frames : mapping of str to (array of shape (N, 3), of shape (N, 4), of shape (4,))
            First positions and orientations of each frame, and the mean of these.
        moving : sequence of str
            Frames that moved in a demonstration.
        """
        joints = np.flatnonzero(compared)
        data = {("start", ""): starts[:, joints]}
        for name, (positions, turns, mean) in frames.items():
            data["place", name] = positions
            data["turn", name] = _rotation_vectors(turns, mean)
        limit, n = 1.0, len(starts)
        estimate = Region.unknown if n < FEWEST else Region.of
        regions = {(kind, name): estimate(v, kind) for (kind, name), v in data.items()}
        if n >= FEWEST:
            tried = np.unique(np.linspace(0, n - 1, min(n, MOST)).round().astype(int))
            limit = max(LEAST, *(_distance_from_others(data, int(i)) for i in tried))
        return cls(
            limit,
            joints.tolist(),
            regions["start", ""],
            {name: regions["place", name] for name in frames},
            {name: regions["turn", name] for name in frames},
            {name: mean.tolist() for name, (_, _, mean) in frames.items()},
            list(moving),
        )

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """From what ``dataclasses.asdict`` gives, through JSON too.

        Raises
        ------
        DataError
            If it does not fit together.
        """
        try:
            fields = dict(config)
            fields["start"] = Region(**fields["start"])
            for kind in ("places", "turns"):
                fields[kind] = {name: Region(**one) for name, one in fields[kind].items()}
            novelty = cls(**fields)
            shapes = [(novelty.start, len(novelty.compared))]
            for regions in (novelty.places, novelty.turns):
                shapes += [(regions[name], 3) for name in novelty.orientations]
            fits = novelty.limit > 0 and all(
                np.shape(one.mean) == (d,) and np.shape(one.covariance) == (d, d)
                for one, d in shapes
                if d
            )
            fits &= all(np.shape(q) == (4,) for q in novelty.orientations.values())
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise DataError(f"this does not describe what is new: {error!r}") from error
        if not fits:
            raise DataError("what tells what is new does not fit together: shapes differ")
        return novelty

    def ratio(self, joints: Any = None, frames: Mapping[str, Frame] | None = None) -> Array:
        """Novelty of situations: 1 is that of the least usual demonstration.

        Parameters
        ----------
        joints : array-like of shape (..., n_joints), optional
            Start postures; one with NaN does not count.
        frames : mapping of str to Frame, optional
            Of shapes that broadcast with the joints, where the skill begins; those that were
            not shown do not count.

        Returns
        -------
        array of shape (...)
            From 0 on.
        """
        found: list[Array] = []
        if joints is not None and len(self.compared):
            starts = as_array(torch.as_tensor(joints))
            found.append(self.start.distance(starts[..., self.compared]))
        for name, frame in (frames or {}).items():
            if name not in self.places or isinstance(frame, Affine):  # which is no pose
                continue
            mean = np.array(self.orientations[name])
            turn = _rotation_vectors(as_array(frame.orientation), mean)
            found += [
                self.places[name].distance(as_array(frame.position)),
                self.turns[name].distance(turn),
            ]
        return _joined(found) / self.limit


def _distance_from_others(data: Mapping[tuple[str, str], Array], left_out: int) -> float:
    """How far one of the demonstrations is from the region of the others."""
    return float(
        _joined(
            Region.of(np.delete(vectors, left_out, axis=0), kind).distance(vectors[left_out])
            for (kind, _), vectors in data.items()
            if vectors.shape[1]
        )
    )


def _joined(distances: Iterable[Array]) -> Array:
    """The 4-norm of distances that broadcast; NaN does not count."""
    total = np.zeros(())
    for distance in distances:
        total = total + np.where(np.isnan(distance), 0.0, distance) ** POWER
    joined: Array = total ** (1 / POWER)
    return joined


def _rotation_vectors(orientations: Array, mean: Array) -> Array:
    """Of the rotations from ``mean`` (4,) to (..., 4), by the shorter way [rad]."""
    back = quaternions.conjugate(torch.from_numpy(np.ascontiguousarray(mean)))
    turns = quaternions.product(back, torch.from_numpy(np.ascontiguousarray(orientations)))
    return as_array(quaternions.log(turns))

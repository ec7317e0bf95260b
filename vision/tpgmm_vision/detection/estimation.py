"""The pose of a target from the corners of its tags, its uncertainty, or why it is unknown.

A flat tag that is seen from the front has two poses that explain its corners nearly as well.
All such hypotheses of all tags are fitted to all corners by Gauss-Newton; a pose is only valid
if the next best one explains them clearly worse.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tpgmm_vision.camera import Camera
from tpgmm_vision.poses import Array, angle_between, cross_matrix, inverse, rigid, transform
from tpgmm_vision.targets import Target

#: How far what is known may be off: an upright axis [rad], the height of what stands [m].
UPRIGHT_STD, HEIGHT_STD = np.radians(0.5), 0.001
#: Standard deviation of corners of which no covariance is given [pixels].
CORNER_STD = 0.1
#: Steps of Gauss-Newton, and a step that ends it: a share of its standard deviation.
STEPS, SMALL_STEP = 8, 0.01
#: Hypotheses this far apart are two [rad].
DISTINCT = np.radians(3)
#: So much larger must the sum of squares of the second hypothesis be, in units of what is left
#: of the first for each number that is known, at least a variance: a likelihood ratio of e^-10.
LEAST_EVIDENCE = 20.0
#: Corners contradict a pose that are further than both from where they should be, root mean
#: square: in standard deviations, and as a share of an edge, by which cubes are glued badly.
MOST_MISFIT, CRAFT = 5.0, 0.015
#: A pose less certain than this is not valid: standard deviation [m] and [rad].
MOST_UNCERTAIN = 0.003, np.radians(3)

#: Whether the target is upright, and its height, where it counts what is known of them.
Known = tuple[bool, float | None] | None


@dataclass(frozen=True)
class View:
    """View of a target by a camera.

    Parameters
    ----------
    camera : Camera
    base_from_camera : ndarray of shape (4, 4)
    corners : mapping of int to ndarray of shape (4, 2)
        Of tags, by number [pixels].
    covariances : mapping of int to ndarray of shape (8, 8), optional
        Of the corners [pixels^2].
    """

    camera: Camera
    base_from_camera: Array
    corners: Mapping[int, Array]
    covariances: Mapping[int, Array] | None = None


@dataclass(frozen=True)
class PoseEstimate:
    """A pose with its uncertainty.

    Parameters
    ----------
    pose : ndarray of shape (4, 4)
        Of the target in the base frame.
    covariance : ndarray of shape (6, 6)
        Of its position [m^2] and, as a rotation vector in the base frame, of its orientation
        [rad^2].
    residual : float
        Compute the root mean square error of the corners [pixels].
    valid : bool
    reason : str
        Why it is not valid.
    tags : tuple of int
        Those that count.
    alternative : ndarray of shape (4, 4), optional
        The other pose, where two explain what is seen.
    """

    pose: Array
    covariance: Array
    residual: float
    valid: bool
    reason: str
    tags: tuple[int, ...]
    alternative: Array | None = None


def estimate_pose(
    views: Sequence[View], target: Target, *, upright: bool = False, height: float | None = None
) -> PoseEstimate | None:
    """Estimate the pose of a target from all tags that all cameras see.

    Parameters
    ----------
    views : sequence of View
    target : Target
    upright : bool, default=False
        Whether its z axis is vertical.
    height : float, optional
        Of its origin in the base frame [m]. Where what is seen contradicts this or ``upright``
        (somebody holds it), it does not count.

    Returns
    -------
    PoseEstimate or None
        None if no tag of the target is seen.
    """
    known = (upright, height) if upright or height is not None else None
    while (problem := _Problem(views, target)).seen:
        fit = problem.fit(known)
        wrong = problem.contradicts(fit)
        if not wrong or len(problem.tags) == 1:
            return problem.judge_fit(fit, wrong)
        worst = problem.worst(fit.pose)
        left = {number: one for number, one in target.corners.items() if number != worst}
        target = replace(target, corners=left)
    return None


@dataclass(frozen=True)
class _Fit:
    """A hypothesis that was fitted, and the next best."""

    pose: Array
    cost: float
    information: Array
    second: _Fit | None = None


class _Seen:
    """The corners of a target's tags in one view.

    ``points`` (n, 4, 3) in the target's frame, ``pixels`` (n, 4, 2), and matrices (n, 8, 8)
    that ``whiten`` them.
    """

    def __init__(self, view: View, target: Target, numbers: Sequence[int]) -> None:
        usual = CORNER_STD**2 * np.eye(8)
        given = [(view.covariances or {}).get(number, usual) for number in numbers]
        self.view, self.numbers, self._from_base = view, numbers, inverse(view.base_from_camera)
        self.points = np.array([target.corners[number] for number in numbers])
        self.pixels = np.array([view.corners[number] for number in numbers])
        self.whiten = np.linalg.inv(np.linalg.cholesky(np.array(given)))

    def errors(self, pose: Array) -> Array:
        """Expected less seen corners (n, 4, 2) [pixels]."""
        points = transform(self._from_base @ pose, self.points.reshape(-1, 3))
        return self.view.camera.project(points).reshape(-1, 4, 2) - self.pixels

    def residual(self, pose: Array) -> tuple[Array, Array]:
        """Compute errors (n, 8) in standard deviations, and their Jacobian (n, 8, 6)."""
        n, camera_from_base = len(self.numbers), self._from_base
        turned = self.points.reshape(-1, 3) @ pose[:3, :3].T
        points = transform(camera_from_base, turned + pose[:3, 3])
        if (points[:, 2] < 1e-3).any():  # behind the camera
            return np.full((n, 8), 1e3), np.zeros((n, 8, 6))
        pixels, rates = self.view.camera.project_with_rates(points)
        rates = rates @ camera_from_base[:3, :3]
        # d (w x p) / d w = -[p]x
        turns = rates @ cross_matrix(-turned)
        moved = np.concatenate((rates, turns), axis=-1).reshape(n, 8, 6)
        error = pixels.reshape(n, 8) - self.pixels.reshape(n, 8)
        return np.einsum("nij,nj->ni", self.whiten, error), self.whiten @ moved


class _Problem:
    """All corners of a target, and the numbers of their tags."""

    def __init__(self, views: Sequence[View], target: Target) -> None:
        found = [(view, sorted(view.corners.keys() & target.corners.keys())) for view in views]
        self.seen = [_Seen(view, target, tags) for view, tags in found if tags]
        self.tags = tuple(dict.fromkeys(number for one in self.seen for number in one.numbers))

    @property
    def freedom(self) -> int:
        """Number of measurements beyond those of a pose."""
        return 8 * sum(len(one.numbers) for one in self.seen) - 6

    def worst(self, pose: Array) -> int:
        """Find the tag that fits a pose worst."""
        costs = dict.fromkeys(self.tags, 0.0)
        for one in self.seen:
            for number, errors in zip(one.numbers, one.residual(pose)[0], strict=True):
                costs[number] += float(errors @ errors)
        return max(costs, key=lambda number: costs[number])

    def fit(self, known: Known) -> _Fit:
        """Fit the pose, without what is known where the corners contradict it."""
        fit = self.best(known)
        if known and fit.cost > self.freedom + MOST_MISFIT**2:
            free = self.best(None)
            fit = free if fit.cost > free.cost + MOST_MISFIT**2 else fit
        return fit

    def best(self, known: Known) -> _Fit:
        """Fit the hypothesis that fits best."""
        guesses = [pose for one in self.seen for pose in _hypotheses(one)]
        costs = [self.system(pose, known)[0] for pose in guesses]
        order = np.argsort(costs)
        first = self.descend(guesses[order[0]], known)
        others = [guesses[k] for k in order[1:]]
        if rivals := [one for one in others if angle_between(one, first.pose) > DISTINCT]:
            other = self.descend(rivals[0], known)
            if angle_between(other.pose, first.pose) > DISTINCT:
                if other.cost < first.cost:
                    first, other = other, first
                return replace(first, second=other)
        return first

    def descend(self, pose: Array, known: Known) -> _Fit:
        """Gauss-Newton with damping."""
        damping = 1e-3
        cost, gradient, information = self.system(pose, known)
        for _ in range(STEPS):
            scale = np.diag(np.diag(information)) * damping + 1e-6 * np.eye(6)
            step = -np.linalg.solve(information + scale, gradient)
            step *= 0.5 / max(0.5, float(np.abs(step).max()))
            turn = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
            new = rigid(turn, pose[:3, 3] + step[:3])
            found = self.system(new, known)
            if found[0] <= cost:
                pose, damping = new, damping / 10
                cost, gradient, information = found
                if float(step @ information @ step) < SMALL_STEP**2:
                    break
            else:
                damping = max(10 * damping, 1e-2)
        return _Fit(pose, cost, information)

    def system(self, pose: Array, known: Known) -> tuple[float, Array, Array]:
        """Sum of squares in standard deviations, its gradient / 2 and Gauss-Newton's matrix."""
        parts = [one.residual(pose) for one in self.seen]
        residual = np.concatenate([part[0].ravel() for part in parts])
        rates = np.concatenate([part[1].reshape(-1, 6) for part in parts])
        if known is not None:
            upright, height = known
            if upright:
                axis, turn = pose[:3, 2], np.zeros((2, 6))
                # of the axis' x and y with a small rotation: w x axis
                turn[0, 3:], turn[1, 3:] = (0, axis[2], -axis[1]), (-axis[2], 0, axis[0])
                # further than a quarter turn away it is no nearer
                far = 1 if axis[2] > 0 else max(float(np.linalg.norm(axis[:2])), 1e-3)
                residual = np.append(residual, axis[:2] / far / UPRIGHT_STD)
                rates = np.concatenate((rates, turn / UPRIGHT_STD))
            if height is not None:
                residual = np.append(residual, (pose[2, 3] - height) / HEIGHT_STD)
                rates = np.concatenate((rates, np.eye(1, 6, 2) / HEIGHT_STD))
        return float(residual @ residual), rates.T @ residual, rates.T @ rates

    def residual(self, pose: Array) -> float:
        """Compute the root mean square error of the corners [pixels]."""
        errors = np.concatenate([one.errors(pose) for one in self.seen])
        return float(np.sqrt(np.square(errors).sum(-1).mean()))

    def contradicts(self, fit: _Fit) -> bool:
        """Test whether the corners are not where they should be."""
        pixels = np.concatenate([one.pixels for one in self.seen])
        edges = np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=1)
        bound = CRAFT * float(np.median(edges))
        return fit.cost > MOST_MISFIT**2 * self.freedom and self.residual(fit.pose) > bound

    def judge_fit(self, fit: _Fit, wrong: bool) -> PoseEstimate:
        """Judge whether a pose can be trusted, and if not why."""
        misfit = fit.cost / self.freedom
        inverse_information = np.linalg.pinv(fit.information, hermitian=True)
        covariance = np.asarray(inverse_information * max(misfit, 1), dtype=float)
        parts = covariance[:3, :3], covariance[3:, 3:]
        position, turn = (np.sqrt(np.linalg.eigvalsh(part)[-1]) for part in parts)
        reason, alternative = "", None
        if wrong:
            reason = "the corners of its tag fit no pose"
        elif position > MOST_UNCERTAIN[0] or turn > MOST_UNCERTAIN[1]:
            reason = (
                f"it is uncertain by {1e3 * position:.0f} mm and {np.degrees(turn):.0f} deg: "
                "its tags are too small in the picture"
            )
        elif fit.second and fit.second.cost - fit.cost < LEAST_EVIDENCE * max(misfit, 1):
            reason, alternative = "two poses explain what is seen", fit.second.pose
        found = fit.pose, covariance, self.residual(fit.pose), not reason, reason
        return PoseEstimate(*found, self.tags, alternative)


def _hypotheses(seen: _Seen) -> list[Array]:
    """Find the two poses of the target by which each of its flat tags can be explained."""
    camera, found = seen.view.camera, list[Array]()
    for points, pixels in zip(seen.points, seen.pixels, strict=True):
        size = float(np.linalg.norm(points[1] - points[0]))
        x, y = (points[1] - points[0]) / size, (points[0] - points[3]) / size
        target_from_tag = rigid(np.stack((x, y, np.cross(x, y)), axis=1), points.mean(0))
        square = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * size / 2
        _, turns, places, _ = cv2.solvePnPGeneric(
            square, pixels.reshape(4, 1, 2), camera.matrix, np.array(camera.distortion),
            flags=cv2.SOLVEPNP_IPPE_SQUARE,
        )  # fmt: skip
        base_from_camera, tag_from_target = seen.view.base_from_camera, inverse(target_from_tag)
        for turn, place in zip(turns, places, strict=True):
            if np.isfinite(turn).all() and np.isfinite(place).all():
                found.append(base_from_camera @ rigid(turn, place) @ tag_from_target)
    return found

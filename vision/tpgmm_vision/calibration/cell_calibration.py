"""Calibrate a cell by the robot's own motion: cameras, tags in its hands, offsets of joints."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_vision.calibration.adjustment import OFFSET_PRIOR, Adjustment, adjust
from tpgmm_vision.calibration.reprojection import Corners, Reprojection
from tpgmm_vision.cell import CellCamera
from tpgmm_vision.detection.estimation import View, estimate_pose
from tpgmm_vision.detection.tags import Detections
from tpgmm_vision.poses import Array, inverse, mean_pose, rigid
from tpgmm_vision.targets import Target

__all__ = ["calibrate_cell"]

#: Closed forms of OpenCV for the camera on a hand, from Tsai's to Daniilidis'; none is best.
CLOSED_FORMS = range(5)
#: Pictures of each camera at least, and parts of them that are left out in turns.
LEAST_PICTURES, FOLDS = 8, 5
#: A tag whose corners are this many times further off than noise explains is a wrong one.
WRONG_TAG = 10.0
#: Offsets that are known no better than this share of what was known before are not known.
UNKNOWN_SHARE = 0.5
#: The error between object and hand that offsets and poses which are not known may add [m].
LARGEST_EXPECTED = 0.003
#: It is expected at so many postures, at most so far from the mean of those recorded [rad].
ELSEWHERE, LIKELY_REACH = 50, 0.5
#: Less than this is no step of a camera or a target [m, rad].
LEAST_STEP = 0.003, np.radians(0.5)
#: A joint that turned less than this hardly moved [rad].
HARDLY = np.radians(15.0)
#: By how much the logarithm of the likelihood must rise for a cause to be believed: of a scale,
#: and of a pose that changed on the way, which can do so at any picture.
SCALE_EVIDENCE, STEP_EVIDENCE = 8.0, 25.0

#: Posture, camera and target of each picture of a target.
Pictures = Iterable[tuple[int, int, int]]


@dataclass(frozen=True, eq=False)
class Mount:
    """Tags in a hand, or standing still.

    Parameters
    ----------
    target : Target
    link : str, optional
        The link that holds it; None if it stands still.
    """

    target: Target
    link: str | None = None


@dataclass(frozen=True, eq=False)
class CellCalibration:
    """A calibrated cell.

    Parameters
    ----------
    cameras : dict of str to ndarray of shape (4, 4)
        Their poses in the base frame, or in the links that carry them.
    mounts : dict of str to ndarray of shape (4, 4)
        Poses of the targets in the links that hold them, or in the base frame.
    bases : dict of str to ndarray of shape (4, 4)
        By prefix, how an arm is moved in the base frame from where the robot has it.
    joint_offsets, uncertainty : dict of str to float
        What is added to measured joints, and its standard deviation [rad].
    unknown : tuple of str
        Joints whose offset cannot be known, which is then 0.
    position_errors, angle_errors : ndarray of shape (n_errors,)
        Of pictures left out: between where a camera sees a target, and where its hand has it by
        the joints [m, rad].
    joint_noise : float
        Standard deviation of what is left [rad].
    problems : tuple of str
        What does not fit, and its remedy.
    expected : dict of (str, int) to dict of int to ndarray of shape (4, 2)
        Where the corners of tags are expected, by camera and picture, then number [pixels].
    """

    cameras: dict[str, Array]
    mounts: dict[str, Array]
    bases: dict[str, Array]
    joint_offsets: dict[str, float]
    uncertainty: dict[str, float]
    unknown: tuple[str, ...]
    position_errors: Array
    angle_errors: Array
    joint_noise: float
    problems: tuple[str, ...]
    expected: Mapping[tuple[str, int], dict[int, Array]]

    def __str__(self) -> str:
        far = np.quantile(1e3 * self.position_errors, (0.5, 0.95))
        turned = np.quantile(np.degrees(self.angle_errors), (0.5, 0.95))
        offsets = ", ".join(
            f"{name} {np.degrees(value):+.2f} +- {np.degrees(self.uncertainty[name]):.2f}"
            for name, value in self.joint_offsets.items()
            if name not in self.unknown
        )
        unknown = "\nnot known from these postures, poses make up for them: "
        return (
            f"error between object and hand, on pictures left out: {far[0]:.1f} mm (median), "
            f"{far[1]:.1f} mm (95 %); {turned[0]:.2f} and {turned[1]:.2f} deg\n"
            f"offsets of joints [deg]: {offsets or 'none'}"
            + (unknown + ", ".join(self.unknown) if self.unknown else "")
        )


def calibrate_cell(
    robot: Kinematics,
    joints: ArrayLike,
    seen: Mapping[str, Sequence[Detections]],
    cameras: Mapping[str, CellCamera],
    mounts: Mapping[str, Mount],
    *,
    bases: Sequence[str] = (),
) -> CellCalibration:
    """Calibrate cameras, tags in hands and joints together, by pictures of the robot's hands.

    Parameters
    ----------
    robot : Kinematics
        Its ``links`` are those that carry cameras and targets, and others.
    joints : array-like of shape (n, n_joints)
        As measured at each picture, in the order in which they were taken [rad].
    seen : mapping of str to sequence of n Detections
        By camera: the tags in its pictures.
    cameras : mapping of str to CellCamera
        With their links; poses that they have do not count.
    mounts : mapping of str to Mount
        Tags in hands, and those that stand still, by name.
    bases : sequence of str, default=()
        Beginnings of the names of links and joints of arms whose base is not known, such as
        ``"right_"``.

    Raises
    ------
    DataError
        If pictures or postures do not tell, a tag is seen twice, or a camera or a target was
        moved on the way; the message says what is missing.
    UnknownNameError
        If there is no such camera or link.
    """
    given = np.asarray(joints, dtype=float), robot, seen, cameras, mounts
    _check(*given)
    task = _Task(*given, bases)
    first = adjust(task.problem, task.start(), robust=True)
    wrong = first.misfit > WRONG_TAG**2
    problem = replace(task.problem, corners=task.problem.corners.of(np.repeat(~wrong, 4)))
    fit = adjust(problem, first.state)
    task.check_steady(fit)
    task.check_known(fit)
    problems = task.scales(fit)
    if wrong.any():
        problems += (f"{wrong.sum()} of {len(wrong)} tags do not fit and do not count",)
    spread = np.sqrt(np.diag(fit.covariance()))[problem.offsets]
    unknown = spread > UNKNOWN_SHARE * OFFSET_PRIOR
    if unknown.any():
        free, state = problem.free.copy(), fit.state.copy()
        free[problem.offsets] &= ~unknown
        problem.split(state)[1][unknown] = 0
        fit = adjust(replace(problem, free=free), state)
    return task.result(fit, unknown, problems)


class _Task:
    """Unknowns of a calibration, and the poses of targets in each picture.

    ``views`` has, for each camera and target, the postures and the poses of the target in the
    camera's frame.
    """

    def __init__(
        self, joints: Array, robot: Kinematics, seen: Mapping[str, Sequence[Detections]],
        cameras: Mapping[str, CellCamera], mounts: Mapping[str, Mount], bases: Sequence[str],
    ) -> None:  # fmt: skip
        self.cameras, self.mounts, self.bases = list(seen), list(mounts), bases
        carriers = [cameras[name].link for name in seen]
        carriers += [mount.link for mount in mounts.values()]
        _check_links(robot, carriers if seen and mounts else [], bases)
        self.lenses, self.shown = [cameras[name].camera for name in seen], [*seen.values()]
        self.targets = [mount.target for mount in mounts.values()]
        rows = self._collect_rows()
        pictures = dict.fromkeys(row[:3] for row in rows)
        self._check_pictures(pictures, len(joints))
        self.views = self._estimate_views(pictures)
        *places, pixels, points = zip(*rows, strict=True)
        seen_at = map(np.concatenate, (pixels, points))
        corners = Corners(*seen_at, *np.repeat(np.array(places), 4, 1))
        arms = [_find_arm(robot, base) for base in bases]
        self.problem = Reprojection(robot, joints, corners, self.lenses, carriers, arms)

    def _collect_rows(self) -> list[tuple[int, int, int, int, Array, Array]]:
        """Collect what pictures show: posture, camera, target and tag; pixels and points."""
        return [
            (k, i, j, number, found.corners[number], target.corners[number])
            for k, at_posture in enumerate(zip(*self.shown, strict=True))
            for i, found in enumerate(at_posture)
            for j, target in enumerate(self.targets)
            for number in found.corners.keys() & target.corners.keys()
        ]

    def _estimate_views(self, pictures: Pictures) -> dict[tuple[int, int], list[Any]]:
        """Estimate the poses of targets in pictures: postures and poses, by both."""
        views = defaultdict[tuple[int, int], list[Any]](list)
        for k, i, j in pictures:
            view = View(self.lenses[i], np.eye(4), self.shown[i][k].corners)
            if estimate := estimate_pose([view], self.targets[j]):
                views[i, j].append((estimate.valid, k, estimate.pose))
        for pair, found in views.items():
            # poses that cannot be trusted count only where there are too few others
            good = [row for row in found if row[0]]
            _, *columns = zip(*(good if len(good) >= LEAST_PICTURES else found), strict=True)
            views[pair] = list(map(np.array, columns))
        return views

    def _check_pictures(self, pictures: Pictures, total: int) -> None:
        """Refuse a camera that sees too little, and a target that no camera sees."""
        for i, name in enumerate(self.cameras):
            if (n := len({k for k, at, _ in pictures if at == i})) < LEAST_PICTURES:
                raise DataError(
                    f"camera {name!r} sees tags of {self.mounts} in {n} of {total} "
                    f"pictures, {LEAST_PICTURES} are needed: is it the camera that sees them, "
                    "are their numbers right, and are they large enough in the picture (20 "
                    "pixels an edge)?"
                )
        found = {j for *_, j in pictures}
        if lost := [name for j, name in enumerate(self.mounts) if j not in found]:
            raise DataError(f"no camera sees tags of {lost}: are their numbers right?")

    def start(self) -> Array:
        """Estimate the state by closed forms, pair by pair of a camera and a target."""
        problem, n, known = self.problem, len(self.cameras), dict[int, Array]()
        bases = np.tile(np.eye(4), (len(self.bases), 1, 1))
        links, unplaced = problem.place_links(problem.nothing)[0], set(range(len(bases)))

        def order(pair: tuple[int, int]) -> tuple[bool, bool, bool, int]:
            i, target = pair[0], n + pair[1]
            unknown = problem.base_of[problem.links[target]] in unplaced
            # a target that stands still before the camera says nothing of where either is
            still = problem.links[i] == problem.links[target]
            first = (i in known) == (target in known)
            return unknown, first, bool(still), -len(self.views[pair][0])

        while left := [(i, j) for i, j in self.views if not {i, n + j} <= known.keys()]:
            i, j = min(left, key=order)
            target, (postures, poses) = n + j, self.views[i, j]
            base = problem.base_of[problem.links[target]]
            camera, hand = links[postures][:, problem.links[[i, target]]].swapaxes(0, 1)
            hand_from_carrier = inverse(hand) @ camera
            if base in unplaced and i in known:
                there, known[target] = self._closed_form(i, j, hand_from_carrier, poses)
                bases[base] = known[i] @ inverse(there)
                own = problem.base_of == base
                links[:, own] = bases[base] @ links[:, own]
                unplaced.remove(base)
            elif i in known:
                known[target] = mean_pose(hand_from_carrier @ known[i] @ poses)[0]
            elif target in known:
                back = inverse(hand_from_carrier) @ known[target]
                known[i] = mean_pose(back @ inverse(poses))[0]
            else:
                known[i], known[target] = self._closed_form(i, j, hand_from_carrier, poses)
        return problem.state(np.stack([*(known[part] for part in sorted(known)), *bases]))

    def _closed_form(
        self, i: int, j: int, hand_from_carrier: Array, camera_from_target: Array
    ) -> tuple[Array, Array]:
        """Solve for the poses of a camera in its carrier and of a target in the hand."""
        found = list[tuple[float, Array, Array]]()
        hand, seen = hand_from_carrier[:, :3], camera_from_target[:, :3]
        solve: Any = cv2.calibrateHandEye
        lists = [*hand[..., :3]], [*hand[..., 3]], [*seen[..., :3]], [*seen[..., 3]]
        for method in CLOSED_FORMS:
            with suppress(cv2.error):
                turn, place = solve(*lists, method=method)
                if np.isfinite(place).all() and np.linalg.det(turn) > 0.5:
                    poses = hand_from_carrier @ rigid(turn, place) @ camera_from_target
                    target, _ = mean_pose(poses)
                    away = np.linalg.norm(poses[:, :3, 3] - target[:3, 3], axis=1)
                    found.append((float(np.median(away)), rigid(turn, place), target))
        if not found:
            raise DataError(f"{self._missing(i, j)}: no closed form has a solution")
        return min(found, key=lambda one: one[0])[1:]

    def check_steady(self, fit: Adjustment) -> None:
        """Refuse a camera, or tags in a hand, that moved on the way."""
        problem, names = fit.problem, [*self.cameras, *self.mounts]
        postures, steps = np.repeat(problem.corners.posture, 2), list[Any]()
        for part, at in product(range(len(problem.carriers)), np.unique(postures)[2:-1]):
            late, n = np.zeros((len(fit.left), 6)), len(postures)
            late[:n] = fit.jacobian[:n, 6 * part :][:, :6] * (postures >= at)[:, None]
            steps.append((*fit.gain(late), part, int(at)))
        gain, step, _, part, at = max(steps, key=lambda one: one[0])
        moved_by, turned = np.linalg.norm(step.reshape(2, 3), axis=1)
        if gain > STEP_EVIDENCE and (moved_by > LEAST_STEP[0] or turned > LEAST_STEP[1]):
            raise DataError(
                f"{'camera' if part < len(self.cameras) else 'target'} {names[part]!r} was "
                f"moved by {1e3 * moved_by:.0f} mm and {np.degrees(turned):.1f} deg at picture "
                f"{at} of {len(problem.joints)}: fix it, and record all pictures again"
            )

    def check_known(self, fit: Adjustment) -> None:
        """Refuse postures that do not tell the error between object and hand elsewhere."""
        problem, pairs = fit.problem, list(self.views)
        shape = ELSEWHERE, problem.robot.n_joints
        away = np.random.default_rng(0).uniform(-LIKELY_REACH, LIKELY_REACH, shape)
        at, (i, j) = np.tile(np.arange(ELSEWHERE), len(pairs)), np.repeat(pairs, ELSEWHERE, 0).T
        middles = np.zeros((len(at), 3))
        corners = Corners(middles[:, :2], middles, at, i, j, at)
        other = replace(problem, joints=problem.joints.mean(0) + away, corners=corners)
        _, _, seen = other.expect_pixels(fit.state)
        errors = np.einsum("nij,jk,nik->n", seen, fit.covariance(), seen) ** 0.5
        expected = np.median(errors.reshape(len(pairs), -1), axis=1)
        if (worst := float(expected.max())) > LARGEST_EXPECTED:
            raise DataError(
                f"{self._missing(*pairs[int(expected.argmax())])}: elsewhere what the hand "
                f"holds may be {1e3 * worst:.0f} mm from where it is seen"
            )

    def _missing(self, i: int, j: int) -> str:
        """Describe the variety that postures lack."""
        problem, part = self.problem, self.problem.links[len(self.cameras) + j]
        links, jacobians = problem.place_links(problem.nothing)
        used = self.views[i, j][0]
        turns = Rotation.from_matrix(links[used, part, :3, :3])
        vectors = (turns * turns.mean().inv()).as_rotvec()
        spreads, axes = np.linalg.eigh(vectors.T @ vectors / len(used))
        lacking = [
            "the vertical" if abs(axis[2]) > 0.8 else f"the axis {axis.round(1).tolist()}"
            for axis in axes.T[spreads < (HARDLY / 2) ** 2]
        ]
        moved = np.ptp(problem.joints[used], axis=0)
        movers = (np.abs(jacobians[:, part]).max((0, 1)) > 1e-9) & (moved < HARDLY)
        still = [f"{problem.robot.joint_names[k]} ({np.degrees(moved[k]):.0f} deg)"
                 for k in np.flatnonzero(movers)]  # fmt: skip
        return (
            f"{len(used)} postures of {self.mounts[j]!r} before {self.cameras[i]!r} are too "
            "few or too similar"
            + (f", without rotation about {' and '.join(lacking)}" if lacking else "")
            + (f"; turn {', '.join(still)} by 45 deg and more" if still
               else "; take 30, in which all joints differ by 45 deg and more")
        )  # fmt: skip

    def scales(self, fit: Adjustment) -> tuple[str, ...]:
        """Find focal lengths or sizes of tags that explain clearly more if changed."""
        found = list[tuple[float, str]]()
        for number, column in enumerate(fit.jacobian.T[fit.problem.scales]):
            gain, [value], [spread] = fit.gain(column[:, None])
            amount = f"{100 * abs(value):.1f} +- {100 * spread:.1f} %"
            text = (
                f"tags are {amount} {'larger' if value > 0 else 'smaller'} than said: measure "
                "one with a ruler"
                if number == len(self.cameras)
                else f"the focal length of camera {self.cameras[number]!r} is {amount} too "
                f"{'small' if value > 0 else 'large'}: calibrate it again, by pictures that "
                "are not cropped or scaled"
            )
            found.append((gain, text))
        best = max(found)[0]
        likely = [text for gain, text in found if best - gain < SCALE_EVIDENCE / 2]
        return (" or ".join(likely),) if best > SCALE_EVIDENCE else ()

    def result(
        self, fit: Adjustment, unknown: NDArray[np.bool_], problems: tuple[str, ...]
    ) -> CellCalibration:
        """Summarise the calibration, with errors on pictures left out."""
        problem, n, away = fit.problem, len(self.cameras), list[Array]()
        for fold in range(FOLDS):
            corners = problem.corners.of(problem.corners.posture % FOLDS != fold)
            part = adjust(replace(problem, corners=corners), fit.state, fit.noise)
            placed = problem.place_carried(part.state)
            for (i, j), (postures, poses) in self.views.items():
                if problem.links[i] == problem.links[n + j]:
                    continue  # which stand still to one another, no hand among them
                own = postures[left := postures % FOLDS == fold]
                away += [*(inverse(placed[own, i] @ poses[left]) @ placed[own, n + j])]
        poses, offsets, _ = problem.split(fit.state)
        spread = np.diag(fit.covariance())[problem.offsets] ** 0.5
        names, moves = np.array(problem.robot.joint_names), self.problem.free[problem.offsets]
        moving = names[moves].tolist()
        known = dict(zip(moving, offsets[moves].tolist(), strict=True))
        errors = dict(zip(moving, spread[moves].tolist(), strict=True))
        pixels, c = self.problem.expect_pixels(fit.state)[0], self.problem.corners
        expected = defaultdict[tuple[str, int], dict[int, Array]](dict)
        for k in range(0, len(pixels), 4):
            place = self.cameras[c.camera[k]], int(c.posture[k])
            expected[place][int(c.number[k])] = pixels[k : k + 4]
        parts = np.split(poses, [n, len(problem.carriers)])
        called = zip((self.cameras, self.mounts, self.bases), parts, strict=True)
        cameras, mounts, bases = (dict(zip(*each, strict=True)) for each in called)
        return CellCalibration(
            cameras, mounts, bases, known, errors, tuple(names[unknown].tolist()),
            np.linalg.norm(np.array(away)[:, :3, 3], axis=1),
            Rotation.from_matrix(np.array(away)[:, :3, :3]).magnitude(),
            fit.noise.joints, problems, expected,
        )  # fmt: skip


def _check(
    joints: Array, robot: Kinematics, seen: Mapping[str, Sequence[Detections]],
    cameras: Mapping[str, CellCamera], mounts: Mapping[str, Mount],
) -> None:  # fmt: skip
    """Refuse what does not go together."""
    if joints.shape[1:] != (robot.n_joints,) or not np.isfinite(joints).all():
        names = list(robot.joint_names)
        raise DataError(f"joints are finite, of shape (n, {len(names)}), those of {names}; got "
                        f"{joints.shape}")  # fmt: skip
    for name, found in seen.items():
        if name not in cameras:
            raise UnknownNameError("camera", name, "the cell", cameras)
        _check_detections(name, found, len(joints))
    numbers = [number for mount in mounts.values() for number in mount.target.corners]
    if len(set(numbers)) < len(numbers):
        raise DataError(f"targets share numbers of tags, got {sorted(numbers)}")


def _check_detections(name: str, found: Sequence[Detections], total: int) -> None:
    """Refuse the tags of a camera that are not those of all pictures, or were seen twice."""
    if len(found) != total:
        raise DataError(f"camera {name!r} has {len(found)} pictures for {total} rows")
    if twice := {k: sorted(tags.twice) for k, tags in enumerate(found) if tags.twice}:
        raise DataError(f"camera {name!r} sees tags twice, by picture {twice}: cover or remove "
                        "the others")  # fmt: skip


def _find_arm(robot: Kinematics, base: str) -> set[str]:
    """Find the links whose names begin so."""
    return {link for link in robot.links if link.startswith(base)}


def _check_links(robot: Kinematics, links: Sequence[str | None], bases: Sequence[str]) -> None:
    """Refuse links that the robot lacks, a cell without motion, and arms without a base."""
    if unknown := {*links} - {None, *robot.links}:
        raise UnknownNameError("link", str(unknown.pop()), "the robot", robot.links)
    if not any(links):
        raise DataError("no camera and no target is on a link of the robot: nothing moves")
    for base in bases:
        if len(_find_arm(robot, base)) in (0, len(robot.links)):
            raise DataError(f"links of an arm begin with {base!r}, not all; got {robot.links}")

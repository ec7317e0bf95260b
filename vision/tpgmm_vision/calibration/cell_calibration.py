"""Calibrate a cell by the robot's own motion: cameras, tags in its hands, offsets of joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_vision.calibration.adjustment import OFFSET_PRIOR, Adjustment, adjust
from tpgmm_vision.calibration.reprojection import Corners, Integers, Reprojection
from tpgmm_vision.cell import CellCamera
from tpgmm_vision.detection.estimation import PoseEstimate, View, estimate_pose
from tpgmm_vision.detection.tags import Detections
from tpgmm_vision.poses import Array, angle_between, inverse, mean_pose, rigid
from tpgmm_vision.targets import Target

__all__ = ["CellCalibration", "Mount", "calibrate_cell"]

#: Closed forms of OpenCV for the camera on a hand; none is best everywhere.
CLOSED_FORMS = (
    cv2.CALIB_HAND_EYE_PARK, cv2.CALIB_HAND_EYE_TSAI, cv2.CALIB_HAND_EYE_HORAUD,
    cv2.CALIB_HAND_EYE_DANIILIDIS,
)  # fmt: skip
#: Pictures of each camera at least, and parts of them that are left out in turns.
LEAST_PICTURES, FOLDS = 8, 5
#: A tag whose corners are this many times further off than noise explains is a wrong one.
WRONG_TAG = 10.0
#: Offsets that are known no better than this share of what was known before are not known.
UNKNOWN_SHARE = 0.5
#: The error between object and hand that a calibration may expect anywhere [m].
LARGEST_EXPECTED = 0.01
#: It is expected at so many postures, at most so far from the mean of those recorded [rad].
ELSEWHERE, LIKELY_REACH = 50, 0.5
#: Less than this is no step of a camera or a target [m, rad].
LEAST_STEP = 0.003, np.radians(0.5)
#: A joint that turned less than this hardly moved [rad].
HARDLY = np.radians(15.0)
#: By how much the logarithm of the likelihood must rise for a cause to be believed: of a scale,
#: and of a pose that changed on the way, which can do so at any picture.
SCALE_EVIDENCE, STEP_EVIDENCE = 6.0, 25.0


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
        Of pictures left out: between where a camera sees a target, and where the robot believes
        that its hand holds it [m, rad].
    joint_noise : float
        Standard deviation of what is left [rad].
    problems : tuple of str
        What does not fit, and its remedy.
    expected : dict of str to list of dict of int to ndarray of shape (4, 2)
        Where the corners of tags are expected, by camera and picture [pixels].
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
    expected: dict[str, list[dict[int, Array]]]

    def __str__(self) -> str:
        far, turned = (
            np.quantile(values, (0.5, 0.95))
            for values in (1e3 * self.position_errors, np.degrees(self.angle_errors))
        )
        known = [name for name in self.joint_offsets if name not in self.unknown]
        offsets = [
            f"{name} {np.degrees(self.joint_offsets[name]):+.2f} "
            f"+- {np.degrees(self.uncertainty[name]):.2f}"
            for name in known
        ]
        lines = [
            f"error between object and hand, on pictures left out: {far[0]:.1f} mm (median), "
            f"{far[1]:.1f} mm (95 %); {turned[0]:.2f} and {turned[1]:.2f} deg",
            f"offsets of joints [deg]: {', '.join(offsets) or 'none'}",
        ]
        if self.unknown:
            lines.append(
                f"not known, and not needed, as poses of cameras and tags make up for them: "
                f"the offsets of {', '.join(self.unknown)}"
            )
        return "\n".join(lines)


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
        "right_".

    Raises
    ------
    DataError
        If pictures or postures do not tell, a tag is seen twice, or a camera or a target was
        moved on the way; the message says what is missing.
    UnknownNameError
        If there is no such camera or link.
    """
    task = _Task.of(robot, joints, seen, cameras, mounts, bases)
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


@dataclass(frozen=True, eq=False)
class _Task:
    """What is calibrated, and the poses of targets that each picture tells.

    ``views`` has, for each camera and target, the postures and the poses of the target in the
    camera's frame.
    """

    problem: Reprojection
    cameras: list[str]
    mounts: list[str]
    bases: Sequence[str]
    views: dict[tuple[int, int], tuple[Integers, Array]]

    @classmethod
    def of(
        cls,
        robot: Kinematics,
        joints: ArrayLike,
        seen: Mapping[str, Sequence[Detections]],
        cameras: Mapping[str, CellCamera],
        mounts: Mapping[str, Mount],
        bases: Sequence[str],
    ) -> _Task:
        """Check what is given, and put all corners in a row."""
        table = np.asarray(joints, dtype=float)
        _check(robot, table, seen, cameras, mounts, bases)
        names, rows = list(seen), list[tuple[int, int, int, int]]()
        pixels, points = list[Array](), list[Array]()
        views: dict[tuple[int, int], list[tuple[int, PoseEstimate]]] = {}
        for posture in range(len(table)):
            for i, name in enumerate(names):
                found, camera = seen[name][posture].corners, cameras[name].camera
                for j, mount in enumerate(mounts.values()):
                    estimate = estimate_pose([View(camera, np.eye(4), found)], mount.target)
                    if estimate is not None:
                        views.setdefault((i, j), []).append((posture, estimate))
                    for number in found.keys() & mount.target.corners.keys():
                        rows.append((posture, i, j, number))
                        pixels.append(found[number])
                        points.append(mount.target.corners[number])
        for i, name in enumerate(names):
            n = len({k for (at, _), those in views.items() if at == i for k, _ in those})
            if n < LEAST_PICTURES:
                raise DataError(
                    f"camera {name!r} sees tags of {list(mounts)} in {n} of {len(table)} "
                    f"pictures, {LEAST_PICTURES} are needed: is it the camera that sees them, "
                    "are their numbers right, and are they large enough in the picture (20 "
                    "pixels an edge)?"
                )
        if lost := [name for j, name in enumerate(mounts) if j not in {j for _, j in views}]:
            raise DataError(f"no camera sees tags of {lost}: are their numbers right?")
        corners = Corners(
            np.concatenate(pixels), np.concatenate(points), *np.repeat(np.array(rows), 4, 0).T
        )
        carriers = [cameras[name].link for name in names]
        carriers += [mount.link for mount in mounts.values()]
        own = [{link for link in robot.links if link.startswith(base)} for base in bases]
        problem = Reprojection(
            robot, table, corners, [cameras[name].camera for name in names], carriers, own
        )
        poses = {}
        for pair, those in views.items():
            # those that cannot be trusted only where there are no others
            good = [one for one in those if one[1].valid]
            good = good if len(good) >= LEAST_PICTURES else those
            poses[pair] = np.array([k for k, _ in good]), np.array([e.pose for _, e in good])
        return cls(problem, names, list(mounts), bases, poses)

    def start(self) -> Array:
        """The state by closed forms, pair by pair of a camera and a target."""
        problem, n, known = self.problem, len(self.cameras), dict[int, Array]()
        bases = np.tile(np.eye(4), (len(self.bases), 1, 1))
        links, _ = problem.placed(problem.state(np.tile(np.eye(4), (problem.n_poses, 1, 1))))
        unplaced = set(range(len(bases)))

        def order(pair: tuple[int, int]) -> tuple[bool, bool, int]:
            i, j = pair
            base = problem.base_of[problem.links[n + j]]
            one = (i in known) != (n + j in known)
            return base in unplaced, not one, -len(self.views[pair][0])

        while left := [(i, j) for i, j in self.views if not {i, n + j} <= known.keys()]:
            i, j = min(left, key=order)
            target, (postures, poses) = n + j, self.views[i, j]
            base = problem.base_of[problem.links[target]]
            camera, hand = links[postures][:, problem.links[[i, target]]].swapaxes(0, 1)
            hand_from_camera = inverse(hand) @ camera
            if base in unplaced and i in known:
                there, known[target] = self._closed_form(i, j, hand_from_camera, poses)
                bases[base] = known[i] @ inverse(there)
                own = problem.base_of == base
                links[:, own] = bases[base] @ links[:, own]
                unplaced.remove(base)
            elif i in known:
                known[target] = mean_pose(hand_from_camera @ known[i] @ poses)[0]
            elif target in known:
                back = inverse(hand_from_camera)
                known[i] = mean_pose(back @ known[target] @ inverse(poses))[0]
            else:
                known[i], known[target] = self._closed_form(i, j, hand_from_camera, poses)
        return problem.state(np.stack([*(known[part] for part in sorted(known)), *bases]))

    def _closed_form(
        self, i: int, j: int, hand_from_carrier: Array, camera_from_target: Array
    ) -> tuple[Array, Array]:
        """Poses of a camera in its carrier, and of a target in the hand."""
        best, found = np.inf, None
        for method in CLOSED_FORMS:
            try:
                turn, place = cv2.calibrateHandEye(
                    hand_from_carrier[:, :3, :3], hand_from_carrier[:, :3, 3],
                    camera_from_target[:, :3, :3], camera_from_target[:, :3, 3], method=method,
                )  # fmt: skip
            except cv2.error:
                continue
            camera = rigid(turn, place) if np.isfinite(turn).all() else np.eye(4)
            poses = hand_from_carrier @ camera @ camera_from_target
            target, _ = mean_pose(poses)
            error = float(np.median(np.linalg.norm(poses[:, :3, 3] - target[:3, 3], axis=1)))
            if np.isfinite(place).all() and error < best:
                best, found = error, (camera, target)
        if found is None:
            raise DataError(
                f"{self._missing(len(self.cameras) + j)} (camera {self.cameras[i]!r}, tags {self.mounts[j]!r})"
            )
        return found

    def check_steady(self, fit: Adjustment) -> None:
        """Refuse a camera, or tags in a hand, that moved on the way."""
        problem, names = fit.problem, [*self.cameras, *self.mounts]
        q, _ = np.linalg.qr(fit.jacobian)
        postures = np.repeat(problem.corners.posture, 2)
        places, column = np.unique(postures)[2:-1], np.cumsum(problem.free) - 1
        found = []
        for part in range(len(problem.carriers)):
            own, gains = fit.jacobian[:, column[6 * part : 6 * part + 6]], []
            for at in places:
                late = np.zeros_like(own)
                late[: len(postures)] = own[: len(postures)] * (postures >= at)[:, None]
                late -= q @ (q.T @ late)
                step = np.linalg.lstsq(late, fit.left, rcond=1e-9)[0]
                gains.append(float(fit.left @ late @ step))
            at = int(places[int(np.argmax(gains))])
            other, state, new = _divided(fit, part, at)
            moved = adjust(other, state)
            before, after = other.split(moved.state)[0][[part + (new < part), new]]
            gain = fit.surprise - moved.surprise
            found.append((gain, part, at, angle_between(before, after), before, after))
        gain, part, at, turned, before, after = max(found, key=lambda one: one[0])
        moved_by = float(np.linalg.norm(before[:3, 3] - after[:3, 3]))
        if gain > STEP_EVIDENCE and (moved_by > LEAST_STEP[0] or turned > LEAST_STEP[1]):
            kind = "camera" if part < len(self.cameras) else "target"
            raise DataError(
                f"{kind} {names[part]!r} was moved by {1e3 * moved_by:.0f} mm and "
                f"{np.degrees(turned):.1f} deg at picture {at} of {len(problem.joints)}: fix it, "
                "and record all pictures again, or take only those before or after"
            )

    def check_known(self, fit: Adjustment) -> None:
        """Refuse postures that do not tell the error between object and hand elsewhere."""
        problem, n = fit.problem, len(self.cameras)
        rng = np.random.default_rng(0)
        middle, reach = problem.joints.mean(0), LIKELY_REACH * np.ones(problem.robot.n_joints)
        joints = middle + rng.uniform(-reach, reach, (ELSEWHERE, len(reach)))
        pairs = np.array(list(self.views)).repeat(ELSEWHERE, 0).T
        at = np.tile(np.arange(ELSEWHERE), len(self.views))
        nothing = np.zeros((len(at), 3))
        corners = Corners(nothing[:, :2], nothing, at, pairs[0], pairs[1], at)
        _, _, seen = replace(problem, joints=joints, corners=corners).expected(fit.state)
        errors = np.einsum("nij,jk,nik->n", seen, fit.covariance(), seen) ** 0.5
        expected = np.median(errors.reshape(len(self.views), -1), axis=1)
        if (worst := float(expected.max())) > LARGEST_EXPECTED:
            i, j = list(self.views)[int(expected.argmax())]
            raise DataError(
                f"{self._missing(n + j)}: elsewhere the error between what is in the hand and "
                f"what camera {self.cameras[i]!r} sees may be {1e3 * min(worst, 1):.0f} mm"
            )

    def _missing(self, part: int) -> str:
        """What postures lack."""
        problem = self.problem
        links, jacobians = problem.placed(problem.state(np.tile(np.eye(4), (problem.n_poses, 1, 1))))
        used = np.unique(problem.corners.posture)
        turns = Rotation.from_matrix(links[used, problem.links[part], :3, :3])
        vectors = (turns * turns.mean().inv()).as_rotvec()
        spreads, axes = np.linalg.eigh(vectors.T @ vectors / len(used))
        lacking = [
            "the vertical" if abs(axis[2]) > 0.8 else f"({', '.join(f'{x:.1f}' for x in axis)})"
            for spread, axis in zip(spreads, axes.T, strict=True)
            if np.sqrt(max(spread, 0)) < HARDLY / 2
        ]
        moved = np.degrees(np.ptp(problem.joints[used], axis=0))
        movers = np.abs(jacobians[:, problem.links[part]]).max((0, 1)) > 1e-9
        still = [
            f"{name} ({moved[k]:.0f} deg)"
            for k, name in enumerate(problem.robot.joint_names)
            if movers[k] and moved[k] < np.degrees(HARDLY)
        ]
        text = f"{len(used)} postures are too few or too similar"
        if lacking:
            text += f", there is no rotation of the hand about {' and '.join(lacking)}"
        return f"{text}: " + (
            f"turn {', '.join(still)} by 45 deg and more"
            if still
            else "take 30, in which all joints differ by 45 deg and more"
        )

    def scales(self, fit: Adjustment) -> tuple[str, ...]:
        """Whether another focal length or size of tags explains clearly more, and which."""
        problem = fit.problem
        gains, values, errors = [], [], []
        for number in range(len(self.cameras) + 1):
            free = problem.free.copy()
            free[problem.scales.start + number] = True
            other = adjust(replace(problem, free=free), fit.state)
            gains.append(fit.surprise - other.surprise)
            values.append(100 * other.problem.split(other.state)[2][number])
            errors.append(100 * other.covariance()[problem.scales, problem.scales][number, number] ** 0.5)
        best = max(gains)
        if best < SCALE_EVIDENCE:
            return ()
        texts = [
            f"the focal length of camera {name!r} is {abs(value):.1f} +- {error:.1f} % too "
            f"{'small' if value > 0 else 'large'} (tpgmm calibrate camera; are its pictures "
            "those that it was calibrated with, not cropped or scaled?)"
            for name, value, error in zip(self.cameras, values, errors, strict=False)
        ]
        texts.append(
            f"tags are {abs(values[-1]):.1f} +- {errors[-1]:.1f} % {'larger' if values[-1] > 0 else 'smaller'} "
            "than the cell says (measure one with a ruler)"
        )
        return (" or ".join(t for t, gain in zip(texts, gains, strict=True) if best - gain < SCALE_EVIDENCE / 2),)

    def result(self, fit: Adjustment, unknown: NDArray[np.bool_], problems: tuple[str, ...]) -> CellCalibration:
        """The calibration, with errors on pictures left out."""
        problem, n = fit.problem, len(self.cameras)
        used, far, turned = problem.corners.posture, list[float](), list[float]()
        for fold in range(FOLDS):
            kept = used % FOLDS != fold
            part = adjust(replace(problem, corners=problem.corners.of(kept)), fit.state, fit.noise)
            placed = problem.carried(part.state)
            for (i, j), (postures, poses) in self.views.items():
                for k, pose in zip(postures, poses, strict=True):
                    if k % FOLDS == fold:
                        away = inverse(placed[k, i] @ pose) @ placed[k, n + j]
                        far.append(float(np.linalg.norm(away[:3, 3])))
                        turned.append(angle_between(np.eye(4), away))
        poses, offsets, _ = problem.split(fit.state)
        names, spread = problem.robot.joint_names, np.sqrt(np.diag(fit.covariance()))[problem.offsets]
        moving = self.problem.free[problem.offsets]
        pixels, _, _ = self.problem.expected(fit.state)
        expected: dict[str, list[dict[int, Array]]] = {
            name: [{} for _ in problem.joints] for name in self.cameras
        }
        c = self.problem.corners
        for first in range(0, len(pixels), 4):
            expected[self.cameras[c.camera[first]]][c.posture[first]][int(c.number[first])] = pixels[first : first + 4]
        return CellCalibration(
            dict(zip(self.cameras, poses[:n], strict=True)),
            dict(zip(self.mounts, poses[n:], strict=False)),
            dict(zip(self.bases, poses[len(problem.carriers) :], strict=True)),
            {name: float(offsets[k]) for k, name in enumerate(names) if moving[k]},
            {name: float(spread[k]) for k, name in enumerate(names) if moving[k]},
            tuple(name for k, name in enumerate(names) if unknown[k]),
            np.array(far), np.array(turned), fit.noise.joints, problems, expected,
        )  # fmt: skip


def _divided(fit: Adjustment, part: int, at: int) -> tuple[Reprojection, Array, int]:
    """The problem with one part as two, before and after a posture; and where the new one is."""
    problem, n = fit.problem, len(fit.problem.cameras)
    corners, cameras, carriers = problem.corners, list(problem.cameras), list(problem.carriers)
    poses, offsets, _ = problem.split(fit.state)
    late, new = corners.posture >= at, n if part < n else len(carriers)
    if part < n:
        cameras.append(cameras[part])
        corners = replace(corners, camera=np.where(late & (corners.camera == part), n, corners.camera))
    else:
        corners = replace(corners, target=np.where(late & (corners.target == part - n), new - n, corners.target))
    carriers.insert(new, carriers[part])
    free = np.zeros(0, dtype=bool)
    other = replace(problem, corners=corners, cameras=cameras, carriers=carriers, free=free)
    state = other.state(np.insert(poses, new, poses[part], axis=0))
    other.split(state)[1][:] = offsets
    return other, state, new


def _check(
    robot: Kinematics,
    joints: Array,
    seen: Mapping[str, Sequence[Detections]],
    cameras: Mapping[str, CellCamera],
    mounts: Mapping[str, Mount],
    bases: Sequence[str],
) -> None:
    """Refuse what does not go together."""
    if joints.shape[1:] != (robot.n_joints,) or not np.isfinite(joints).all():
        raise DataError(
            f"joints are finite and of shape (n, {robot.n_joints}), those of "
            f"{list(robot.joint_names)}; got {joints.shape}"
        )
    if not seen or not mounts:
        raise DataError("a cell is calibrated by one camera and one target at least")
    for name, found in seen.items():
        if name not in cameras:
            raise UnknownNameError("camera", name, "the cell", cameras)
        if len(found) != len(joints):
            raise DataError(f"camera {name!r} has {len(found)} pictures for {len(joints)} rows")
        for posture, one in enumerate(found):
            if twice := sorted(one.twice):
                raise DataError(
                    f"camera {name!r} sees tags {twice} twice in picture {posture}: each number "
                    "may be there once; cover or remove the others"
                )
    numbers = [number for mount in mounts.values() for number in mount.target.corners]
    if len(set(numbers)) < len(numbers):
        raise DataError(f"targets share numbers of tags, got {sorted(numbers)}")
    links = [cameras[name].link for name in seen] + [mount.link for mount in mounts.values()]
    for link in links:
        if link is not None and link not in robot.links:
            raise UnknownNameError("link", link, "the robot", robot.links)
    if all(link is None for link in links):
        raise DataError("no camera and no target is on a link of the robot: nothing moves")
    for base in bases:
        own = [link for link in robot.links if link.startswith(base)]
        if not own or len(own) == len(robot.links):
            raise DataError(f"links of an arm begin with {base!r}, not all; got {robot.links}")

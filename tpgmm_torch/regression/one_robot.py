"""The estimate of one robot in numpy: of few numbers it takes a third of torch's time.

The same terms as for batches, from the same constants: operators linearised as in
:mod:`~tpgmm_torch.operators.pose`, the Kalman update of :mod:`~tpgmm_torch.regression.fusion`,
or the sum of information where no operator determines the joints, and the moments of the
mixture. What is not served here (gradients, other operators, numbers that are not finite) is
answered by None: then the estimate in torch does it, or says what is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.linalg import lapack
from torch import Tensor

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.operators import Canonical, Operator
from tpgmm_torch.operators.base import leaves
from tpgmm_torch.operators.pose import constants_of
from tpgmm_torch.operators.stack import POSE_OPERATORS
from tpgmm_torch.regression.conditionals import Components
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

#: What this module does not serve.
NOT_SERVED = RuntimeError, KeyError, np.linalg.LinAlgError


class Links(NamedTuple):
    """The links of one robot in numpy.

    Parameters
    ----------
    names : tuple of str
        Of the L links.
    positions, orientations : ndarray of shape (L, 3) and (L, 4)
    rows : ndarray of shape (2 L + 1, 3, n_joints)
        Of each link, how it moves and how it turns; three rows of zeros at the end.
    carriers : tuple of int
        Of each of the last links, which are objects, the link that carries it, -1 if free.
    """

    names: tuple[str, ...]
    positions: Array
    orientations: Array
    rows: Array
    carriers: tuple[int, ...] = ()

    @classmethod
    def of(cls, state: RobotState) -> Links:
        """Convert the state of one robot.

        Parameters
        ----------
        state : RobotState
        """
        jacobians = state.jacobians.numpy()
        rows = np.zeros((2 * len(state.links) + 1, 3, jacobians.shape[-1]))
        rows[:-1] = jacobians.reshape(-1, *rows.shape[1:])
        poses = state.positions.numpy(), state.orientations.numpy()
        return cls(state.links, *poses, rows, tuple(map(int, state.carriers)))


class Rows(NamedTuple):
    """What an operator says of one robot, see :class:`Linearization`.

    Parameters
    ----------
    jacobian, matrix, displacement : ndarray of shape (m, n_joints), (m, D) and (m,)
        ``J (q - q_{t-1}) = M mu + c``.
    present : ndarray of shape (D,), optional
    noise : ndarray of shape (m,), optional
    """

    jacobian: Array
    matrix: Array
    displacement: Array
    present: Array | None = None
    noise: Array | None = None


class Mixture(NamedTuple):
    """The arrays of :class:`Components`.

    Parameters
    ----------
    places : ndarray of shape (A, K)
    log_peak, mean, precision : ndarray of shape (A,)
        Of the time marginals.
    local : tuple
        Of each conditional: means, gains, covariances, and the times of the means (A, 1).
    """

    places: Array
    log_peak: Array
    mean: Array
    precision: Array
    local: tuple[tuple[Array, Array, Array, Array], ...]

    @classmethod
    def of(cls, components: Components) -> Mixture:
        """Convert what needs no gradient.

        Parameters
        ----------
        components : Components
        """
        times = components.marginals
        marginals = times.log_peak.numpy(), times.mean.numpy(), times.precision.numpy()
        local = tuple(
            (c.mean.numpy(), c.gain.numpy(), c.covariance.numpy(), c.time_mean[:, None].numpy())
            for c in components.conditionals
        )
        return cls(components.places.numpy(), *marginals, local)

    def weights(self, time: float) -> Array:
        """Compute mixing weights (A,).

        Parameters
        ----------
        time : float
            [s].
        """
        elapsed = time - self.mean
        log_h = self.log_peak - 0.5 * self.precision * elapsed * elapsed
        shares = np.exp(log_h - log_h.max())
        return np.asarray(shares / shares.sum())


class Task:
    """An operator on one robot.

    Parameters
    ----------
    operator : Operator
        Of some joints, or of links.
    kinematics : Kinematics
    """

    def __init__(self, operator: Operator, kinematics: Kinematics) -> None:
        self._constants: dict[Any, Any] = {}
        self._columns: list[int] | None = None
        size = operator.dimension(kinematics)
        if isinstance(operator, Canonical):
            self._columns = list(operator.columns(kinematics.joint_names))
            self._rows = np.eye(kinematics.n_joints)[self._columns], np.eye(size)
            return
        self._terms = tuple(leaf.term for leaf in leaves([operator]))  # type: ignore[attr-defined]
        starts = operator.quaternion_starts(kinematics)
        #: The coordinates that make up the same quaternion.
        self._same = np.zeros((size, size))
        for start in starts:
            self._same[start : start + 4, start : start + 4] = 1.0
        self._others = 1.0 - self._same.diagonal()

    def linearize(self, joints: Array, links: Links, frames: Frames) -> Rows:
        """Compute ``J``, ``M``, ``c`` of a posture; see :func:`linearize_poses`.

        Parameters
        ----------
        joints : ndarray of shape (n_joints,)
        links : Links
        frames : mapping of str to Frame
        """
        if self._columns is not None:
            return Rows(*self._rows, -joints[self._columns])
        at = self._at(links)
        places = [frames[name] for name in at.places]
        positions, orientations = links.positions, links.orientations
        if places or at.base:
            points = [place.position.numpy()[None] for place in places] + at.base_point
            turns = [place.orientation.numpy()[None] for place in places] + at.base_turn
            positions = np.concatenate((positions, *points))
            orientations = np.concatenate((orientations, *turns))
        way = positions.take(at.seen_from, 0) - positions.take(at.seen, 0)
        way *= at.is_position
        first, second = orientations.take(at.first, 0), orientations.take(at.seen_from, 0)
        pairs = first[:, :, None] * second[:, None, :]
        numbers = (pairs.reshape(-1) @ at.matrix).reshape(at.shape)
        jacobian = links.rows.take(at.rows, 0)
        if at.is_moving:
            swing = _cross(links.rows.take(at.angular_rows, 0), way[:, :, None])
            jacobian = jacobian - links.rows.take(at.reference_rows, 0) + swing
        rows = Rows(
            jacobian.reshape(-1, joints.size), numbers[:-1], way.reshape(-1), numbers[-1]
        )
        carriers = (*at.robot_links, *links.carriers, *[-1] * (len(places) + len(at.base)))
        rigid = [carriers[one] == carriers[other] for one, other in at.bodies]
        return _drop(rows, np.repeat(rigid, 3)) if any(rigid) else rows

    def _at(self, links: Links) -> Any:
        """Return the constants of :func:`linearize_poses` in numpy."""
        key = links.names, len(links.carriers)
        if key not in self._constants:
            given = constants_of(self._terms, *key, torch.float64, torch.device("cpu"))
            one = {n: v.numpy() if isinstance(v, Tensor) else v for n, v in vars(given).items()}
            one["robot_links"] = range(len(links.names) - len(links.carriers))
            one["base_point"] = [base.position.numpy()[None] for base in given.base]
            one["base_turn"] = [base.orientation.numpy()[None] for base in given.base]
            self._constants[key] = _Namespace(one)
        return self._constants[key]

    def near(self, rows: Rows, mean: Array) -> Array:
        """Return ``M`` (A or 1, m, D), for means on the side of the present quaternions.

        Parameters
        ----------
        rows : Rows
        mean : ndarray of shape (A, D)
            Of A components.
        """
        if rows.present is None:
            return rows.matrix[None]
        side = np.copysign(1.0, (mean * rows.present) @ self._same + self._others)
        return rows.matrix * side[:, None, :]


class OneRobot:
    """Estimates of one robot, of the kinds that :meth:`serves` tells.

    Parameters
    ----------
    kinematics : Kinematics
    operators : sequence of Operator
        Those that update a prior of the joints, as one, or none where the prior is all there
        is; or those whose information is added up.
    free_precision : Tensor of shape (n_joints,), optional
        Of the prior around q_{t-1} where information is added up.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        operators: Sequence[Operator],
        free_precision: Tensor | None = None,
    ) -> None:
        self._kinematics = kinematics
        self._posture = getattr(kinematics, "one_posture", None)
        self._tasks = [Task(operator, kinematics) for operator in operators]
        self._free = None if free_precision is None else np.diag(free_precision.numpy())
        self._mixtures: dict[Components, Mixture] = {}

    @staticmethod
    def serves(operators: Sequence[Operator], kinematics: Kinematics) -> bool:
        """Check that operators and robot are served: poses of links, and joints.

        Parameters
        ----------
        operators : sequence of Operator
        kinematics : Kinematics
        """
        like = kinematics.lower
        if like.dtype != torch.float64 or like.is_cuda or kinematics.quaternion_starts:
            return False
        linear = [one for one in operators if type(one) is not Canonical]
        kinds = [type(leaf) in POSE_OPERATORS for leaf in leaves(linear)]
        return all(kinds) and not any(one.rotation_vector_starts(kinematics) for one in linear)

    def __call__(
        self, components: Components, time: Tensor, state: Any, frames: Frames
    ) -> Estimate | None:
        """Estimate the joints; None if that is not served.

        Parameters
        ----------
        components : Components
            Those that count.
        time : Tensor of shape ()
        state : Tensor of shape (n_joints,), or RobotState
        frames : mapping of str to Frame
        """
        given = isinstance(state, RobotState)
        joints = state.joints if given else state
        if joints.shape != self._kinematics.lower.shape or torch.compiler.is_compiling():
            return None
        try:  # a tensor of which something is differentiated has no numbers
            if components not in self._mixtures:
                self._mixtures[components] = Mixture.of(components)
            mixture, now = self._mixtures[components], float(time.numpy())
            numbers = joints.numpy()
            links = self._links(state, numbers, given)
            steps, covariances = self._fuse(mixture.local, now, numbers, links, frames)
            weights = mixture.weights(now)
            step, covariance = _match_moments(weights, steps, covariances)
        except NOT_SERVED:
            return None
        if not math.isfinite(step @ step):
            return None
        joints, spread = torch.from_numpy(numbers + step), torch.from_numpy(covariance)
        return Estimate(joints, spread, torch.from_numpy(weights @ mixture.places))

    def _links(self, state: Any, joints: Array, given: bool) -> Links:
        """Find where the links are."""
        if given or self._posture is None:
            return Links.of(state if given else self._kinematics.state(state))
        return Links(self._kinematics.links, *self._posture(joints))

    def _fuse(
        self, local: Any, time: float, joints: Array, links: Links, frames: Frames
    ) -> tuple[Array, Array]:
        """Compute steps (A, n) of components, and their covariances (A, n, n)."""
        rows = [task.linearize(joints, links, frames) for task in self._tasks]
        means = [mean + gain * (time - start) for mean, gain, _, start in local]
        if self._free is not None:
            return self._add(rows, means, local)
        [mean], covariance = means, local[0][2]
        steps = mean[:, -joints.size :] - joints
        if not rows:
            return steps, covariance
        return self._update(rows[0], mean[:, : -joints.size], steps, covariance)

    def _update(
        self, at: Rows, mean: Array, steps: Array, covariance: Array
    ) -> tuple[Array, Array]:
        """Update a prior of the joints, see :mod:`~tpgmm_torch.regression.fusion`."""
        count, width = mean.shape
        size, n = at.jacobian.shape
        rows = np.empty((count, size, width + n))
        rows[:, :, :width] = self._tasks[0].near(at, mean)
        rows[:, :, width:] = -at.jacobian
        cross = rows @ covariance
        square = cross @ rows.swapaxes(1, 2)
        if at.noise is not None:
            square = square + np.diag(at.noise)
        both = np.concatenate((mean, steps), 1)[:, :, None]
        right = np.concatenate((cross[:, :, width:], rows @ both + at.displacement[:, None]), 2)
        white = np.array([_whiten(*pair) for pair in zip(square, right, strict=True)])
        update = white[:, :, :n].swapaxes(1, 2) @ white
        return steps - update[:, :, n], covariance[:, width:, width:] - update[:, :, :n]

    def _add(
        self, rows: Sequence[Rows], means: Sequence[Array], local: Any
    ) -> tuple[Array, Array]:
        """Add up the operators' information, in terms of the step."""
        assert self._free is not None
        count, n = len(means[0]), len(self._free)
        sums = np.zeros((count, n, n + 1))
        sums[:, :, :n] = self._free
        for task, at, mean, (_, _, covariance, _) in zip(
            self._tasks, rows, means, local, strict=True
        ):
            matrix = task.near(at, mean)
            target = (matrix @ mean[:, :, None])[:, :, 0] + at.displacement
            square = matrix @ covariance @ matrix.swapaxes(1, 2)
            if at.noise is not None:
                square = square + np.diag(at.noise)
            for k in range(count):
                right = np.concatenate((at.jacobian, target[k][:, None]), 1)
                white = _whiten(square[k], right)
                sums[k] += white[:, :n].T @ white
        steps, covariances = np.empty((count, n)), np.empty((count, n, n))
        for k in range(count):
            factor = _factorize(sums[k, :, :n])
            steps[k], _ = lapack.dpotrs(factor, sums[k, :, n], lower=1)
            white, _ = lapack.dtrtrs(factor, np.eye(n), lower=1)
            covariances[k] = white.T @ white
        return steps, covariances


class _Namespace:
    """Values by name, as attributes."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        vars(self).update(values)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(name)


def _cross(matrix: Array, vector: Array) -> Array:
    """Compute ``m x v``, column by column: shapes (P, 3, n) and (P, 3, 1)."""
    after, before = [1, 2, 0], [2, 0, 1]
    return np.asarray(
        matrix[:, after] * vector[:, before] - matrix[:, before] * vector[:, after]
    )


def _drop(rows: Rows, rigid: Array) -> Rows:
    """Make rows ``0 = 0``, see :meth:`Linearization.without`."""
    active = 1.0 - rigid
    column = active[:, None]
    parts = rows.jacobian * column, rows.matrix * column, rows.displacement * active
    return Rows(*parts, rows.present, 1.0 * rigid)


def _factorize(matrix: Array) -> Array:
    """Compute the lower Cholesky factor."""
    factor, failed = lapack.dpotrf(matrix, lower=1)
    if failed:
        raise np.linalg.LinAlgError
    return np.asarray(factor)


def _whiten(covariance: Array, right: Array) -> Array:
    """Compute ``L^-1 R``; see :func:`~tpgmm_torch.gaussians.whiten`."""
    white, _ = lapack.dtrtrs(_factorize(covariance), right, lower=1)
    return np.asarray(white)


def _match_moments(weights: Array, means: Array, covariances: Array) -> tuple[Array, Array]:
    """Compute moments of a mixture; see :func:`~tpgmm_torch.gaussians.moment_match`."""
    mean = weights @ means
    rest = means - mean
    within = (weights @ covariances.reshape(len(weights), -1)).reshape(covariances.shape[1:])
    return mean, within + (weights[:, None] * rest).T @ rest

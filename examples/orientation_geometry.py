"""Orientations in four coordinates or in three: which form is nearer to what is held out.

    python examples/orientation_geometry.py wide
    python examples/orientation_geometry.py g1 path/to/g1_bottle
    python examples/orientation_geometry.py honeytea path/to/honeytea_bimanual

``wide``: a hand turns by two radians; eight demonstrations lie more than 90 degrees apart, with
random signs of their quaternions. The error is that of the reproduction to the demonstrations'
Karcher mean, the rotation to which their squared angles add up to the least.

The recordings are those of ``leave_one_out.py``, and so are the folds. Both models have the
same settings and data and differ in the ``geometry`` of their orientation operators alone. The
log-likelihood per time step counts orientations per volume of rotations, of time and of all
operators' coordinates.
"""

import argparse
import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from leave_one_out import ALIGNMENTS, RECORDINGS, degrees_between, pose_at
from torch import Tensor

from tpgmm_torch import (
    AbsoluteOrientation,
    Demonstration,
    RelativeOrientation,
    Situation,
    Stack,
    TaskParameterizedGMM,
    gaussians,
    quaternions,
)
from tpgmm_torch.exceptions import PlausibilityWarning
from tpgmm_torch.operators import Operator
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots import Poses
from tpgmm_torch.training.mixture_settings import block_widths

GEOMETRIES = ("quaternion", "tangent")
TIME = torch.linspace(0, 3, 90, dtype=torch.float64)
#: How much wider proposals are than what is integrated, as a factor of the covariance.
WIDER = 1.2


def with_geometry(operator: Operator, geometry: str) -> Operator:
    """The operator, or a stack's members, with that geometry where they have one."""
    if isinstance(operator, Stack):
        return Stack(*(with_geometry(member, geometry) for member in operator.operators))
    if isinstance(operator, AbsoluteOrientation | RelativeOrientation):
        return replace(operator, geometry=geometry)
    return operator


def far_apart(seed: int, spread: float) -> list[Demonstration]:
    """Eight turns of a hand, each turned from the first by a normal rotation vector [rad]."""
    rng = np.random.default_rng(seed)
    axes = torch.from_numpy(rng.standard_normal((2, 3)))
    axes = axes / axes.norm(dim=1, keepdim=True)
    share = (1 - torch.cos(math.pi * TIME / 3))[:, None] / 2
    sway = torch.sin(2 * math.pi * TIME / 3)[:, None] / 2
    turn = quaternions.product(
        quaternions.exp(2 * share * axes[0]), quaternions.exp(sway * axes[1])
    )
    shown = []
    for _ in range(8):
        apart, other = torch.from_numpy(spread * rng.standard_normal((2, 3)))
        vector = apart + 0.2 * torch.sin(math.pi * TIME / 3)[:, None] * other
        # all within half a turn of the middle
        length = torch.linalg.vector_norm(vector, dim=1, keepdim=True)
        vector = vector * (2.6 / length).clamp(max=1)
        signs = torch.from_numpy(rng.choice([-1.0, 1.0], (len(TIME), 1)))
        q = signs * quaternions.product(turn, quaternions.exp(vector))
        shown.append(Demonstration(TIME, torch.cat((torch.zeros(len(TIME), 3), q), 1)))
    return shown


def mean_error(shown: Sequence[Demonstration], geometry: str) -> float:
    """Of a reproduction, to the demonstrations' mean, over time [deg]."""
    wanted = quaternions.mean(torch.stack([one.joints[:, 3:] for one in shown], 1))
    operator = AbsoluteOrientation("hand", geometry=geometry)
    # every demonstration counts, however far from the others
    model = TaskParameterizedGMM(6, [operator], Poses(["hand"]))
    start = torch.cat((torch.zeros(3, dtype=torch.float64), wanted[0]))
    [found] = model.fit(shown).predict([Situation(start)], candidates=False)
    return float(degrees_between(quaternions.normalize(found.joints[:, 3:]), wanted).mean())


def wide(seeds: int = 20) -> dict[float, np.ndarray]:
    """Errors (seeds, 2) [deg] by the spread of the rotation vectors [rad]."""
    return {
        spread: np.array(
            [[mean_error(far_apart(s, spread), g) for g in GEOMETRIES] for s in range(seeds)]
        )
        for spread in (0.45, 0.7, 0.9)
    }


def rotation_log_density(
    regression: Regression, time: Tensor, local: Sequence[Tensor], n_samples: int = 400
) -> Tensor:
    """Compute the log-density (T,) of time and local coordinates, per volume of rotations.

    Quaternions have a density over four coordinates, rotation vectors one over three: they are
    compared as densities of rotations, whose volume is that of small rotation vectors [rad^3],
    ``8 pi^2`` in all. That of a rotation vector y is divided by ``det J_l(y)``. A Gaussian over
    four coordinates is restricted to unit quaternions and normalised there,

        p(x, eps | t) = sum_i h_i p_i(x, eps | t) / sum_i h_i Z_i,
        Z_i = int p_i(eps | t) d eps   over one hemisphere about the mean,

    by importance sampling in the tangent space of the mean's direction.
    """
    total = regression.log_density(time, local)
    constant, four = time.new_zeros(()), False
    for operator, one, x in zip(
        regression.operators, regression.conditionals, local, strict=True
    ):
        for start in operator.rotation_vector_starts(regression.kinematics):
            vector = x[:, start : start + 3]
            total = total - torch.linalg.det(quaternions.left_jacobian(vector)).log()
        starts = operator.quaternion_starts(regression.kinematics)
        if starts and operator.links():
            columns = torch.tensor([start + i for start in starts for i in range(4)])
            constant = constant + _log_mass(one.marginal(columns), time, n_samples)
            four = True
    if not four:
        return total
    activation = torch.log_softmax(regression.marginals.log_activation(time[:, None]), -1)
    return total - torch.logsumexp(activation + constant, -1)


def _log_mass(one: Conditionals, time: Tensor, n_samples: int) -> Tensor:
    """Compute log Z (T, K), the mass that Gaussians over quaternions leave to rotations."""
    mean, covariance = one.at(time), one.covariance
    count = mean.shape[-1] // 4
    centre = torch.nn.functional.normalize(mean.unflatten(-1, (count, 4)), dim=-1)
    basis = mean.new_zeros(*mean.shape, 3 * count)
    for k in range(count):
        turned = quaternions.left_matrix(centre[..., k, :])[..., 1:]
        basis[..., 4 * k : 4 * k + 4, 3 * k : 3 * k + 3] = 0.5 * turned
    factor = gaussians.cholesky(covariance, "the covariance of a component")
    white = torch.linalg.solve_triangular(factor, basis, upper=False)
    wide = gaussians.cholesky(WIDER * torch.linalg.inv(white.mT @ white), "a proposal")
    generator = torch.Generator().manual_seed(0)
    draws = torch.randn(n_samples, 3 * count, generator=generator, dtype=torch.float64)
    draws = draws.to(mean)
    vectors = (wide.unsqueeze(-3) @ draws.unsqueeze(-1))[..., 0].unflatten(-1, (count, 3))
    proposal = -0.5 * draws.square().sum(-1) - _log_normaliser(wide).unsqueeze(-1)
    q = quaternions.product(centre.unsqueeze(-3), quaternions.exp(vectors)).flatten(-2)
    residual = torch.linalg.solve_triangular(factor, (q - mean.unsqueeze(-2)).mT, upper=False)
    density = -0.5 * residual.square().sum(-2) - _log_normaliser(factor).unsqueeze(-1)
    volume = torch.linalg.det(quaternions.left_jacobian(vectors)).clamp(min=1e-300).log()
    inside = (torch.linalg.vector_norm(vectors, dim=-1) < math.pi).all(-1)
    terms = torch.where(inside, density + volume.sum(-1) - proposal, -torch.inf)
    return terms.logsumexp(-1) - math.log(n_samples)


def _log_normaliser(factor: Tensor) -> Tensor:
    """Compute ``log sqrt(|2 pi L L^T|)``."""
    diagonal = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return diagonal + 0.5 * factor.shape[-1] * math.log(2 * math.pi)


def log_likelihood(model: TaskParameterizedGMM, shown: Demonstration) -> float:
    """Per time step, orientations per volume of rotations."""
    [row] = model.rows([shown])
    widths = block_widths(model.operators_, model.kinematics_)
    blocks = row.split(list(widths), 1)
    local = [block[:, 1:] for block in blocks]
    return float(rotation_log_density(model.skill, blocks[0][:, 0], local).mean())


def held_out(kind: str, folder: Path, components: int, step: int) -> np.ndarray:
    """Log-likelihood, errors at the event [mm], [deg]: (folds, 2, 3)."""
    recording, rows = RECORDINGS[kind](folder), []
    operators = next(iter(recording.models.values()))
    for fold in range(0, len(recording.demonstrations), step):
        test = recording.demonstrations[fold]
        others = [one for one in recording.demonstrations if one is not test]
        clock = ALIGNMENTS["dtw"](recording.robot)
        aligned = clock.fit_transform(others)
        [shown] = clock.transform([test])
        usual = float(np.median([one.events[recording.event] for one in aligned]))
        truth = pose_at(recording, test.joints, test.time, test.events[recording.event])
        rows.append([])
        for geometry in GEOMETRIES:
            chosen = [with_geometry(operator, geometry) for operator in operators]
            model = TaskParameterizedGMM(components, chosen, recording.robot, random_state=0)
            situation = Situation(test.joints[0], test.frames, clock.time_)
            [found] = model.fit(aligned).predict([situation], candidates=False)
            reached = pose_at(recording, found.joints, clock.time_, usual)
            away: Tensor = reached.position - truth.position
            turned = degrees_between(reached.orientation, truth.orientation)
            values = log_likelihood(model, shown), 1e3 * float(away.norm()), float(turned)
            rows[-1].append(values)
    return np.array(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("kind", choices=("wide", *RECORDINGS))
    parser.add_argument("folder", type=Path, nargs="?", help="LeRobot data set")
    parser.add_argument("--components", type=int, default=10, help="K")
    parser.add_argument("--every", type=int, default=1, help="hold out each so-manieth episode")
    parser.add_argument("--seeds", type=int, default=20, help="of the generated turns")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore", PlausibilityWarning)
    if options.kind == "wide":
        for spread, found in wide(options.seeds).items():
            cells = [
                f"{name} {np.median(e):.2f} ({e.min():.2f} to {e.max():.2f})"
                for name, e in zip(GEOMETRIES, found.T, strict=True)
            ]
            print(f"spread {spread} rad: {', '.join(cells)} deg")
        return
    found = held_out(options.kind, options.folder, options.components, options.every)
    for name, values in zip(GEOMETRIES, found.swapaxes(0, 1), strict=True):
        likelihood, far, turned = values.T
        print(
            f"{name:11} log-likelihood {likelihood.mean():.2f}; at the event, median (90 %): "
            f"{np.median(far):.2f} ({np.quantile(far, 0.9):.2f}) mm, "
            f"{np.median(turned):.2f} ({np.quantile(turned, 0.9):.2f}) deg"
        )
    gain = found[:, 1, 0] - found[:, 0, 0]
    error = gain.std(ddof=1) / len(gain) ** 0.5
    print(
        f"tangent more likely by {gain.mean():.2f} +- {error:.2f}, in {(gain > 0).mean():.0%}"
    )


if __name__ == "__main__":
    main()

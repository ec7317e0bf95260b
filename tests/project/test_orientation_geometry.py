"""Densities over rotations are normalised, whatever coordinates they were learned in."""

import math
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

from tpgmm_torch import (
    AbsoluteOrientation,
    Demonstration,
    Frame,
    RelativePosition,
    TaskParameterizedGMM,
    quaternions,
)
from tpgmm_torch.robots import Poses

EXAMPLES = Path(__file__).parents[2] / "examples"
HAND = Poses(("hand",))
TIME = torch.linspace(0, 2, 40, dtype=torch.float64)


@pytest.fixture(scope="module")
def rotation_log_density():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        return runpy.run_path(str(EXAMPLES / "orientation_geometry.py"))["rotation_log_density"]


def recordings(spread):
    rng = np.random.default_rng(1)
    shown = []
    for _ in range(7):
        apart = torch.from_numpy(spread * rng.standard_normal(3))
        q = quaternions.exp(apart + TIME[:, None] * torch.tensor([0.3, 0.9, -0.4]).double())
        shown.append(Demonstration(TIME, torch.cat((0.1 * TIME[:, None] * apart, q), 1)))
    return shown


def fitted(operator, spread):
    skill = TaskParameterizedGMM(4, [operator], HAND)
    return skill.fit(recordings(spread))


@pytest.mark.parametrize("geometry", ["quaternion", "tangent"])
@pytest.mark.parametrize("spread", [0.2, 0.5])
def test_the_density_is_normalised_over_rotations(geometry, spread, rotation_log_density):
    """Over SO(3), whose volume is 8 pi^2, at one instant, by uniform rotations."""
    regression = fitted(AbsoluteOrientation("hand", geometry=geometry), spread).skill
    rng = np.random.default_rng(0)
    count = 200_000
    q = quaternions.normalize(torch.from_numpy(rng.standard_normal((count, 4))))
    now = torch.tensor(0.8, dtype=torch.float64)
    state = HAND.state(torch.cat((torch.zeros(count, 3), q), 1))
    [operator] = regression.operators
    local = operator.at(now).coordinates(state, {})
    if geometry == "quaternion":
        local = quaternions.match_hemisphere(local, regression.expect(0, now[None]))
    time = now.expand(count)
    marginal = regression.marginals.log_activation(now[None]).logsumexp(-1)
    log_time = marginal - 0.5 * math.log(2 * math.pi)
    # one instant has one normalisation
    first = rotation_log_density(regression, time[:1], [local[:1]], 4000)
    if geometry == "quaternion":
        constant = first - regression.log_density(time[:1], [local[:1]])
        density = regression.log_density(time, [local]) + constant
    else:
        density = rotation_log_density(regression, time, [local])
    total = float((density - log_time).exp().mean()) * 8 * math.pi**2
    assert total == pytest.approx(1.0, abs=0.1)  # of so many rotations it is known to 0.03


def test_without_orientations_it_is_the_likelihood(rotation_log_density):
    shown = recordings(0.2)
    operator = RelativePosition("hand", "here")
    shown = [Demonstration(d.time, d.joints, {"here": Frame([0.0, 0.0, 0.0])}) for d in shown]
    skill = TaskParameterizedGMM(3, [operator], HAND).fit(shown)
    [block] = skill.rows(shown[:1])
    regression = skill.skill
    found = rotation_log_density(regression, block[:, 0], [block[:, 1:]])
    assert torch.equal(found, regression.log_density(block[:, 0], [block[:, 1:]]))

"""Conditioning on via-points: exact where it is asked, faded elsewhere, honest in between."""

import math

import pytest
import torch

from tests.support.refusals import refused
from tests.support.skills import bottle_demonstrations, handlings, hands, small_bottle
from tpgmm_control import Controller, rollout
from tpgmm_torch import (
    Frame,
    Situation,
    ViaPoints,
    quaternions,
)
from tpgmm_torch.exceptions import DataError, PlausibilityWarning
from tpgmm_torch.operators.text import parse_operator
from tpgmm_torch.skills.via_point import ViaPoint
from tpgmm_torch.skills.via_points import covariance_between, wendland

GRID = torch.linspace(0, 5, 251, dtype=torch.float64)


def spread(n, seed):
    generator = torch.Generator().manual_seed(seed)
    basis = torch.linalg.qr(torch.randn(n, n, generator=generator, dtype=torch.float64))[0]
    sizes = 10 ** (6 * torch.rand(n, generator=generator, dtype=torch.float64) - 6)
    return basis @ torch.diag(sizes) @ basis.mT


def situation(index=2):
    shown = bottle_demonstrations()[index]
    return Situation(shown.joints[0], shown.frames, GRID)


def free(index=2):
    [trajectory] = small_bottle().predict([situation(index)], candidates=False)
    return trajectory


def at_hand(when, shift, turn, index=2):
    """A pose of the left hand near that of the reproduction."""
    step = int((when - GRID).abs().argmin())
    pose = small_bottle().kinematics_.state(free(index).joints[step]).pose("l_hand")
    moved = quaternions.exp(torch.tensor(turn, dtype=torch.float64))
    return Frame(
        pose.position + torch.tensor(shift), quaternions.product(moved, pose.orientation)
    )


def whitened(moved, covariance):
    factor = torch.linalg.cholesky(covariance)
    white = torch.linalg.solve_triangular(factor, moved.unsqueeze(-1), upper=False)
    return white[..., 0].norm(dim=-1)


def test_the_covariance_between_instants_solves_its_equation():
    one, other = spread(4, 0), spread(4, 1)
    between = covariance_between(one, other)
    left = torch.linalg.inv(one) @ between + between @ torch.linalg.inv(other)
    assert torch.allclose(left, 2 * torch.eye(4, dtype=torch.float64), atol=1e-6)
    assert torch.allclose(covariance_between(one, one), one, atol=1e-12)
    assert torch.allclose(between, covariance_between(other, one).mT, atol=1e-12)


def test_the_covariance_over_many_instants_is_positive():
    spreads = [spread(3, seed) for seed in range(6)]
    times = torch.arange(6, dtype=torch.float64) / 5
    k = wendland((times[:, None] - times).abs())
    whole = torch.cat(
        [
            torch.cat([k[i, j] * covariance_between(a, b) for j, b in enumerate(spreads)], 1)
            for i, a in enumerate(spreads)
        ]
    )
    scale = whole.diagonal().rsqrt()
    assert float(torch.linalg.eigvalsh(scale[:, None] * whole * scale).min()) > -1e-12


def test_the_correlation_falls_smoothly_to_zero():
    distance = torch.linspace(0, 1.5, 301, dtype=torch.float64)
    k = wendland(distance)
    assert k[0] == 1
    assert bool((k[distance >= 1] == 0).all())
    assert bool((k.diff() <= 0).all())
    assert float(k.diff().diff().abs().max()) < 1e-3  # no kink, at 0 neither


@pytest.mark.parametrize("when", [2.0, 3.8])
def test_a_pose_is_met_exactly_and_the_rest_is_as_it_was(when):
    pose = at_hand(when, [0.03, 0.0, 0.02], [0.1, 0.1, 0.0])
    model = ViaPoints(small_bottle().skill, [ViaPoint(when, "pose:l_hand", pose)])
    [bent] = rollout(model, situation())
    before, step = free(), int((when - GRID).abs().argmin())
    hand = model.kinematics.state(bent.joints[step]).pose("l_hand")
    assert float((hand.position - pose.position).norm()) < 1e-4
    turn = quaternions.product(hand.orientation, quaternions.conjugate(pose.orientation))
    assert math.degrees(float(quaternions.log(turn).norm())) < 0.01
    moved = bent.joints - before.joints
    sigmas, far = whitened(moved, before.covariance), (GRID - when).abs() > 1.0
    assert float(sigmas[far].max()) < 1e-2
    assert float(sigmas.max()) <= 1.05 * float(sigmas[step])
    # what is asked for is known there
    rows = model.kinematics.state(bent.joints[step]).linear_jacobian("l_hand")
    assert float((rows @ bent.covariance[step] @ rows.mT).diagonal().max()) < 1e-10
    assert float(torch.linalg.eigvalsh(bent.covariance).min()) > 0
    acceleration = bent.joints.diff(dim=0).diff(dim=0).abs().max()
    assert float(acceleration) < 3 * float(before.joints.diff(dim=0).diff(dim=0).abs().max())


def test_within_one_sigma_of_the_path_everything_is():
    before, step = free(), 150
    draw = torch.ones(17, dtype=torch.float64) / math.sqrt(17)
    posture = before.joints[step] + torch.linalg.cholesky(before.covariance[step]) @ draw
    via = ViaPoint(float(GRID[step]), "canonical", posture)
    model = ViaPoints(small_bottle().skill, [via])
    [bent] = rollout(model, situation())
    assert float((bent.joints[step] - posture).abs().max()) < 1e-4
    assert float(whitened(bent.joints - before.joints, before.covariance).max()) < 1.05


def test_a_tolerance_is_a_compromise():
    before, when, step = free(), 3.0, 150
    position = at_hand(when, [0.0, 0.0, 0.03], [0.0, 0.0, 0.0]).position
    reached = []
    for tolerance in (1e-4, 1e-2, 1.0):
        via = ViaPoint(when, "position:l_hand", position, tolerance)
        model = ViaPoints(small_bottle().skill, [via])
        [bent] = rollout(model, situation())
        hand = model.kinematics.state(bent.joints[step]).pose("l_hand").position
        reached.append(float((hand - position).norm()))
    assert reached == sorted(reached)
    assert reached[0] < 5e-4 and reached[-1] > 0.02
    assert torch.allclose(bent.joints, before.joints, atol=0.01)


def test_some_joints_and_two_hands_and_several_times():
    before, kinematics = free(), small_bottle().kinematics_
    elbow = kinematics.joint_names.index("l_elbow")
    wanted = float(before.joints[170, elbow]) + 0.05
    seen = parse_operator("position:l_hand@bottle")
    state, frames = kinematics.state(before.joints[150]), situation().frames
    raised = seen.coordinates(state, frames) + torch.tensor([0.0, 0.0, 0.02])
    right = state.pose("r_hand").position + torch.tensor([0.0, -0.02, 0.0])
    points = [
        ViaPoint(3.4, "canonical", {"l_elbow": wanted}),
        ViaPoint(3.0, seen, raised),
        ViaPoint(3.0, "position:r_hand", right),
    ]
    [bent] = rollout(ViaPoints(small_bottle().skill, points), situation())
    state = kinematics.state(bent.joints[150])
    assert float((seen.coordinates(state, frames) - raised).norm()) < 1e-4
    assert float((state.pose("r_hand").position - right).norm()) < 1e-4
    assert abs(float(bent.joints[170, elbow]) - wanted) < 1e-4


def test_robots_of_a_batch_do_not_know_of_each_other():
    pose = at_hand(3.0, [0.0, 0.0, 0.02], [0.0, 0.0, 0.0])
    model = ViaPoints(small_bottle().skill, [ViaPoint(3.0, "position:l_hand", pose.position)])
    both = rollout(model, [situation(2), situation(1)])
    [alone] = rollout(model, situation(1))
    assert torch.allclose(both[1].joints, alone.joints, atol=1e-7)


def test_a_controller_that_localizes_passes_too():
    pose = at_hand(3.0, [0.0, 0.0, 0.03], [0.0, 0.0, 0.0])
    model = ViaPoints(small_bottle().skill, [ViaPoint(3.0, "position:l_hand", pose.position)])
    start = situation()
    controller = Controller(model, start.joints, start.frames)
    robot, nearest = start.joints, math.inf
    for _ in range(250):
        controller.step(0.02, joints=robot, frames=start.frames)
        robot = robot + 0.6 * (controller.reference - robot)
        if abs(float(controller.time) - 3.0) < 1e-9:
            hand = model.kinematics.state(controller.reference).pose("l_hand").position
            nearest = float((hand - pose.position).norm())
    assert nearest < 1e-4
    assert abs(float(controller.time) - 4.98) < 1e-6  # it did not take the robot for lost


def test_tracked_poses_have_via_points():
    shown = handlings()[0]
    grid = torch.linspace(0, 2, 101, dtype=torch.float64)
    start = Situation(shown.joints[0], shown.frames, grid)
    [before] = hands().predict([start], candidates=False)
    pose = hands().kinematics_.state(before.joints[50]).pose("left")
    turn = quaternions.exp(torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64))
    place = pose.position + torch.tensor([0.0, 0.05, 0.0])
    pose = Frame(place, quaternions.product(turn, pose.orientation))
    model = ViaPoints(hands().skill, [ViaPoint(1.0, "pose:left", pose)], fade=0.5)
    [bent] = rollout(model, start)
    there = model.kinematics.state(bent.joints[50]).pose("left")
    assert float((there.position - pose.position).norm()) < 1e-4
    turn = quaternions.product(there.orientation, quaternions.conjugate(pose.orientation))
    assert math.degrees(float(quaternions.log(turn).norm())) < 0.01
    assert torch.allclose(bent.joints[80:], before.joints[80:], atol=1e-6)


def test_a_warning_names_via_points_out_of_reach():
    near = ViaPoints(small_bottle().skill, [ViaPoint(3.0, "canonical", {"l_elbow": 0.4})])
    model = ViaPoints(near, [ViaPoint(4.5, "position:l_hand", [3.0, 0.0, 1.0])])
    bounds = model.motion_bounds
    with pytest.warns(PlausibilityWarning, match="l_hand=3.* is missed by") as warned:
        [bent] = rollout(model, [situation()], bounds=bounds)
    assert len(warned) == 1
    speed = bent.joints.diff(dim=0).abs() / GRID.diff()[:, None]
    assert bool((speed <= bounds.velocity * 1.001).all())


def test_points_and_fade_are_kept_and_a_fade_takes_time():
    point = ViaPoint(1.0, "position:left@cup", [0.1, 0.1, 0.2], 0.01)
    model = ViaPoints(hands().skill, [point], fade=0.4)
    assert model.points == (point,) and model.fade == 0.4
    refused(lambda: ViaPoints(hands().skill, [], fade=0.0), DataError, "fade")


def test_frames_of_via_points_are_needed():
    shelf = Frame([0.3, 0.2, 0.1])
    model = ViaPoints(small_bottle().skill, ["3:position:l_hand@shelf=0,0,0.02~0.05"])
    assert "shelf" in model.frame_names
    given = situation()
    rollout(model, Situation(given.joints, {**given.frames, "shelf": shelf}, GRID[:20]))
    refused(lambda: rollout(model, given), KeyError, "shelf")

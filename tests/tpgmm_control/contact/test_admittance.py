"""Robots press with the demonstrated force on boards that are not where they are thought."""

import numpy as np
import pytest
import torch

from tests.support.pressing import LEAVE, PRESS, STIFFNESS, TOUCH, board, slides, wipes, wiping
from tpgmm_control import Controller
from tpgmm_control.contact import Admittance
from tpgmm_torch import Canonical, Sequence, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError

#: Boards are thought to be at 0.3 m.
HEIGHTS = torch.tensor([0.3, 0.295, 0.305]).double()
DT = 0.02


@pytest.fixture(scope="module")
def skill():
    return wiping().skill


def press(controller, heights, until, forget=lambda time: False, stiffness=STIFFNESS):
    """References, forces and commands of robots whose drives are exact, on springs."""
    joints = controller.reference
    force = torch.zeros_like(joints[..., 0])
    kept = []
    for tick in range(round(until / DT)):
        wrench = torch.zeros(*joints.shape[:-1], 6, dtype=joints.dtype)
        wrench[..., 2] = -force
        if forget(tick * DT):
            wrench = wrench * torch.nan
        command = controller.step(DT, joints, wrenches={"hand": wrench})
        joints = command.reference
        force = (stiffness * (heights - joints[..., 2])).clamp(min=0)
        kept.append((joints, force, command, controller.contacts["hand"]))
    return kept


def start(skill, batch=3, **settings):
    joints = torch.tensor([0.4, 0.0, 0.4]).double().expand(batch, 3)
    return Controller(skill, joints, {"board": board()}, clock="even", **settings)


@pytest.fixture(scope="module")
def kept(skill):
    return press(start(skill), HEIGHTS, 5.9)


def test_force_is_reached_on_boards_that_are_higher_and_lower(kept):
    forces = torch.stack([force for _, force, _, _ in kept])
    pressed = forces[round((TOUCH + 0.7) / DT) : round((LEAVE - 0.3) / DT)]
    assert (pressed - PRESS).abs().max() < 0.1 * PRESS
    contacts = torch.stack([contact for *_, contact in kept])
    assert not contacts[: round(1.3 / DT)].any()
    assert contacts[round(2.2 / DT) : round(4.2 / DT)].all()
    assert not contacts[-1].any()


def test_offsets_are_given_up_after_contact(kept):
    heights = kept[-1][0][:, 2]
    assert (heights - heights[0]).abs().max() < 1e-3


def test_offsets_stay_within_speed_and_depth(skill):
    limits = Admittance(speed=0.01, depth=0.004)
    missing = HEIGHTS - 0.1  # there is no board
    moved, alone = (
        torch.stack([one[0] for one in press(start(skill, admittance=a), missing, 2.5)])
        for a in (limits, None)
    )
    way = moved - alone
    assert float(-way[-1, :, 2].max()) == pytest.approx(0.004, rel=0.05)
    assert way[..., 2].diff(dim=0).abs().max() < 1.2 * 0.01 * DT
    assert way[..., :2].abs().max() < 1e-9


def test_lost_wrench_holds_the_offset_and_then_the_robot(skill):
    lost = press(start(skill), HEIGHTS, 3.2, lambda time: time >= 2.5)
    joints = torch.stack([one[0] for one in lost])
    before, later = round(2.5 / DT) - 1, round(2.6 / DT)
    assert (joints[later] - joints[before])[:, 2].abs().max() < 2e-4
    command = lost[-1][2]
    assert command.status == ["holding"] * 3
    assert command.reason(1) == "the wrench of 'hand' is missing or not finite"
    assert joints.isfinite().all()


def test_robots_of_a_batch_do_not_influence_each_other(skill):
    together = press(start(skill), HEIGHTS, 2.0)
    alone = press(start(skill, batch=1), HEIGHTS[1:2], 2.0)
    for one, other in zip(together, alone, strict=True):
        assert torch.equal(one[0][1:2], other[0])


def test_sequence_of_a_skill_hands_its_forces_on(skill):
    now = torch.tensor(3.0).double()
    [inner], [outer] = skill.expected_forces(now), Sequence([skill]).expected_forces(now)
    assert torch.equal(inner.force, outer.force)
    assert torch.equal(inner.share, outer.share)


@pytest.mark.parametrize("name", ["damping", "speed", "depth", "release"])
def test_settings_are_above_zero(name):
    for value in (0.0, -1.0, np.nan):
        with pytest.raises(DataError, match=name):
            Admittance(**{name: value})


def test_skill_without_forces_has_no_stage():
    model = TaskParameterizedGMM(5, [Canonical()], slides(), random_state=0).fit(wipes())
    references = []
    for settings in ({}, {"admittance": None}):
        controller = Controller(model.skill, [0.4, 0, 0.4], clock="even", **settings)
        steps = (controller.step(DT, wrenches={"hand": np.ones(6)}) for _ in range(50))
        references.append([command.reference for command in steps])
    assert all(map(torch.equal, *references))

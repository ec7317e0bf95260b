"""Controllers among obstacles: references keep clear, within bounds, or wait and say why."""

from functools import cache

import numpy as np
import pytest
import torch

from tests.support.skills import few_bottles, small_bottle
from tests.support.worlds import upper_body
from tpgmm_control import Controller
from tpgmm_control.obstacles import Scene, Shape, find_contacts
from tpgmm_control.sensing.trust import Trust
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_torch import Frame, Hold
from tpgmm_torch.exceptions import DataError

DT = 0.04


@cache
def situation():
    return BottleShaking().situations(1, seed=3)[0]


def among(*solids, **settings):
    scene = Scene(small_bottle().skill.kinematics, solids, visuals=True, **settings)
    return scene.allowing(few_bottles())


def controller(*solids, clock="waiting", situations=None, **settings):
    skill = small_bottle().skill
    one = situation()
    joints, frames = (one.joints, one.frames) if situations is None else situations
    scene = among(*solids) if solids else None
    settings = {"trust": None, "smoothing": None, **settings}
    return Controller(skill, joints, frames, clock=clock, obstacles=scene, **settings)


def run(running, seconds, **given):
    commands = [running.step(DT, **given) for _ in range(round(seconds / DT))]
    return torch.stack([command.reference for command in commands]), commands


@cache
def free():
    return run(controller(), 5.0)[0]


def in_the_way(at=1.9, radius=0.03):
    """A ball where a hand would be."""
    state = small_bottle().skill.kinematics.state(free()[round(at / DT)])
    return Shape.sphere("ball", radius, state.position("l_hand"))


def peaks(references, bounds):
    """Largest speed, acceleration and jerk, as shares of their bounds."""
    limits = bounds.velocity, bounds.acceleration, bounds.jerk
    moved = (references.diff(n, dim=0) / DT**n for n in (1, 2, 3))
    return [float((m.abs() / limit).max()) for m, limit in zip(moved, limits, strict=True)]


def test_where_nothing_is_near_references_are_the_same_to_the_last_bit():
    far = Shape.box("shelf", [0.2, 0.2, 0.2], [2.0, 0.0, 0.0])
    references, commands = run(controller(far), 5.0)
    assert torch.equal(references, free())
    assert {str(command.status) for command in commands} == {"running"}


@pytest.mark.parametrize("clock", ["waiting", "even"])
def test_a_robot_goes_around_and_joins_its_skill_again(clock):
    ball, skill = in_the_way(), small_bottle().skill
    running = controller(ball, clock=clock)
    references, commands = run(running, 5.0)
    scene = among(ball)
    near = scene.distances(free(), within=0.05)
    assert min(d.min() for pair, d in near.items() if "ball" in pair) < -0.03
    now = scene.distances(references, within=0.05)
    assert min(d.min() for pair, d in now.items() if "ball" in pair) > 0.005
    assert max(peaks(references, skill.motion_bounds)) <= 1 + 1e-6
    assert (references >= skill.kinematics.lower).all()
    assert (references <= skill.kinematics.upper).all()
    if clock == "even":
        assert commands[-1].time == pytest.approx(5.0 - DT)
        hands = [skill.kinematics.state(x).positions for x in (references[-1], free()[-1])]
        torch.testing.assert_close(*hands, atol=0.01, rtol=0)


def test_robots_of_a_batch_do_not_influence_each_other():
    one, other = BottleShaking().situations(2, seed=3)
    frames = {name: Frame.stack([one.frames[name], other.frames[name]]) for name in one.frames}
    joints = torch.stack([one.joints, other.joints])
    ball = in_the_way()
    both, _ = run(controller(ball, situations=(joints, frames)), 3.0)
    for row, alone in enumerate((one, other)):
        single, _ = run(controller(ball, situations=(alone.joints, alone.frames)), 3.0)
        torch.testing.assert_close(both[:, row], single, atol=1e-3, rtol=0)


def test_a_robot_that_cannot_go_on_waits_and_says_for_what():
    wall = Shape.box("wall", [0.12, 0.3, 0.3], [0.3, 0.0, 0.18])  # around the bottle
    running = controller(wall, clock="waiting:arrivals=4")
    references, commands = run(running, 8.0)
    assert commands[90].reason().startswith("kept ")  # it is off, and goes on
    assert commands[90].status == "running"
    assert commands[-1].status == "waiting"
    assert commands[-1].reason().startswith("blocked by ")
    assert commands[-1].reason().endswith(" / wall")
    assert float(commands[-1].time) < 4.0
    assert not running.finished
    scene = among(wall)
    touched = [
        d.min()
        for pair, d in scene.distances(references, within=0.05).items()
        if "wall" in pair
    ]
    assert min(touched) > 0
    # it stands, nearly: it does not tremble between the faces of the wall
    assert float(references[-50:].diff(n=2, dim=0).abs().max()) < 0.005


def test_what_a_hand_holds_is_part_of_it():
    skill, one = small_bottle().skill, situation()
    bottle = Shape.cylinder("bottle", 0.04, 0.4, [0, 0, 0], carrier="bottle")
    begin = free()[12]
    hand = skill.kinematics.state(begin).pose("l_hand")
    pose = Frame(hand.position - torch.tensor([0.0, 0.0, 0.25]))
    later = skill.kinematics.state(free()[60]).pose("l_hand").compose(pose.seen_from(hand))
    ball = Shape.sphere("ball", 0.04, later.position)
    allowed = [
        ("bottle", link) for link in ("l_hand", "r_hand", "l_wrist_1", "l_wrist_2", "l_forearm")
    ]
    scene = among(bottle, ball, allowed=allowed)
    contacts = {}
    for around in (None, scene):
        running = Controller(
            skill,
            begin,
            {"bottle": pose},
            begin=0.5,
            clock="even",
            trust=None,
            obstacles=around,
        )
        references, _ = run(running, 2.5, holds={"bottle": "l_hand"})
        time = DT * np.arange(len(references))
        held = [Hold("bottle", "l_hand", 0.0, 9.0)]
        found = find_contacts(scene, time, references, {"bottle": pose}, held)
        contacts[around] = [x.depth for x in found if {x.one, x.other} == {"ball", "bottle"}]
    assert max(contacts[None]) > 0.01
    assert contacts[scene] == []
    assert one.frames.keys() == {"bottle"}


def test_a_robot_that_starts_too_near_leaves_slowly_and_within_bounds():
    start = small_bottle().skill.kinematics.state(situation().joints).position("r_hand")
    ball = Shape.sphere("ball", 0.03, start - torch.tensor([0.03, 0.0, 0.02]))
    skill = small_bottle().skill
    scene = among(ball)
    running = controller(ball)
    assert scene.distances(situation().joints[None])["ball", "r_hand"] < 0
    references, _ = run(running, 1.0)
    distance = scene.distances(references)["ball", "r_hand"]
    assert distance[-1] > 0.005
    assert np.diff(distance).max() < 0.1 * DT * 3
    assert max(peaks(references, skill.motion_bounds)) <= 1 + 1e-6


def test_a_robot_that_is_not_trusted_comes_to_rest_even_beside_an_obstacle():
    skill, running = small_bottle().skill, controller(in_the_way(), trust=Trust())
    references = []
    for tick in range(60):
        joints = running.reference if tick < 30 else torch.full((17,), torch.nan)
        references.append(running.step(DT, joints=joints).reference)
    assert running.command.status == "holding"
    assert float((references[-1] - references[-2]).abs().max()) < 1e-6
    assert max(peaks(torch.stack(references), skill.motion_bounds)) <= 1 + 1e-6


def test_a_scene_has_to_fit_the_skill():
    with pytest.raises(DataError, match="need bounds of motion"):
        controller(in_the_way(), bounds=None)
    arm = upper_body()
    other = type(arm).from_config({**arm.config(), "joints": list(arm.joint_names)[::-1]})
    scene = Scene(other, [in_the_way()], visuals=True)
    with pytest.raises(DataError, match="around a robot with the joints"):
        Controller(
            small_bottle().skill, situation().joints, situation().frames, obstacles=scene
        )

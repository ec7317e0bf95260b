"""Robots that wait at the end of a skill go on, go back, or give up, each its own."""

import numpy as np
import pytest
import torch

from tests.support.fetching import FPS, START, World, skill, skills
from tpgmm_control import rollout
from tpgmm_torch import Frame, Sequence
from tpgmm_torch.data.demonstrations import Situation

TEXT = "pick until held retry 2, place until free, home until arrived"
FETCH = Sequence.parse(TEXT, skills(), timeout=0.6, fade=0.6)
CLOCKS = pytest.mark.parametrize("clock", ["even", "waiting", "localizing"])


def shares_of_bounds(world, bounds):
    """Largest speed, acceleration and jerk of references, over what is allowed."""
    motion, shares = np.stack(world.references[1:]), []
    for limit in (bounds.velocity, bounds.acceleration, bounds.jerk):
        motion = np.diff(motion, axis=0) * FPS
        shares.append(float(np.abs(motion / limit.numpy()).max()))
    return shares


def test_each_robot_of_a_batch_goes_on_tries_again_or_gives_up():
    world, over = World(FETCH, fails=(0, 1, 2, 9)), {"finished", "holding"}
    command = world.run(30.0, lambda command: set(command.status) <= over)
    statuses = {one for command in world.commands for one in command.status}
    assert statuses == {"running", "waiting", "holding", "finished"}
    assert command.status == ["finished"] * 3 + ["holding"]
    assert command.reason(3).startswith("'held' not met after 3 tries: cup is ")
    assert command.reason(3).endswith(" mm from where hand would carry it")
    np.testing.assert_allclose(world.cup[:3], world.tray[:3], atol=0.02)
    np.testing.assert_allclose(world.hand[:3], np.repeat(START[None], 3, 0), atol=0.03)
    assert float(command.time[3]) == FETCH.gates[0].time
    assert max(shares_of_bounds(world, FETCH.motion_bounds)) <= 1 + 1e-6


@CLOCKS
def test_without_conditions_nothing_is_new(clock):
    plain, same = (
        World(one, clock=clock) for one in (skill("pick"), Sequence([skill("pick")]))
    )
    for k in range(60):
        one, other = (world.step() for world in (plain, same))
        assert torch.equal(one.reference, other.reference) and one.status == other.status
        if 20 <= k < 35:  # somebody holds it
            plain.hand = same.hand = plain.references[20]


def test_robots_do_not_influence_each_other():
    together, alone = World(FETCH, fails=(1, 9, 0)), World(FETCH, fails=(1,), single=True)
    for _ in range(150):
        both, one = together.step(), alone.step()
        torch.testing.assert_close(both.reference[0], one.reference, rtol=0, atol=1e-9)
        assert both.status[0] == one.status and both.reason(0) == one.reason()


@CLOCKS
def test_time_does_not_pass_a_closed_gate(clock):
    asked = [False]
    until = [lambda moment: asked[0], lambda moment: True]
    sequence = Sequence(list(skills().values())[:2], until=[until, None], timeout=60.0)
    [gate] = sequence.gates
    world = World(sequence, single=True, clock=clock)
    world.run(2.6)
    assert float(world.commands[-1].time) == pytest.approx(gate.time, abs=1e-9)
    assert world.commands[-1].status == "waiting"
    assert world.commands[-1].reason() == "'<lambda>' not met: it is false"
    # somebody puts it to where the next skill would have it
    world.hand = np.concatenate((world.tray[:, :2], world.hand[:, 2:]), 1)
    world.run(2.0)
    assert float(world.controller.time) <= gate.time
    asked[0] = True
    world.run(2.0, lambda command: float(command.time) > gate.time)
    assert float(world.controller.time) > gate.time


def test_a_function_that_raises_is_a_reason_and_stops_no_loop():
    def broken(moment):
        return moment.frames["lid"]

    world = World(Sequence([skill("pick")], until=broken, timeout=0.5), single=True)
    command = world.run(6.0, lambda command: command.status == "holding")
    assert command.reason() == "'broken' not met: it raised KeyError('lid')"
    world = World(Sequence([skill("pick")], until=lambda moment: float("nan")), single=True)
    assert "it gives no bool but torch.float32" in world.run(2.5).reason()
    command = World(Sequence([skill("pick")], until="contact:hand"), single=True).run(2.5)
    assert command.reason() == "'contact:hand' not met: no contact is measured there"


@pytest.mark.parametrize(("hides", "passes"), [("lifted", True), ("at the cup", False)])
def test_an_object_that_is_hidden_was_seen_to_move_with_the_hand_or_is_not_held(hides, passes):
    world = World(FETCH, single=True)
    height = 0.05 if passes else 0.002
    for _ in range(120):
        world.step()
        lifted = float(world.controller.time) > 1.2 and world.hand[0, 2] >= height
        if lifted if passes else world.held[0]:
            world.visible[:] = False
    command = world.commands[-1]
    assert (float(command.time) > FETCH.gates[0].time) == passes
    if not passes:
        assert {c.reason() for c in world.commands} >= {"'held' not met: cup is not seen"}


def test_a_skill_begins_with_objects_where_they_are_by_then():
    world = World(FETCH, single=True)
    world.run(6.0, lambda command: float(command.time) > FETCH.gates[0].time + 0.5)
    [place] = world.controller.holding.frames["cup"].position[None].numpy()
    np.testing.assert_allclose(place, world.cup[0], atol=0.02)  # lifted, in the hand
    assert world.cup[0, 2] > 0.08


def test_who_looks_ahead_waits_at_gates():
    world = World(FETCH, single=True)
    world.run(0.5)
    ahead = world.controller.ahead()
    for _ in range(60):
        command = ahead.step(1 / FPS)
    assert float(command.time) == FETCH.gates[0].time and ahead.command.status != "holding"


def test_a_rollout_goes_through_gates_without_a_leap():
    world = World(FETCH, single=True)
    frames = {"cup": Frame(world.cup[0]), "tray": Frame(world.tray[0])}
    [done] = rollout(FETCH, [Situation(torch.tensor(START), frames)])
    path = done.joints.numpy()
    assert float(np.abs(np.diff(path, axis=0)).max()) < 0.06
    assert np.linalg.norm(path - world.cup[0], axis=1).min() < 0.005
    assert np.linalg.norm(path - world.tray[0], axis=1).min() < 0.01
    np.testing.assert_allclose(path[-1], START, atol=0.03)


def test_at_the_end_a_robot_is_done_once_it_has_arrived():
    world = World(Sequence([skill("pick")], until="arrived"), single=True)
    measured = torch.tensor(START)
    for _ in range(100):
        measured = measured + 0.1 * (world.controller.reference - measured)  # a slow servo
        world.commands.append(command := world.controller.step(1 / FPS, measured))
        if command.status == "finished":
            break
    assert command.status == "finished"
    why = "'arrived' not met: joints move, or are not at their reference"
    assert why in {command.reason() for command in world.commands}
    assert float((measured - command.reference).abs().max()) < 0.02

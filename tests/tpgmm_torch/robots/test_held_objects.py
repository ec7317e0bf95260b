"""Recorded objects, as places and as things."""

from dataclasses import replace

import pytest
import torch

from tests.support.carrying import HAND, HELD, at_first, carries, operators
from tests.support.local_coordinates import local_coordinates
from tests.support.worlds import RIGHT, upper_body
from tpgmm_torch import Hold, RelativePosition
from tpgmm_torch.robots.held_objects import held_objects

SHOWN = carries()[0]
STATE = upper_body().state(SHOWN.joints)
BEGIN, END = (int((SHOWN.time < at).sum()) for at in (HELD.begin, HELD.end))


def test_as_a_place_it_is_where_it_was_last_free():
    state, frames = held_objects(STATE, SHOWN.time, SHOWN.frames, [HELD])
    recorded, place = SHOWN.frames["bottle"].position, frames["bottle"].position
    assert torch.equal(place[:BEGIN], recorded[:BEGIN])
    assert torch.equal(place[BEGIN:END], recorded[BEGIN].expand(END - BEGIN, 3))
    assert torch.equal(place[END:], recorded[END:])
    assert torch.equal(state.position("bottle"), recorded)
    assert frames["tray"] is SHOWN.frames["tray"]
    assert state.carrier("bottle") == -1


@pytest.mark.parametrize("hold", [HELD, Hold("bottle", HAND, HELD.begin)])
def test_what_was_recorded_once_is_carried_by_the_link(hold):
    once = at_first(SHOWN)
    state, frames = held_objects(STATE, SHOWN.time, once.frames, [hold])
    there, recorded = state.pose("bottle"), SHOWN.frames["bottle"]
    assert torch.equal(there.position[:BEGIN], recorded.position[:BEGIN])
    # the recorded one was carried in the same way, by hands that are there to 1e-6
    carried = slice(BEGIN, END)
    close = {"rtol": 0, "atol": 1e-4}
    torch.testing.assert_close(there.position[carried], recorded.position[carried], **close)
    until = END if hold is HELD else len(SHOWN)
    first = once.frames["bottle"].position
    assert torch.equal(frames["bottle"].position[:until], first.expand(until, 3))
    assert (there.position[END:] == there.position[END]).all() or hold is not HELD


def test_holds_one_after_the_other_and_beyond_the_recording():
    once = at_first(SHOWN)
    first, second = Hold("bottle", HAND, 2.3, 4.0), Hold("bottle", RIGHT, 4.5)
    state, frames = held_objects(STATE, SHOWN.time, once.frames, [first, second])
    at = {name: int((SHOWN.time < t).sum()) for name, t in (("let", 4.0), ("taken", 4.5))}
    place = frames["bottle"].position
    torch.testing.assert_close(place[at["let"] :], place[at["let"]].expand(121 - at["let"], 3))
    grasp = state.pose("bottle")[at["taken"]].seen_from(STATE.pose(RIGHT)[at["taken"]])
    carried = STATE.pose(RIGHT)[at["taken"] :].compose(grasp)
    torch.testing.assert_close(state.position("bottle")[at["taken"] :], carried.position)
    _, never = held_objects(STATE, SHOWN.time, SHOWN.frames, [Hold("bottle", HAND, 99.0)])
    assert torch.equal(never["bottle"].position, SHOWN.frames["bottle"].position)
    _, always = held_objects(STATE, SHOWN.time, SHOWN.frames, [Hold("bottle", HAND)])
    assert (always["bottle"].position == SHOWN.frames["bottle"].position[0]).all()


@pytest.mark.parametrize("frames", [SHOWN.frames, at_first(SHOWN).frames])
def test_from_hand_to_hand_it_is_not_free_between(frames):
    first, second = Hold("bottle", HAND, HELD.begin, 3.5), Hold("bottle", RIGHT, 3.5, 4.5)
    handed = int((SHOWN.time < 3.5).sum())
    state, places = held_objects(STATE, SHOWN.time, frames, [first, second])
    end = int((SHOWN.time < 4.5).sum())
    bottle, place = state.pose("bottle"), places["bottle"].position
    assert torch.equal(place[BEGIN:end], bottle.position[BEGIN].expand(end - BEGIN, 3))
    assert torch.equal(place[end:], bottle.position[end:])
    # put down meanwhile, the next hand takes it from there
    pause = Hold("bottle", HAND, HELD.begin, 3.4)
    _, places = held_objects(STATE, SHOWN.time, SHOWN.frames, [pause, second])
    recorded = SHOWN.frames["bottle"].position
    assert torch.equal(places["bottle"].position[handed:end], recorded[handed].expand(20, 3))


def test_the_joints_move_what_is_attached():
    state, frames = held_objects(STATE, SHOWN.time, SHOWN.frames, [HELD], attached=True)
    loose, same = held_objects(STATE, SHOWN.time, SHOWN.frames, [HELD])
    torch.testing.assert_close(state.position("bottle"), loose.position("bottle"))
    assert torch.equal(frames["bottle"].position, same["bottle"].position)
    jacobian = state.linear_jacobian("bottle")
    assert (jacobian[:BEGIN] == 0).all() and (jacobian[END:] == 0).all()
    assert (loose.linear_jacobian("bottle") == 0).all()
    middle = (BEGIN + END) // 2
    grasp = state.pose("bottle")[middle].seen_from(STATE.pose(HAND)[middle])
    carried = STATE[middle].with_link("bottle", HAND, grasp)
    torch.testing.assert_close(jacobian[middle], carried.linear_jacobian("bottle"))


def test_local_data_follow_the_same_rule():
    place, thing = RelativePosition(HAND, "bottle"), RelativePosition(HAND, "bottle", held=True)
    robot = upper_body()
    held = local_coordinates(thing, SHOWN, robot, [HELD])
    assert torch.equal(held, local_coordinates(place, SHOWN, robot))  # as recorded
    still = held[BEGIN:END] - held[BEGIN]
    assert float(still.abs().max()) < 1e-3
    nominal = local_coordinates(place, at_first(SHOWN), robot)
    assert torch.equal(local_coordinates(place, SHOWN, robot, [HELD])[:END], nominal[:END])
    put = local_coordinates(operators()[1], SHOWN, robot, [HELD])
    assert float(put[END:, :3].abs().max()) < 1e-3
    unaware = replace(SHOWN, frames={**SHOWN.frames, "tray": SHOWN.frames["bottle"]})
    other = RelativePosition(HAND, "tray")
    assert torch.equal(
        local_coordinates(other, unaware, robot, [HELD]),
        local_coordinates(other, unaware, robot),
    )

"""Who holds what, found in demonstrations."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.carrying import ARRIVES, HAND, HELD, LEAVES, LIFTS, PUTS, at_first, carries
from tests.support.refusals import refused
from tests.support.skills import few_bottles
from tests.support.worlds import upper_body
from tpgmm_torch import Demonstration, Frame, Hold, quaternions
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, UnknownNameError
from tpgmm_torch.operators import RelativePosition
from tpgmm_torch.robots import Poses
from tpgmm_torch.training.hold_detection import (
    attach_holds,
    demonstrated_holds,
    find_holds,
    with_holds,
)

TIME = torch.linspace(0, 6, 121, dtype=torch.float64)


def along(x, y=0.0, z=0.0, turn=0.0) -> Frame:
    """A path, in which numbers stand still."""
    parts = [torch.as_tensor(part, dtype=torch.float64).expand(len(TIME)) for part in (x, y, z)]
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    angle = torch.as_tensor(turn, dtype=torch.float64).expand(len(TIME))
    return Frame(torch.stack(parts, -1), quaternions.exp(angle[:, None] * axis))


def ramp(begin: float, end: float) -> torch.Tensor:
    return ((TIME - begin) / (end - begin)).clamp(0, 1)


def show(hands: dict[str, Frame], **objects: Frame) -> tuple[Demonstration, Poses]:
    return Demonstration(TIME, Poses.joints(hands), objects), Poses(tuple(hands))


def seen(frame: Frame, rng: np.random.Generator, size: float) -> Frame:
    """With the noise of a tracker [m, and rad / m]."""
    shape = len(frame.position), 3
    shift, turn = (torch.from_numpy(size * rng.standard_normal(shape)) for _ in range(2))
    turned = quaternions.product(quaternions.exp(5 * turn), frame.orientation)
    return Frame(frame.position + shift, turned)


def test_the_bottle_is_held_from_the_grasp_until_it_is_let_go():
    [hold] = find_holds(carries(), upper_body())
    assert (hold.frame, hold.link) == ("bottle", HAND)
    # from the grasp, to about a tick, until between the last motion and the release
    assert abs(hold.begin - ARRIVES) < 0.1 and abs(hold.end - HELD.end) < 0.1


def change_poses(change):
    """Demonstrations in which what moves is changed."""
    return [
        replace(d, frames={n: change(f) if f.batch_shape else f for n, f in d.frames.items()})
        for d in carries()
    ]


@pytest.mark.parametrize("noise", [0.0005, 0.002])
def test_trackers_are_noisy(noise):
    rng = np.random.default_rng(0)
    [hold] = find_holds(change_poses(lambda frame: seen(frame, rng, noise)), upper_body())
    assert (hold.frame, hold.link) == ("bottle", HAND)
    # to within the time it takes to move by the tolerance
    assert ARRIVES - 0.4 <= hold.begin <= LIFTS + 0.4
    assert PUTS - 0.4 <= hold.end <= LEAVES + 0.4


def test_what_never_moves_is_never_held():
    assert find_holds(few_bottles(), upper_body()) == ()
    assert find_holds([at_first(d) for d in carries()], upper_body()) == ()
    still = change_poses(lambda frame: frame[:1].expand((121,)))
    assert find_holds(still, upper_body()) == ()


def test_what_somebody_else_moves_is_not_held():
    hands = {"left": along(0.1 * torch.sin(TIME)), "right": along(0.0, 1.0)}
    demonstration, poses = show(hands, cup=along(0.3 * ramp(1, 3), 0.2))
    assert find_holds([demonstration], poses) == ()


def test_one_after_the_other():
    x, y = 0.4 * ramp(1, 2) + 0.2 * ramp(4, 5), 0.5 * ramp(0, 0.5) * (1 - ramp(5.2, 5.8))
    left = along(0.4 * ramp(1, 2) - 0.3 * ramp(2.5, 3), 0.3 * (1 - ramp(0.1, 0.5)))
    right = along(0.8 - 0.4 * ramp(2, 3) + 0.2 * ramp(4, 5), 0.1, y)
    demonstration, poses = show({"left": left, "right": right}, cup=along(x, turn=0.0))
    first, second = find_holds([demonstration], poses)
    assert (first.link, second.link) == ("left", "right")
    assert 0.5 <= first.begin <= 1 and 2 <= first.end <= 2.6
    assert 3 <= second.begin <= 4 and 5 <= second.end <= 5.3


def test_from_hand_to_hand_leaves_no_gap():
    brought, taken, several = 0.3 * ramp(1, 2), 0.3 * ramp(4, 5), []
    # the right hand comes, the left one leaves; in the last one it lets go before
    for come, gone in ((2.5, 3.4), (2.6, 3.4), (2.7, 3.5), (2.8, 3.5), (2.9, 2.3)):
        left = along(brought - 0.2 * (1 - ramp(0, 0.5)) - 0.4 * ramp(gone, gone + 0.4), 0.1)
        right = along(0.3 + taken + 0.4 * (1 - ramp(come - 0.4, come)), -0.1)
        several.append(show({"left": left, "right": right}, cup=along(brought + taken)))
    poses = several[0][1]
    for one, _ in several[:4]:
        first, second = find_holds([one], poses)
        assert first.end == second.begin
    first, second = find_holds([several[4][0]], poses)
    assert first.end < second.begin - 0.2
    first, second = find_holds([one for one, _ in several], poses)
    assert (first.link, second.link) == ("left", "right")
    assert first.end == second.begin == pytest.approx(2.7, abs=0.1)
    assert second.end == np.inf


def test_a_hand_may_shift_what_it_closes_around():
    path = 0.4 * ramp(3, 4)
    hand = along(path - 0.2 * (1 - ramp(0, 1)))
    for shift, begin in ((0.025, 1.0), (-0.025, 1.0), (0.05, 2.2)):  # or it is brought
        cup = along(path, shift * ramp(2, 2.2), turn=4 * shift * ramp(2, 2.2))
        demonstration, poses = show({"hand": hand}, cup=cup)
        [hold] = find_holds([demonstration], poses)
        assert hold.begin == pytest.approx(begin, abs=0.1) and hold.end == np.inf


def test_a_pause_on_the_way_is_no_release():
    x = 0.3 * ramp(1, 2) + 0.3 * ramp(4, 5)
    hand = along(x - 0.2 * (1 - ramp(0, 0.5)), turn=x)
    demonstration, poses = show({"hand": hand}, cup=along(x, turn=x))
    [hold] = find_holds([demonstration], poses)
    assert 0.5 <= hold.begin <= 1 and hold.end == np.inf


def test_of_two_hands_one_is_the_holder_in_all_demonstrations():
    x = 0.3 * ramp(1, 3)
    near = {"left": along(x, 0.2), "right": along(x, -0.2)}
    rng, count = np.random.default_rng(0), 6
    looks = [{n: seen(f, rng, 2e-4) for n, f in near.items()} for _ in range(count)]
    noisy = [show(look, cup=along(x)) for look in looks]
    [hold] = find_holds([one for one, _ in noisy], noisy[0][1])
    assert hold.link == "left"
    # the right one slips
    slipping = {"left": along(x, 0.2), "right": along(x, -0.2 - 0.008 * ramp(1, 3))}
    demonstration, poses = show(dict(reversed(slipping.items())), cup=along(x))
    assert find_holds([demonstration], poses)[0].link == "left"


def test_the_median_demonstration_counts_and_most_must_agree():
    usual = list(carries()[:5])
    odd = [at_first(usual[0]), usual[1]]
    late = replace(usual[2], time=usual[2].time + 0.5)
    [hold] = find_holds([*usual, late], upper_body())
    [before] = find_holds(usual, upper_body())
    assert abs(hold.begin - before.begin) < 0.05
    [hold] = find_holds(odd, upper_body())
    assert find_holds(odd, upper_body(), agreement=0.6) == ()


def test_what_cannot_be_is_refused():
    one = list(carries()[:1])
    with pytest.raises(UnknownNameError, match=r"frame 'cup' is not in .*\['bottle', 'tray'\]"):
        find_holds(one, upper_body(), frames=["cup"])
    for name in ("tolerance", "angle"):
        with pytest.raises(DataError, match=f"{name} must be positive and finite, got 0"):
            find_holds(one, upper_body(), **{name: 0})


def test_they_are_found_given_or_none():
    robot, demonstrations = upper_body(), carries()
    seen_from_bottle, seen_from_tray = (
        [RelativePosition(HAND, name)] for name in ("bottle", "tray")
    )
    held = attach_holds(demonstrations, robot)
    assert {one.holds for one in held} == {find_holds(demonstrations, robot)}
    assert demonstrated_holds(held, seen_from_bottle, robot) == held[0].holds
    assert demonstrated_holds(held, seen_from_tray, robot) == ()
    assert demonstrated_holds(with_holds(held, ()), seen_from_bottle, robot) == ()
    with pytest.warns(PlausibilityWarning, match=r"attach_holds\(demonstrations, robot\)"):
        assert demonstrated_holds(demonstrations, seen_from_bottle, robot) == ()
    own = [attach_holds([one], robot)[0] for one in demonstrations]  # they differ, and agree
    assert demonstrated_holds(own, seen_from_bottle, robot) == held[0].holds
    assert attach_holds(own, robot)[0].holds == held[0].holds
    refused(lambda: with_holds(held, [Hold("cup", HAND)]), UnknownNameError, r"\(hold cup@")

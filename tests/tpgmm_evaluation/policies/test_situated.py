"""The mean of demonstrations, and key poses: what they do in situations that were not shown."""

from dataclasses import replace

import pytest
import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from lerobot_env_bimanual.bottle.carry_and_put import slide
from tests.support.learned_sets import (
    aligned,
    carrying,
    observed,
    played,
    pose,
    recorded,
    references,
    shaking,
)
from tpgmm_evaluation.policies.aligned import Aligned
from tpgmm_evaluation.policies.key_poses import find_moves
from tpgmm_evaluation.policies.situated import KeyPosesPolicy, MeanPolicy
from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots import Poses


@pytest.fixture(scope="module", params=[False, True])
def keys(request):
    """Learned from three demonstrations, without and with their posture."""
    return KeyPosesPolicy.fit(aligned(shaking()), posture=request.param)


def test_the_mean_of_one_demonstration_is_that_demonstration():
    [shown] = shaking().demonstrations(4, seed=0)[:1]
    policy = MeanPolicy.fit(Aligned.read(recorded(shaking()), shaking().robot, 1))
    done = played(policy, shown.joints[0], shown.frame("bottle"), steps=len(shown) + 3)
    torch.testing.assert_close(done[: len(shown)], references(shown), rtol=0, atol=1e-6)
    torch.testing.assert_close(done[-1], shown.joints[-1], rtol=0, atol=1e-6)


def test_the_mean_begins_where_the_robot_is_and_does_not_look_at_objects():
    learned = aligned(shaking())
    policy = MeanPolicy.fit(learned)
    start = learned.starts[0] + 0.03
    situations = shaking().situations(2, seed=3)
    first, second = (
        played(policy, start, situation.frames["bottle"], steps=60) for situation in situations
    )
    torch.testing.assert_close(first, second)
    assert (first[0] - start).abs().max() < 0.01
    torch.testing.assert_close(first[40:], learned.mean[40:60], rtol=0, atol=1e-5)


def test_only_the_first_episodes_are_read():
    two, three = (Aligned.read(recorded(shaking()), shaking().robot, n) for n in (2, 3))
    assert (len(two.demonstrations), len(three.demonstrations)) == (2, 3)
    assert (two.mean[:60] - three.mean[:60]).abs().max() > 1e-4


def test_hands_reach_the_demonstrated_grasp_wherever_the_bottle_is(keys):
    grasp = keys.moves[1]
    for situation in shaking().situations(3, seed=11):
        bottle = situation.frames["bottle"]
        done = played(keys, situation.joints, bottle, steps=grasp.end)
        distance, angle = shaking().grasp_error(done[grasp.arrive :], bottle)
        assert distance.max() < 1e-3
        assert angle.max() < 0.01
        assert (done.diff(dim=0).abs() * keys.config.fps <= shaking().robot.velocity).all()


def test_key_poses_are_on_the_way_however_many_demonstrations_show_it():
    once = aligned(carrying())
    shown, starts = 4 * tuple(once.demonstrations), once.starts.repeat(4, 1)
    often = replace(once, demonstrations=shown, starts=starts)
    steps, again = ([m.steps for m in find_moves(shown)] for shown in (once, often))
    assert steps == again
    assert any(len(on_the_way) > 1 for on_the_way in steps)


def test_turning_points_keep_the_rhythm(keys):
    [situation] = shaking().situations(1, seed=12)
    steps = keys.config.n_steps
    done = played(keys, situation.joints, situation.frames["bottle"], steps=steps)
    columns = [shaking().robot.joint_names.index(f"{s}_shoulder_pitch") for s in "lr"]
    last = [done[-4 * keys.config.fps :, c] - done[-1, c] for c in columns]
    turns = [((part[1:] * part[:-1]) < 0).sum() for part in last]
    assert min(turns) >= 4
    if keys.config.posture:  # else other joints may shake
        shown = aligned(shaking()).mean
        for column in columns:
            ranges = [way[-4 * keys.config.fps :, column] for way in (done, shown)]
            spread = [float(way.max() - way.min()) for way in ranges]
            assert spread[0] == pytest.approx(spread[1], rel=0.15)


def test_the_posture_is_that_of_the_demonstrations_where_poses_leave_it_free():
    learned = aligned(shaking())
    [situation] = shaking().situations(1, seed=13)
    away = []
    for posture in (False, True):
        policy = KeyPosesPolicy.fit(learned, posture=posture)
        start = situation.joints + 0.1 * torch.tensor([1.0, -1.0] * 8 + [1.0])
        done = played(policy, start, situation.frames["bottle"], steps=policy.moves[1].end)
        # of the difference, what moves no hand
        jacobian = learned.robot.state(done[-1]).jacobians.flatten(0, 1)
        free = torch.eye(17).double() - torch.linalg.pinv(jacobian) @ jacobian
        away.append(float((free @ (done[-1] - learned.mean[policy.moves[1].end])).norm()))
    assert away[1] < 0.3 * away[0]


@pytest.fixture(scope="module")
def carrier():
    return KeyPosesPolicy.fit(aligned(carrying()))


def test_what_is_held_is_led_not_the_hands(carrier):
    held = {(pose.held, pose.frame) for m in carrier.moves for at in m.poses for pose in at}
    assert ("bottle", "tray") in held
    again = type(carrier.moves[0]).from_config(carrier.config.moves[0])
    assert again == carrier.moves[0]


def test_a_bottle_that_slid_in_the_hands_is_put_on_the_tray(carrier):
    [situation] = carrying().situations(1, seed=21)
    bottle, tray = situation.frames["bottle"], situation.frames["tray"]
    robot, joints = carrying().robot, situation.joints
    takes = carrier.moves[1].arrive + 2
    puts = [
        m for m in carrier.moves for at in m.poses for p in at if p.held and p.frame == "tray"
    ]
    carrier.reset()
    inner = None
    for step in range(puts[-1].end):
        if step == takes:
            slid = bottle.compose(slide(torch.tensor([0.02, 0.1]).numpy()))
            inner = slid.seen_from(robot.state(joints).pose("l_hand"))
        if inner is not None:
            bottle = robot.state(joints).pose("l_hand").compose(inner)
        joints = carrier.select_action(observed(joints, bottle, tray))[0].double()
    bottle = robot.state(joints).pose("l_hand").compose(inner)
    distance, angle = carrying().put_error(bottle, tray)
    assert distance < 1e-3
    assert angle < 0.01


@pytest.mark.parametrize("kind", [MeanPolicy, KeyPosesPolicy])
def test_saved_policies_do_the_same_and_robots_are_planned_for_alone(kind, tmp_path):
    policy = kind.fit(aligned(shaking()))
    policy.save_pretrained(tmp_path)
    loaded = kind.from_pretrained(tmp_path)
    situations = shaking().situations(2, seed=4)
    every = [observed(s.joints, s.frames["bottle"]) for s in situations]
    batch = {key: torch.cat([one[key] for one in every]) for key in (OBS_STATE, OBS_ENV_STATE)}
    together = [loaded.select_action(batch) for _ in range(5)]
    for i, one in enumerate(every):
        policy.reset()
        alone = [policy.select_action(one)[0] for _ in range(5)]
        torch.testing.assert_close(torch.stack([b[i] for b in together]), torch.stack(alone))


def test_one_demonstration_is_enough_for_the_grasp():
    policy = KeyPosesPolicy.fit(Aligned.read(recorded(shaking()), shaking().robot, 1))
    [situation] = shaking().situations(1, seed=14)
    bottle = situation.frames["bottle"]
    done = played(policy, situation.joints, bottle, steps=policy.moves[1].end)
    assert shaking().grasp_error(done[-1], bottle)[0] < 1e-3


def test_kinematics_without_a_robot_are_refused():
    hands = Poses(("hand",))
    time = torch.arange(30) / 10
    way = Frame(torch.stack((time.sin(), time, 0 * time), dim=1))
    shown = Demonstration(time, Poses.joints({"hand": way}), {}, hands.joint_names)
    names = hands.joint_names
    learned = Aligned(hands, 10, (shown,), shown.joints[:1], names, names, ())
    with pytest.raises(DataError, match=r"links of a tpgmm_torch\.Robot"):
        KeyPosesPolicy.fit(learned)


def test_poses_are_observed_as_they_were_named():
    policy = MeanPolicy.fit(aligned(carrying()))
    names = policy.config.environment_names
    assert policy.config.frames == ["bottle", "tray"]
    assert (names[0], names[7]) == ("bottle.x", "tray.x")
    [situation] = carrying().situations(1, seed=1)
    frames = [situation.frames[name] for name in policy.config.frames]
    seen = policy.objects.frames(observed(situation.joints, *frames))
    torch.testing.assert_close(pose(seen["tray"])[0], pose(frames[1]), rtol=0, atol=1e-6)

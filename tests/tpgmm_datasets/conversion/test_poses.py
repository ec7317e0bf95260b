import math

import numpy as np
import pytest
import torch

from tests.support.lerobot_sets import (
    DATA,
    FPS,
    Arm,
    add_feature,
    assert_equal,
    change_table,
    set_column,
    write,
)
from tpgmm_datasets import (
    DatasetError,
    FramePose,
    LinkPose,
    load_lerobot,
)
from tpgmm_datasets.lerobot.layout import Feature
from tpgmm_torch import quaternions
from tpgmm_torch.data.frames import Frame


@pytest.fixture
def root(tmp_path):
    write(tmp_path / "set")
    return tmp_path / "set"


POSITION = np.array([0.1, -0.2, 0.3])
RPY = np.array([0.3, -0.5, 1.1])


def euler_matrix(roll, pitch, yaw):
    def turn(axis, angle):
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        matrix = np.eye(3)
        matrix[[i, j], [i, j]] = math.cos(angle)
        matrix[i, j], matrix[j, i] = -math.sin(angle), math.sin(angle)
        return matrix

    return turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)


QUATERNION = quaternions.from_matrix(torch.from_numpy(euler_matrix(*RPY)))
YAW = quaternions.from_matrix(torch.from_numpy(euler_matrix(0, 0, RPY[2])))


@pytest.mark.parametrize(
    ("values", "options", "expected"),
    [
        (QUATERNION.numpy(), {}, QUATERNION),
        (QUATERNION.numpy()[[1, 2, 3, 0]], {"rotation": "xyzw"}, QUATERNION),
        (quaternions.log(QUATERNION).numpy(), {"rotation": "rotvec"}, QUATERNION),
        (RPY, {"rotation": "euler"}, QUATERNION),
        (np.rad2deg(RPY), {"rotation": "euler", "degrees": True}, QUATERNION),
        (RPY[2:], {"rotation": "yaw"}, YAW),
        (RPY[:0], {"rotation": None}, quaternions.identity()),
    ],
)
def test_every_way_to_write_a_rotation_gives_the_same_frame(root, values, options, expected):
    row = np.concatenate((POSITION * 1000, values))
    add_feature(root, "observation.cup", np.tile(row, (36, 1)))
    pose = FramePose("observation.cup", scale=1e-3, **options)
    frame = load_lerobot(root, frames={"cup": pose})[0].frames["cup"]
    assert frame.batch_shape == ()
    torch.testing.assert_close(frame.position, torch.from_numpy(POSITION))
    turned = quaternions.match_hemisphere(frame.orientation, expected)
    torch.testing.assert_close(turned, expected)


def test_a_frame_is_constant_or_moves_and_is_chosen_by_place_or_name(root):
    values = np.random.default_rng(0).normal(size=(36, 5))
    add_feature(root, "observation.objects", values, list("abcde"))
    for columns in ([1, 2, 3], ["b", "c", "d"], slice(1, 4)):
        for constant in (True, False, None):
            pose = FramePose("observation.objects", columns, rotation=None, constant=constant)
            frame = load_lerobot(root, frames={"cup": pose})[1].frames["cup"]
            expected = values[12, 1:4] if constant else values[12:21, 1:4]
            torch.testing.assert_close(frame.position, torch.from_numpy(expected))


def test_the_name_of_a_feature_stands_for_its_pose(root):
    named = load_lerobot(root)
    found = load_lerobot(root, frames={"bottle": "observation.environment_state"})
    renamed = FramePose("observation.environment_state", slice(0, 7))
    other = load_lerobot(root, frames={"flask": renamed})
    for a, b, c in zip(named, found, other, strict=True):
        assert_equal([a.frames["bottle"].position], [b.frames["bottle"].position])
        assert_equal([a.frames["bottle"].position], [c.frames["flask"].position])


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (FramePose("observation.environment_state", rotation="xyzw"), "norm of a quaternion|"),
        (FramePose("observation.environment_state", rotation="yaw"), "needs 4 values"),
        (FramePose("observation.environment_state", ["bottle.x", "u"], None), "no value 'u'"),
        (FramePose("observation.environment_state", [0, 1, 9], None), "no value 9"),
    ],
)
def test_a_frame_that_does_not_fit_its_feature_is_refused(root, pose, message):
    def spoiled(values):
        return values * 2

    change_table(root, DATA, lambda t: set_column(t, "observation.environment_state", spoiled))
    with pytest.raises(DatasetError, match=message):
        load_lerobot(root, frames={"bottle": pose})


def test_an_unknown_rotation_is_refused():
    with pytest.raises(DatasetError, match="rotation 'wzyx'"):
        FramePose("x", rotation="wzyx")


def test_a_given_frame_is_taken_as_it_is(root):
    table = Frame([0, 0, 1])
    assert load_lerobot(root, frames={"table": table})[2].frames == {"table": table}


def closing(demonstration):
    return float(demonstration.time[3])


@pytest.mark.parametrize("event", ["grasp", closing])
def test_a_frame_is_where_a_link_is_at_an_event(root, event):
    expected = load_lerobot(root)
    found = load_lerobot(
        root,
        robot=Arm("right_elbow", "left_elbow"),
        frames={"cup": LinkPose("hand", event), "table": Frame([0, 0, 1])},
        events={"grasp": closing},
    )
    for a, b in zip(found, expected, strict=True):
        assert list(a.frames) == ["cup", "table"]
        assert a.events["grasp"] == 3 / FPS
        torch.testing.assert_close(a.frames["cup"].position[:2], b.joints[3, [1, 0]])


def test_a_link_at_an_unknown_event_is_refused(root):
    frames = {"cup": LinkPose("hand", "open")}
    with pytest.raises(DatasetError, match=r"event 'open' is not .*\['close'\]"):
        load_lerobot(root, robot=Arm("left_elbow"), frames=frames)


def test_resampling_is_linear_and_keeps_what_coincides(root):
    plain = load_lerobot(root)
    for a, b in zip(load_lerobot(root, rate=2 * FPS), plain, strict=True):
        assert len(a) == 2 * len(b) - 1
        torch.testing.assert_close(a.joints[::2], b.joints)
        torch.testing.assert_close(a.joints[1::2], (b.joints[1:] + b.joints[:-1]) / 2)
        assert dict(a.events) == dict(b.events)
    for a, b in zip(load_lerobot(root, rate=FPS / 2), plain, strict=True):
        torch.testing.assert_close(a.joints, b.joints[::2])


def test_resampling_turns_quaternions_at_constant_speed(root):
    angle = np.repeat([0.0, 1.0, 2.0], [12, 9, 15]) + 0.04 * np.concatenate(
        [np.arange(n) for n in (12, 9, 15)]
    )
    half = angle / 2
    zero = np.zeros_like(half)
    # with the sign jumping from row to row, as recordings have it
    sign = np.where(np.arange(36) % 3, 1, -1)[:, None]
    turns = np.stack((np.cos(half), zero, zero, np.sin(half)), axis=1) * sign
    names = ["hand.qw", "hand.qx", "hand.qy", "hand.qz"]
    add_feature(root, "observation.hand", turns, names)
    pose = np.concatenate((np.zeros((36, 3)), turns), axis=1)
    add_feature(root, "observation.cup", pose)
    cup = FramePose("observation.cup", constant=False)
    options = {"joints": "observation.hand", "frames": {"cup": cup}, "rate": 80}
    for found, start in zip(load_lerobot(root, **options), (0.0, 1.0, 2.0), strict=True):
        expected = start + 0.04 * FPS * found.time
        for q in (found.joints, found.frames["cup"].orientation):
            turned = 2 * torch.atan2(q[:, 3], q[:, 0])
            torch.testing.assert_close(torch.cos(turned), torch.cos(expected))
            torch.testing.assert_close(torch.sin(turned), torch.sin(expected))
        assert bool((found.joints.diff(dim=0).abs() < 0.1).all())


def test_idle_starts_and_ends_are_trimmed_but_events_stay(root):
    def still(values):
        values[:4] = values[4]
        values[9:12] = values[9]
        return values

    change_table(root, DATA, lambda t: set_column(t, "observation.state", still))
    whole, cut = load_lerobot(root)[0], load_lerobot(root, trim=1e-6)[0]
    assert_equal([cut.joints], [whole.joints[4:10]])
    assert float(cut.time[0]) == 0
    assert cut.events["close"] == pytest.approx(1 / FPS)
    early = load_lerobot(root, trim=1e-6, events={"early": lambda d: 2 / FPS})[0]
    assert_equal([early.joints], [whole.joints[2:10]])


def test_time_is_the_grid_of_the_rate(root):
    for demonstration in load_lerobot(root):
        assert demonstration.time.tolist() == [k / FPS for k in range(len(demonstration))]


def test_a_frame_that_is_stored_by_another_name_is_not_taken_for_it():
    names = [f"bottle.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    feature = Feature("observation.environment_state", "float32", (7,), tuple(names))
    with pytest.raises(DatasetError, match=r"'cup' is not stored there, \['bottle'\] are"):
        FramePose("observation.environment_state").select("cup", feature)
    named = FramePose("observation.environment_state", columns=names)
    assert named.select("cup", feature) == list(range(7))

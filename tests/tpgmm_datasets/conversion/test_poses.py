"""Poses of objects: every way to write one, and what does not fit."""

import math
from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.support.lerobot_sets import DATA, Arm, add_feature, change_table, set_column
from tpgmm_datasets import DatasetError, FramePose, LinkPose, load_lerobot
from tpgmm_datasets.lerobot.layout import Feature
from tpgmm_datasets.tables import write_table
from tpgmm_torch import Frame, quaternions

POSITION = np.array([0.1, -0.2, 0.3])
RPY = np.array([0.3, -0.5, 1.1])


QUATERNION = quaternions.from_matrix(torch.tensor(Rotation.from_euler("xyz", RPY).as_matrix()))
YAW = quaternions.exp(torch.tensor([0.0, 0.0, RPY[2]], dtype=torch.float64))


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
    def double(values):
        return values * 2

    change_table(root, DATA, lambda t: set_column(t, "observation.environment_state", double))
    with pytest.raises(DatasetError, match=message):
        load_lerobot(root, frames={"bottle": pose})


def test_a_frame_that_is_stored_by_another_name_is_not_taken_for_it():
    names = [f"bottle.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    feature = Feature("observation.environment_state", "float32", (7,), tuple(names))
    with pytest.raises(DatasetError, match=r"'cup' is not stored there, \['bottle'\] are"):
        FramePose("observation.environment_state").select("cup", feature)
    named = FramePose("observation.environment_state", columns=names)
    assert named.select("cup", feature) == list(range(7))


#: Ways to write a rotation about the vertical by an angle: columns, and values.
TURNS = {
    "nothing": ([], lambda a: []),
    "yaw": (["yaw"], lambda a: [a]),
    "yaw_deg": (["cup.yaw_deg"], lambda a: [math.degrees(a)]),
    "roll, pitch, yaw": (["roll", "pitch", "yaw"], lambda a: [0, 0, a]),
    "quaternion": (
        ["qz", "qw", "qx", "qy"],
        lambda a: [math.sin(a / 2), math.cos(a / 2), 0, 0],
    ),
    "ROS": (
        [f"pose.orientation.{part}" for part in "xyzw"],
        lambda a: [0, 0, -math.sin(a / 2), -math.cos(a / 2)],
    ),
}
PLACES = {
    "m": ("x", "y", "z"),
    "mm": ("x_mm", "y_mm", "z_mm"),
    "ROS": ("/cup/pose/position/x", "/cup/pose/position/y", "/cup/pose/position/z"),
}


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    turn=st.sampled_from(sorted(TURNS)),
    place=st.sampled_from(sorted(PLACES)),
    moves=st.booleans(),
    suffix=st.sampled_from([".csv", ".parquet"]),
    seed=st.integers(0, 99),
)
def test_a_table_gives_each_episode_its_own_pose(root, turn, place, moves, suffix, seed):
    rng, (columns, written) = np.random.default_rng(seed), TURNS[turn]
    shown = rng.uniform(-3, 3, size=(3, 1 + moves, 4))
    scale = 1000 if place == "mm" else 1
    rows = [
        [episode, 0.05 * (1 + step), *scale * pose[:3], *written(pose[3])]
        for step in range(1 + moves)
        for episode, pose in enumerate(shown[::, step])
    ]
    table = pd.DataFrame(rows, columns=["episode", "time", *PLACES[place], *columns])
    file = root.parent / f"poses{suffix}"
    write_table(table if moves else table.drop(columns="time"), file)
    read = load_lerobot(root, frames={"cup": file if seed % 2 else str(file)}, episodes=[0, 2])
    for one, poses in zip(read, shown[[0, 2]], strict=True):
        frame = one.frames["cup"]
        assert frame.batch_shape == ((len(one),) if moves else ())
        # it stands still before the first and after the last
        ends = frame[[0, -1]] if moves else [frame]
        for found, (*position, angle) in zip(ends, poses, strict=True):
            half = angle / 2 if columns else 0.0
            turn = torch.tensor([math.cos(half), 0, 0, math.sin(half)]).double()
            assert found.position.tolist() == pytest.approx(position)
            assert abs(float(found.orientation @ turn)) == pytest.approx(1)


def test_frames_are_given_for_all_episodes_that_are_read(root):
    several = [Frame([0.2 + 0.1 * x, 0, 0]) for x in range(3)]
    by_index = dict(enumerate(several))
    for frames in (several, by_index):
        read = load_lerobot(root, frames={"cup": frames})
        for one, frame in zip(read, several, strict=True):
            assert one.frames["cup"].position.tolist() == frame.position.tolist()
    [last] = load_lerobot(root, frames={"cup": by_index}, episodes=[2])
    assert last.frames["cup"].position[0] == several[2].position[0]
    for wrong, said in (
        (several[:2], "got list of 2 Frame"),
        (several * 2, "got list of 6 Frame"),
        ({0: several[0], 1: several[1]}, "got dict of 2 Frame"),
        (by_index | {7: several[0]}, "got dict of 4 Frame"),
    ):
        message = rf"'cup' is .* one for each .* 0, 1, 2, .*{said}"
        with pytest.raises(DatasetError, match=message):
            load_lerobot(root, frames={"cup": wrong})


def test_an_offset_makes_a_frame_at_a_link_the_objects(root):
    robot, turned = Arm("left_elbow", "right_elbow"), "+0.1,0,0.2,1.5707963"
    frames = {"hand": "hand@close", "cup": f"hand@close{turned}"}
    for one in load_lerobot(root, robot=robot, frames=frames):
        hand, cup = one.frames["hand"], one.frames["cup"].seen_from(one.frames["hand"])
        assert (hand.at, one.frames["cup"].at) == ("hand@close", None)
        assert cup.position.tolist() == pytest.approx([0.1, 0, 0.2])
        assert cup.orientation.tolist() == pytest.approx([0.5**0.5, 0, 0, 0.5**0.5])


@pytest.mark.parametrize(
    ("make", "given", "said"),
    [
        (LinkPose.parse, "hand@close+0,0", "behind [+] is the object"),
        (LinkPose.parse, "hand@close+0,0,up", "behind [+] is"),
        (LinkPose.parse, "hand@close+0,0,0,0.5,0,0,0", "norm of a quaternion is off by 0.5"),
        (LinkPose.parse, "hand@close+0,0,60", "in metres and nearer than 1 m"),
        (partial(FramePose, "x", None), "wzyx", "rotation 'wzyx'"),
    ],
)
def test_offsets_and_rotations_that_are_none_are_refused(make, given, said):
    with pytest.raises(DatasetError, match=said):
        make(given)

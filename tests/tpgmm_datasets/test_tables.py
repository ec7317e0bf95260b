"""Tables: what goes in comes out, in memory and through files, and bad columns are named."""

import builtins
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.skills import HANDS, canonical, handlings, hands, waves
from tpgmm_datasets.tables import (
    demonstrations_from_frame,
    demonstrations_to_frame,
    read_table,
    trajectories_to_frame,
    write_table,
)
from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.data.pose_names import POSE_PARTS
from tpgmm_torch.exceptions import DataError, DependencyError, UnknownNameError

NAMES = ("shoulder", "elbow")


def unit(rng, *shape):
    values = rng.normal(size=(*shape, 4))
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def demonstration(seed=0, length=6, names=NAMES, events=None):
    rng = np.random.default_rng(seed)
    frames = {
        "bottle": Frame(rng.normal(size=3), unit(rng)),
        "hand.left": Frame(rng.normal(size=(length, 3)), unit(rng, length)),
    }
    time = np.cumsum(rng.uniform(0.01, 0.02, size=length))
    return Demonstration(time, rng.normal(size=(length, 2)), frames, names, events or {})


def assert_same(found, expected):
    assert found.joint_names == expected.joint_names
    assert dict(found.events) == dict(expected.events)
    assert torch.equal(found.time, expected.time)
    assert torch.equal(found.joints, expected.joints)
    assert list(found.frames) == list(expected.frames)
    for name, frame in expected.frames.items():
        other = found.frames[name]
        assert torch.equal(other.position, frame.position)
        # bringing to unit norm twice may change the last digit
        torch.testing.assert_close(other.orientation, frame.orientation, rtol=0, atol=4e-16)


@settings(deadline=None, max_examples=30)
@given(st.lists(st.integers(2, 9), min_size=1, max_size=4), st.booleans(), st.booleans())
def test_to_a_table_and_back_is_the_identity(lengths, named, event):
    made = [demonstration(i, n, NAMES if named else None) for i, n in enumerate(lengths)]
    if event:
        first = made[0]
        go = {"go": float(first.time.mean())}
        made[0] = Demonstration(first.time, first.joints, first.frames, first.joint_names, go)
    for found, expected in zip(
        demonstrations_from_frame(demonstrations_to_frame(made)), made, strict=True
    ):
        assert_same(found, expected)


def test_the_table_is_flat():
    made = [demonstration(0, 4, events={"go": 0.03}), demonstration(1, 6)]
    table = demonstrations_to_frame(made)
    poses = [f"{name}.{p}" for name in ("bottle", "hand.left") for p in POSE_PARTS]
    assert list(table.columns) == ["episode", "time", *NAMES, *poses, "event.go"]
    assert table["episode"].tolist() == [0] * 4 + [1] * 6
    assert (table["event.go"][:4] == 0.03).all()
    assert table["event.go"][4:].isna().all()
    np.testing.assert_array_equal(table["elbow"][4:], made[1].joints[:, 1])
    np.testing.assert_array_equal(
        table["bottle.qw"][:4], np.full(4, made[0].frames["bottle"].orientation[0])
    )


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_trajectories_have_their_covariance(tmp_path, suffix):
    path = tmp_path / f"table.{suffix}"
    shown = handlings(2)
    made = hands().predict(shown, candidates=False)
    frames = [one.frames for one in shown]
    write_table(trajectories_to_frame(made, frames), path)
    table = read_table(path)
    again = demonstrations_from_frame(table)
    assert again[1].joint_names == HANDS.joint_names  # they look like poses
    assert torch.equal(again[1].time, made[1].time)
    assert torch.equal(again[1].joints, made[1].joints)
    assert torch.equal(again[1].frames["cup"].position, frames[1]["cup"].position)
    one, two = HANDS.joint_names[1:3]
    rows = table[table.episode == 1]
    assert (
        rows[f"covariance.{one}.{two}"].to_numpy() == made[1].covariance[:, 1, 2].numpy()
    ).all()


def test_joints_that_look_like_poses_are_named():
    made = handlings(2)
    table = demonstrations_to_frame(made)
    assert_same(demonstrations_from_frame(table)[1], made[1])
    wider = demonstrations_from_frame(table.assign(gripper=0.5))[0]
    assert wider.joint_names == (*HANDS.joint_names, "gripper")
    table.attrs.clear()  # as CSV does
    with pytest.raises(DataError, match=r"no joints.*joints=\[\.\.\.\]"):
        demonstrations_from_frame(table)
    assert_same(demonstrations_from_frame(table, joints=HANDS.joint_names)[1], made[1])


def test_tables_of_others_need_no_episode_and_may_have_more_columns():
    rows = {"stamp": [0.0, 0.1], "elbow": [1, 2], "task": ["pour", "pour"], "cup_x": [0.1, 0.1]}
    rows |= {f"cup_{part}": [float(part == "qw")] * 2 for part in POSE_PARTS[1:]}
    [found] = demonstrations_from_frame(pd.DataFrame(rows), joints=["elbow"], time="stamp")
    assert found.joints.tolist() == [[1.0], [2.0]]
    assert found.frames["cup"].batch_shape == ()
    assert found.frames["cup"].position.tolist() == [0.1, 0.0, 0.0]
    both = pd.concat([pd.DataFrame(rows).assign(take=name) for name in ("b", "a")])
    options = {"joints": ["elbow"], "time": "stamp", "episode": "take"}
    assert len(demonstrations_from_frame(both, **options)) == 2


def without(column):
    return lambda table: table.drop(columns=[column])


def put(row, column, value):
    def change(table):
        table = table.astype({column: object}) if isinstance(value, str) else table.copy()
        table.loc[row, column] = value
        return table

    return change


TURN = [f"hand.left.{part}" for part in POSE_PARTS[3:]]


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (without("time"), UnknownNameError, "column 'time' is not in the table; it has"),
        (lambda t: t.rename(columns={"elbow": "shoulder"}), DataError, r"\['shoulder'\]"),
        (lambda t: t[:0], DataError, "no rows"),
        (put(2, "episode", np.nan), DataError, "'episode' lacks a value"),
        (put(2, "elbow", np.nan), DataError, "episode 0 .* column 'elbow' .* in row 2"),
        (put(2, "elbow", np.inf), DataError, "episode 0 .*joints holds 1 value"),
        (put(7, "hand.left.qz", np.nan), DataError, "episode 1 .*'hand.left.qz' .* row 7"),
        (put(1, "hand.left.qw", 3.0), DataError, "episode 0 .*unit quaternion"),
        (put(1, "event.go", 0.02), DataError, "'event.go' is one time"),
        (put(1, "time", 0.0), DataError, "time must increase"),
        (put(1, "shoulder", "left"), DataError, "'shoulder' holds no numbers"),
        (without("bottle.qz"), DataError, r"part of the pose of 'bottle', .*\['bottle.qz'\]"),
        (without("bottle.z"), DataError, r"part of the pose of 'bottle', .*\['bottle.z'\]"),
        (lambda t: t.drop(columns=TURN), DataError, r"'hand.left', .*'hand.left.qw'.*1, 0, 0"),
        (lambda t: t.reset_index(), DataError, r"\['index'\] count the rows .*index=False"),
        (lambda t: t.assign(frame=[*range(6)] * 2), DataError, r"\['frame'\] count the rows"),
    ],
)
def test_other_tables_are_refused(change, error, message):
    table = demonstrations_to_frame([demonstration(0, events={"go": 0.03}), demonstration(1)])
    table.attrs.clear()
    with pytest.raises(error, match=message):
        demonstrations_from_frame(change(table))


def test_a_file_with_the_rows_numbers_is_refused(tmp_path):
    table = demonstrations_to_frame([demonstration()])
    table.to_csv(tmp_path / "log.csv")
    with pytest.raises(DataError, match=r"\['Unnamed: 0'\] count the rows .*index=False"):
        demonstrations_from_frame(read_table(tmp_path / "log.csv"))
    [found] = demonstrations_from_frame(read_table(tmp_path / "log.csv"), joints=NAMES)
    assert_same(found, demonstration())


def test_columns_that_look_like_parts_of_poses_can_be_joints():
    table = demonstrations_to_frame([demonstration()])[["time", *NAMES]]
    table = table.rename(columns={"shoulder": "base_x", "elbow": "base_y"})
    [found] = demonstrations_from_frame(table)  # a plane has two
    assert found.joint_names == ("base_x", "base_y")
    table = table.assign(base_z=0.1, step=range(len(table)))
    names = ["base_x", "base_y", "base_z", "step"]
    [found] = demonstrations_from_frame(table, joints=names)
    assert found.joint_names == tuple(names)


def test_what_makes_no_table_is_refused():
    with pytest.raises(DataError, match="at least one trajectory"):
        trajectories_to_frame([])
    made = canonical().fit(waves()).predict(waves(2))
    with pytest.raises(DataError, match="2 trajectories, and frames of 1"):
        trajectories_to_frame(made, [{}])
    [shown] = handlings(1)
    with pytest.raises(DataError, match="a column in common"):
        demonstrations_to_frame([replace(shown, frames={"left": Frame([0.0, 0.0, 0.0])})])


def test_what_is_no_file_of_a_table_is_refused(tmp_path, monkeypatch):
    for call in (read_table, lambda path: write_table(pd.DataFrame(), path)):
        with pytest.raises(DataError, match=r"ends in .csv or .parquet, got '.*table.xls'"):
            call(tmp_path / "table.xls")
    for suffix in ("csv", "parquet"):
        path = tmp_path / f"table.{suffix}"
        with pytest.raises(DataError, match="there is no file"):
            read_table(path)
        path.write_bytes(b"\xff\x00,\n1,2,3\n")
        with pytest.raises(DataError, match="is no table"):
            read_table(path)
        path.write_bytes(b"")
        with pytest.raises(DataError, match="is no table"):
            read_table(path)
    plain = builtins.__import__

    def without_pandas(name, *args, **kwargs):
        if name == "pandas":
            raise ImportError(name)
        return plain(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_pandas)
    with pytest.raises(DependencyError, match=r"pip install 'tpgmm-torch\[data\]'"):
        demonstrations_to_frame([demonstration()])


def test_an_episode_column_that_is_asked_for_is_there():
    table = pd.DataFrame({"run": [1, 1], "time": [0.0, 0.1], "slide": [0.0, 0.2]})
    [shown] = demonstrations_from_frame(table, episode="run")
    assert shown.joint_names == ("slide",)
    with pytest.raises(UnknownNameError, match="column 'rnu' is not in the table; it has"):
        demonstrations_from_frame(table, episode="rnu")
    with pytest.raises(DataError, match="a pandas DataFrame, got list"):
        demonstrations_from_frame([1])

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tpgmm_datasets import (
    DatasetError,
    demonstrations_from_frame,
    demonstrations_to_frame,
    load_lerobot,
    save_lerobot,
)
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame

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
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=4),
    named=st.booleans(),
    event=st.booleans(),
)
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


def test_the_table_is_tidy():
    made = [demonstration(0, 4, events={"go": 0.03}), demonstration(1, 6)]
    table = demonstrations_to_frame(made)
    assert list(table.index.names) == ["episode", "time"]
    assert len(table) == 10
    assert list(table["joint"].columns) == list(NAMES)
    assert list(table["constant frame"].columns[:3]) == ["bottle.x", "bottle.y", "bottle.z"]
    assert list(table["frame"].columns[-2:]) == ["hand.left.qy", "hand.left.qz"]
    assert (table.loc[0, ("event", "go")] == 0.03).all()
    assert table.loc[1, ("event", "go")].isna().all()
    elbow = table.loc[1, ("joint", "elbow")].to_numpy()
    assert (elbow == made[1].joints[:, 1].numpy()).all()


def test_a_frame_may_be_constant_in_one_demonstration_and_move_in_another():
    still, moving = demonstration(0), demonstration(1)
    other = Demonstration(
        moving.time,
        moving.joints,
        {"bottle": moving.frames["hand.left"], "hand.left": moving.frames["bottle"]},
        NAMES,
    )
    found = demonstrations_from_frame(demonstrations_to_frame([still, other]))
    assert found[1].frames["bottle"].batch_shape == (6,)
    assert found[1].frames["hand.left"].batch_shape == ()


def test_joints_named_like_poses_stay_joints():
    names = [f"left.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    rng = np.random.default_rng(0)
    made = [Demonstration([0.0, 1.0], rng.normal(size=(2, 7)), {}, names)]
    (found,) = demonstrations_from_frame(demonstrations_to_frame(made))
    assert found.joint_names == tuple(names)
    assert not found.frames


def test_a_stored_set_survives_the_table(tmp_path):
    time = np.arange(5) / 10
    made = [Demonstration(time, np.random.default_rng(0).normal(size=(5, 2)), {}, NAMES)]
    read = load_lerobot(save_lerobot(made, tmp_path / "set", fps=10, task="x"))
    table = demonstrations_to_frame(read)
    assert_same(demonstrations_from_frame(table)[0], read[0])


def without(column):
    return lambda table: table.drop(columns=[column])


def one_missing(table):
    table = table.copy()
    table.iloc[2, 0] = np.nan
    return table


def wandering(table):
    table = table.copy()
    table.iloc[2, table.columns.get_loc(("constant frame", "bottle.x"))] += 1
    return table


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.reset_index(), r"index is \(episode, time\)"),
        (lambda t: t.droplevel(0, axis=1), "kind, name"),
        (lambda t: t.rename(columns={"joint": "angle"}, level=0), "angle"),
        (lambda t: t.drop(columns=["joint"], level=0), "no joints"),
        (without(("frame", "hand.left.qx")), r"lacks \['hand.left.qx'\]"),
        (one_missing, "'joint: shoulder': episode 0 of the table lacks some values"),
        (wandering, "'bottle' is to be constant"),
    ],
)
def test_other_tables_are_refused(change, message):
    table = demonstrations_to_frame([demonstration()])
    with pytest.raises(DatasetError, match=message):
        demonstrations_from_frame(change(table))


def test_the_table_given_is_not_changed():
    table = demonstrations_to_frame([demonstration(0), demonstration(1, 4)])
    copy = table.copy(deep=True)
    demonstrations_from_frame(table)
    pd.testing.assert_frame_equal(table, copy)

"""Tables: what goes in comes out, in memory and through files, and bad columns are named."""

import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.skills import HANDS, canonical, handlings, hands, waves
from tests.support.written_sets import unit
from tpgmm_datasets.tables import (
    demonstrations_from_frame,
    demonstrations_to_frame,
    read_table,
    trajectories_to_frame,
    write_table,
)
from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.data.pose_names import POSE_PARTS
from tpgmm_torch.exceptions import (
    DataError,
    DependencyError,
    PlausibilityWarning,
    UnknownNameError,
)

NAMES = ("shoulder", "elbow")


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
        made[0] = replace(made[0], events={"go": float(made[0].time.mean())})
    again = demonstrations_from_frame(demonstrations_to_frame(made))
    for found, expected in zip(again, made, strict=True):
        assert_same(found, expected)


def test_commands_are_columns_beside_the_joints(tmp_path):
    one = demonstration()
    one = replace(one, commands=one.joints + 0.05)
    plain = demonstration(1, 4)
    table = demonstrations_to_frame([one, plain])
    assert [name for name in table if name.startswith("command.")] == [
        "command.shoulder",
        "command.elbow",
    ]
    for suffix in (".csv", ".parquet"):
        write_table(table, path := tmp_path / f"table{suffix}")
        found, without = demonstrations_from_frame(read_table(path))
        assert_same(found, one)
        assert torch.equal(found.commands, one.commands) and without.commands is None
    [first, _] = demonstrations_from_frame(table.drop(columns="command.elbow"))
    expected = torch.stack((one.commands[:, 0], one.joints[:, 1]), 1)
    assert torch.equal(first.commands, expected)
    for joints in (None, NAMES):
        with pytest.raises(DataError, match=r"'command.wrist'\] are commands of no joint"):
            demonstrations_from_frame(
                table.rename(columns={"command.elbow": "command.wrist"}), joints=joints
            )


def test_the_table_is_flat():
    made = [demonstration(0, 4, events={"go": 0.03}), demonstration(1, 6)]
    table = demonstrations_to_frame(made)
    poses = [f"{name}.{p}" for name in ("bottle", "hand.left") for p in POSE_PARTS]
    assert list(table.columns) == ["episode", "time", *NAMES, *poses, "event.go"]
    assert table["episode"].tolist() == [0] * 4 + [1] * 6
    assert (table["event.go"][:4] == 0.03).all()
    assert table["event.go"][4:].isna().all()
    np.testing.assert_array_equal(table["elbow"][4:], made[1].joints[:, 1])
    assert (table["bottle.qw"][:4] == float(made[0].frames["bottle"].orientation[0])).all()


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
    entry = ".".join(("covariance", *HANDS.joint_names[1:3]))
    rows = table[table.episode == 1]
    assert (rows[entry].to_numpy() == made[1].covariance[:, 1, 2].numpy()).all()


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
        for content in (b"\xff\x00,\n1,2,3\n", b""):
            path.write_bytes(content)
            with pytest.raises(DataError, match="is no table"):
                read_table(path)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(DependencyError, match=r"pip install 'tpgmm-torch\[data\]'"):
        demonstrations_to_frame([demonstration()])


SHOWN = demonstration()
PLAIN = demonstrations_to_frame([SHOWN])[["time", *NAMES]]


def text(table, between=",", comma=".", end=""):
    rows = [[repr(x).replace(".", comma) for x in row] for row in table.to_numpy().tolist()]
    lines = [between.join(table.columns), *(between.join(r) + end for r in rows)]
    return "\n".join(lines)


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from([",", ", ", ";", "; ", "\t", " ", "   "]),
    st.sampled_from(".,"),
    st.sampled_from(["", "\ufeff", "  "]),
    st.booleans(),
)
def test_a_table_is_read_however_its_fields_are_separated(tmp, between, comma, first, trailing):
    comma = "." if "," in between else comma
    end = between if trailing and between.strip() else ""
    path = tmp / "log.csv"
    path.write_text(first + text(PLAIN, between, comma, end), encoding="utf-8")
    [found] = demonstrations_from_frame(read_table(path))
    assert_same(found, replace(SHOWN, frames={}))


@pytest.fixture(scope="module")
def tmp(tmp_path_factory):
    return tmp_path_factory.mktemp("tables")


def test_files_of_more_columns_than_the_header_names_are_refused(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(text(PLAIN, end=",7"))
    with pytest.raises(DataError, match="more fields than its header"):
        read_table(file)
    file.write_text(text(PLAIN.set_axis(["time", "j", "j"], axis=1)))
    with pytest.raises(DataError, match="columns of one name"):
        demonstrations_from_frame(read_table(file))
    PLAIN.to_csv(file)
    with pytest.raises(DataError, match=r"\['Unnamed: 0'\] count the rows .*index=False"):
        demonstrations_from_frame(read_table(file))
    [found] = demonstrations_from_frame(read_table(file), joints=NAMES)
    assert_same(found, replace(SHOWN, frames={}))


@given(st.text("=+-@'ab\t", min_size=1, max_size=6))
@settings(deadline=None)
def test_no_name_is_a_formula_in_a_file_and_each_is_read_as_it_was(tmp, name):
    table = pd.DataFrame({"time": [0.0, 0.1], name: [0.5, 0.25]})
    write_table(table, tmp / "table.csv")
    head = (tmp / "table.csv").read_text().splitlines()[0].split(",")[1].strip('"')
    assert not head.startswith(("=", "+", "-", "@", "\t"))
    assert read_table(tmp / "table.csv").columns.tolist() == ["time", name]


SINCE = pd.to_timedelta(0.1 * np.arange(6), "s")
DATES = pd.Timestamp("2026-01-31 23:59:59.7") + SINCE


@pytest.mark.parametrize(
    "stamps",
    [
        DATES,
        DATES.tz_localize("Europe/Berlin"),
        SINCE,
        DATES.astype(str),
        [one.isoformat() + "Z" for one in DATES],
        DATES.astype("datetime64[ns]").astype("int64"),
        DATES.astype("datetime64[us]").astype("int64"),
        DATES.astype("datetime64[ms]").astype("int64").astype(float),
    ],
    ids=lambda stamps: str(stamps[0]),
)
def test_dates_become_seconds_since_the_first_row(stamps):
    stamps = pd.Series(list(stamps))
    table = PLAIN.assign(**{"time": stamps, "event.go": stamps[2]})
    both = pd.concat([table.assign(episode=n) for n in (0, 1)], ignore_index=True)
    for found in demonstrations_from_frame(both):
        np.testing.assert_allclose(found.time, 0.1 * np.arange(6), atol=1e-6)
        np.testing.assert_allclose(found.events["go"], 0.2, atol=1e-6)
        assert found.joint_names == NAMES


@pytest.mark.parametrize(
    ("place", "turn"),
    [
        ("cup.pose.position.{}", "cup.pose.orientation.{}"),
        ("/cup/pose/position/{}", "/cup/pose/orientation/{}"),
        ("cup.pose.pose.position.{}", "cup.pose.pose.orientation.{}"),
        ("cup.transform.translation.{}", "cup.transform.rotation.{}"),
        ("cup_position_{}", "cup_orientation_{}"),
    ],
)
def test_poses_of_ros_have_w_last(place, turn):
    columns = {place.format(a): v for a, v in zip("xyz", (1.0, 2.0, 3.0), strict=True)}
    columns |= {turn.format(a): v for a, v in zip("xyzw", (0.0, 0.6, 0.0, 0.8), strict=True)}
    [found] = demonstrations_from_frame(PLAIN.assign(**columns))
    assert found.joint_names == NAMES
    assert found.frames["cup"].position.tolist() == [1.0, 2.0, 3.0]
    wanted = torch.tensor([0.8, 0.0, 0.6, 0.0], dtype=torch.float64)
    torch.testing.assert_close(found.frames["cup"].orientation, wanted)
    with pytest.raises(DataError, match=r"part of the pose of 'cup'.*cup.qw"):
        demonstrations_from_frame(PLAIN.assign(**columns).drop(columns=turn.format("w")))


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("n", np.arange(6.0)),
        ("n", np.arange(6.0) * 5 + 3),
        ("n", -np.arange(6)),
        ("moment", PLAIN["time"] + 7),
        ("moment", PLAIN["time"] * 1000),
        ("timestamp", np.zeros(6)),
        ("header.stamp.sec", np.zeros(6)),
        ("robot_timestamp_ns", np.sin(np.arange(6))),
        ("frame_index", np.sin(np.arange(6))),
        ("episode_index", np.zeros(6)),
    ],
)
def test_clocks_and_counters_are_no_joints(name, values):
    with pytest.raises(DataError, match=f"{name}.*count the rows or tell the time"):
        demonstrations_from_frame(PLAIN.assign(**{name: values}))
    [found] = demonstrations_from_frame(PLAIN.assign(**{name: values}), joints=[*NAMES, name])
    assert found.joint_names == (*NAMES, name)


def test_unlikely_columns_are_told():
    with pytest.warns(PlausibilityWarning, match=r"\['progress'\] change by the same"):
        demonstrations_from_frame(PLAIN.assign(progress=np.linspace(0, 1, 6)))
    with pytest.warns(PlausibilityWarning, match=r"\['elbow', 'note'\].*empty"):
        [found] = demonstrations_from_frame(PLAIN.assign(elbow=np.nan, note=None))
    assert found.joint_names == ("shoulder",)
    with pytest.raises(DataError, match=r"\['Unnamed: 3'\] have no name"):
        demonstrations_from_frame(PLAIN.assign(**{"Unnamed: 3": PLAIN["elbow"] ** 2}))
    [found] = demonstrations_from_frame(PLAIN.assign(**{"Unnamed: 3": np.nan}))
    assert found.joint_names == NAMES
    [found] = demonstrations_from_frame(PLAIN.set_index("time").rename(columns=" {} ".format))
    assert_same(found, replace(SHOWN, frames={}))


@pytest.mark.parametrize("between", [";", "\t", " "])
def test_a_table_of_one_column_is_told_of_its_separator(between):
    table = pd.DataFrame({between.join(("time", "elbow")): ["0 1", "1 1"]})
    with pytest.raises(DataError, match=r"one column.*separated by .*sep="):
        demonstrations_from_frame(table)
    with pytest.raises(DataError, match="decimal=','"):
        demonstrations_from_frame(PLAIN.assign(elbow="0,5"))
    for first in ("10:00:00.1", "31.01.2026", "now and then"):
        with pytest.raises(DataError, match=f"neither numbers nor dates.*{first}.*seconds"):
            demonstrations_from_frame(PLAIN.assign(time=first))


def test_large_tables_are_refused_before_they_are_read(tmp_path):
    rows = pa.table({name: pa.array(np.zeros(2_000_000)) for name in "abcdefghijk"})
    pq.write_table(rows, tmp_path / "log.parquet")
    assert (tmp_path / "log.parquet").stat().st_size < 1e5
    with pytest.raises(DataError, match="2000000 rows of 11 columns"):
        read_table(tmp_path / "log.parquet")


def test_an_episode_column_that_is_asked_for_is_there():
    table = pd.DataFrame({"run": [1, 1], "time": [0.0, 0.1], "slide": [0.0, 0.2]})
    [shown] = demonstrations_from_frame(table, episode="run")
    assert shown.joint_names == ("slide",)
    with pytest.raises(UnknownNameError, match="column 'rnu' is not in the table; it has"):
        demonstrations_from_frame(table, episode="rnu")
    with pytest.raises(DataError, match="a pandas DataFrame, got list"):
        demonstrations_from_frame([1])

"""Rows of episodes: what is wrong with them is refused and located, or left out."""

import numpy as np
import pyarrow as pa
import pytest

from tests.support.lerobot_sets import (
    DATA,
    assert_equal,
    assert_refused,
    change_info,
    change_table,
    in_data,
    in_info,
    joints_of,
    later,
    set_column,
    spoil,
    stuck,
    to_v21,
)
from tpgmm_datasets import DatasetError, DatasetWarning, load_lerobot


def nulls(root):
    def change(table):
        values = table["observation.state"].to_pylist()
        values[20] = None
        kind = pa.list_(pa.float64(), 3)
        return set_column(table, "observation.state", pa.array(values, kind))

    change_table(root, DATA, change)


def copied_rows(root):
    def change(table):
        return pa.concat_tables((table, table.slice(12, 9)))

    change_table(root, DATA, change)


STATE, POSE = "observation.state", "observation.environment_state"


def test_declared_type_and_shape_must_be_those_of_the_data(root, tmp_path):
    for name, value in (("dtype", "int64"), ("shape", [2])):
        plain = to_v21(root, tmp_path / name)
        change = {name: value, "names": None, "info": None}
        change_info(plain, lambda i, c=change: i["features"]["observation.state"].update(c))
        with pytest.raises(DatasetError, match=r"info\.json declares") as caught:
            load_lerobot(plain)
        assert caught.value.column == "observation.state"


def test_numbers_that_are_more_precise_than_declared_are_read(root, tmp_path):
    expected = joints_of(load_lerobot(root))
    plain = to_v21(root, tmp_path / "plain")
    change_info(plain, lambda i: i["features"][STATE].update(dtype="float32"))
    assert_equal(joints_of(load_lerobot(plain)), expected)

    def round_state(table):
        values = table[STATE].combine_chunks().cast(pa.list_(pa.float32(), 3))
        return set_column(table, STATE, values)

    change_info(plain, lambda i: i["features"][STATE].update(dtype="float64"))
    for file in sorted((plain / "data").rglob("*.parquet")):
        change_table(plain, file.relative_to(plain), round_state)
    with pytest.raises(DatasetError, match=r"it holds float, info\.json declares float64"):
        load_lerobot(plain)


def test_a_column_that_is_there_twice_is_refused(root):
    change_table(root, DATA, lambda t: t.append_column("timestamp", t["timestamp"]))
    with pytest.raises(DatasetError, match="2 columns of that name") as caught:
        load_lerobot(root)
    assert (caught.value.file, caught.value.column) == (DATA, "timestamp")


def test_equal_problems_are_told_once_and_an_empty_list_is_an_error(root):
    in_data(STATE, spoil(slice(1, 36, 5), 1, np.nan))(root)
    alike = r"episode 0.* \(and 2 more like it: episodes 1, 2\)"
    refused = pytest.raises(DatasetError, match=r"none of the 3 episodes is left .*\['nan'\]")
    with pytest.warns(DatasetWarning, match=alike) as caught, refused:
        load_lerobot(root, relax={"nan"})
    assert len(caught) == 1


@pytest.mark.parametrize("check", ["nan", "time", "gaps", "metadata", "duplicates"])
def test_a_relaxed_check_leaves_the_episode_out_and_says_so(root, check):
    damage = {
        "nan": in_data("observation.state", spoil(14, 1, np.nan)),
        "time": in_data("timestamp", stuck),
        "gaps": in_data("timestamp", later),
        "metadata": in_data("frame_index", spoil(14, 0, 7)),
    }
    expected = joints_of(load_lerobot(root))
    damage.get(check, copied_rows)(root)
    with pytest.warns(DatasetWarning, match="episode 1"):
        found = load_lerobot(root, relax={check})
    # of an episode that is there twice the first is kept
    kept = expected if check == "duplicates" else [expected[0], expected[2]]
    assert_equal(joints_of(found), kept)


@pytest.mark.parametrize(
    ("check", "damage", "place"),
    [
        ("nan", in_data(STATE, spoil(14, 1, np.nan)), (DATA, 1, STATE)),
        ("nan", in_data(STATE, spoil(14, 1, np.inf)), (DATA, 1, STATE)),
        ("nan", in_data(POSE, spoil(14, 1, np.nan)), (DATA, 1, POSE)),
        ("nan", nulls, (DATA, 1, STATE)),
        ("nan", in_data("timestamp", spoil(14, 0, np.nan)), (DATA, 1, "timestamp")),
        ("time", in_data("timestamp", stuck), (DATA, 1, "timestamp")),
        ("gaps", in_data("timestamp", later), (DATA, 1, "timestamp")),
        ("metadata", in_data("frame_index", spoil(14, 0, 7)), (DATA, 1, "frame_index")),
        ("metadata", in_data("index", spoil(14, 0, 7)), (DATA, 1, "index")),
        ("metadata", lambda r: change_table(r, DATA, lambda t: t.slice(0, 35)), (DATA, 2)),
        ("metadata", in_data("episode_index", spoil(slice(12, 21), 0, 8)), (DATA, 8)),
        ("metadata", in_info(fps=25), (DATA, None, "fps")),
        ("duplicates", copied_rows, (DATA, 1)),
    ],
)
def test_rows_that_are_wrong_are_refused_and_located(root, check, damage, place):
    damage(root)
    assert_refused(root, check, *place)

"""The metadata of a data set, in both layouts, and their contradictions."""

import shutil

import pyarrow as pa
import pytest

from tests.support.lerobot_sets import (
    DATA,
    EPISODES,
    assert_refused,
    change_info,
    change_table,
    in_info,
    set_column,
)
from tpgmm_datasets import DatasetError, load_lerobot

EXTRA = "data/chunk-000/file-007.parquet"
INFO = ("meta/info.json",)


def put(file, column, values):
    array = pa.array(values)
    return lambda root: change_table(root, file, lambda t: set_column(t, column, array))


HUGE, FROM = [0, 2**62, 1], "dataset_from_index"


def wide(root):
    change_info(root, lambda i: i["features"]["observation.state"].update(shape=[10**12]))


def test_an_edit_of_the_metadata_is_noticed_by_the_data_files(root):
    change_info(root, lambda i: i["features"]["observation.state"].update(names=list("abc")))
    with pytest.raises(DatasetError, match="written with"):
        load_lerobot(root)


@pytest.mark.parametrize(
    ("check", "damage", "place"),
    [
        ("metadata", in_info(total_episodes=4), INFO),
        ("metadata", in_info(total_frames=35), INFO),
        ("metadata", lambda root: shutil.copy(root / DATA, root / EXTRA), (EXTRA,)),
        ("duplicates", put(EPISODES, "episode_index", [0, 1, 1]), (None, 1)),
        ("missing", lambda root: (root / EPISODES).unlink(), ("meta/episodes",)),
        ("missing", lambda root: (root / "meta/info.json").unlink(), ()),
        ("", lambda root: (root / "meta/info.json").write_text("{"), INFO),
        ("", in_info(codebase_version="v1.6"), INFO),
        ("", in_info(fps="fast"), INFO),
        ("", in_info(features={}), INFO),
        ("", in_info(data_path="../{chunk_index}"), INFO),
        ("", in_info(data_path="{file}"), INFO),
        ("", in_info(data_path="{chunk_index:099999999d}/{file_index}"), INFO),
        ("", in_info(data_path=7), INFO),
        ("", in_info(fps=10**400), INFO),
        ("", lambda root: (root / "meta/info.json").write_text("[" * 100_000), INFO),
        ("", put(EPISODES, "data/chunk_index", HUGE), (EPISODES, None, "data/chunk_index")),
        ("", put(EPISODES, FROM, HUGE), (EPISODES, None, FROM)),
        ("", wide, (*INFO, None, "observation.state")),
    ],
)
def test_metadata_that_are_wrong_are_refused_and_located(root, check, damage, place):
    damage(root)
    assert_refused(root, check, *place)

"""Where the page gets demonstrations from."""

import shutil
import zipfile

import numpy as np
import pytest

from tests.support.worlds import upper_body
from tpgmm_datasets import save_lerobot
from tpgmm_datasets.tables import demonstrations_to_frame, write_table
from tpgmm_tools.app import sources
from tpgmm_torch.exceptions import DataError


@pytest.fixture(scope="module")
def archive(tmp_path_factory, bottles):
    """Write a data set as somebody would zip its folder."""
    place = tmp_path_factory.mktemp("sets")
    save_lerobot(bottles, place / "above" / "dataset", fps=20, task="shake")
    return shutil.make_archive(str(place / "mine"), "zip", place / "above")


def test_a_zipped_data_set_is_read_with_the_robots_joints(archive, bottles):
    with pytest.raises(DataError, match=r"poses\.csv is not in the set"):
        sources.read_uploads([archive], upper_body(), ["cup=/etc/poses.csv"])
    read = sources.read_uploads([archive], upper_body())
    assert len(read) == 2
    for one, other in zip(read, bottles, strict=True):
        np.testing.assert_allclose(one.joints, other.joints, atol=1e-6)
        places = (d.frames["bottle"].position for d in (one, other))
        np.testing.assert_allclose(*places, atol=1e-6)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_tables_are_read_one_demonstration_each_or_several(tmp_path, bottles, suffix):
    one, both = tmp_path / f"b{suffix}", tmp_path / f"a{suffix}"
    write_table(demonstrations_to_frame(bottles[:1]).drop(columns="episode"), one)
    write_table(demonstrations_to_frame(bottles), both)
    read = sources.read_uploads([one, both])
    assert [len(d) for d in read] == [len(d) for d in (*bottles, bottles[0])]
    np.testing.assert_allclose(read[-1].joints, bottles[0].joints)


@pytest.mark.parametrize(
    ("names", "complaint"),
    [
        ((), "got no file"),
        (("notes.txt",), r"give one \.zip .* got notes\.txt"),
        (("a.zip", "b.zip"), "got a.zip, b.zip"),
        (("a.zip", "b.csv"), "got a.zip, b.csv"),
        (("broken.zip",), "broken.zip cannot be unpacked: File is not a zip file"),
    ],
)
def test_other_files_are_refused(tmp_path, names, complaint):
    for name in names:
        (tmp_path / name).write_text("nothing")
    with pytest.raises(DataError, match=complaint):
        sources.read_uploads([tmp_path / name for name in names])


@pytest.mark.parametrize(("count", "complaint"), [(0, "holds no"), (2, "holds 2")])
def test_an_archive_holds_one_data_set(tmp_path, count, complaint):
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as opened:
        for number in range(count):
            opened.writestr(f"{number}/meta/info.json", "{}")
    with pytest.raises(DataError, match=complaint):
        sources.read_uploads([tmp_path / "x.zip"])


def test_an_archive_that_would_fill_the_disk_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "MOST_BYTES", 1000)
    with zipfile.ZipFile(tmp_path / "x.zip", "w", zipfile.ZIP_DEFLATED) as opened:
        opened.writestr("meta/info.json", "0" * 100_000)
    assert (tmp_path / "x.zip").stat().st_size < 1000
    with pytest.raises(DataError, match=r"x\.zip unpacks to"):
        sources.read_uploads([tmp_path / "x.zip"])


def test_names_that_lead_out_of_the_folder_stay_in_it(tmp_path, archive):
    evil = tmp_path / "evil.zip"
    shutil.copy(archive, evil)
    with zipfile.ZipFile(evil, "a") as opened:
        opened.writestr("../../escaped.txt", "out")
    assert len(sources.read_uploads([evil], upper_body())) == 2
    assert not list(tmp_path.rglob("escaped.txt"))
    assert not (tmp_path.parent / "escaped.txt").exists()

"""Where a data set is: folders, caches, the hub."""

import shutil
import sys
from pathlib import Path

import pytest

from tpgmm_datasets import DatasetError, load_lerobot
from tpgmm_torch.exceptions import DependencyError


def test_an_id_is_looked_up_in_the_cache_of_lerobot(root, tmp_path, monkeypatch):
    home = tmp_path / "home"
    shutil.copytree(root, home / "someone" / "bottles")
    monkeypatch.setenv("HF_LEROBOT_HOME", str(home))
    assert len(load_lerobot("someone/bottles")) == 3


def test_an_id_is_fetched_without_videos_or_the_error_says_how_to_get_it(root, monkeypatch):
    asked = {}

    def fetch(repo_id, **options):
        if asked:
            raise OSError("offline")
        asked.update(options, repo_id=repo_id)
        return str(root)

    monkeypatch.setattr("huggingface_hub.snapshot_download", fetch)
    assert len(load_lerobot("hf://datasets/someone/bottles")) == 3
    assert asked["repo_id"] == "someone/bottles"
    assert not any("videos" in pattern for pattern in asked["allow_patterns"])
    with pytest.raises(DatasetError, match="hf download --repo-type dataset someone/bottles"):
        load_lerobot("hf://datasets/someone/bottles")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(DependencyError, match="pip install"):
        load_lerobot("hf://datasets/someone/bottles")


@pytest.mark.parametrize("path", ["recordings/botles", Path("recordings/botles"), "botles"])
def test_a_folder_that_is_not_there_is_never_looked_up_on_the_hub(path, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.snapshot_download", asked.append)
    with pytest.raises(DatasetError, match="there is no folder") as caught:
        load_lerobot(path)
    assert not asked
    said = "hub is hf://datasets/recordings/botles" in str(caught.value)
    assert said == (path == "recordings/botles")


@pytest.mark.parametrize("path", ["hf://someone/bottles", "s3://bucket/bottles"])
def test_an_address_that_is_none_of_the_hub_is_refused(path):
    with pytest.raises(DatasetError, match="is neither a folder nor hf://datasets/OWNER/NAME"):
        load_lerobot(path)

"""Where a data set is: folders, caches, the hub."""

import shutil
import sys

import pytest

from tests.support.lerobot_sets import assert_refused
from tests.support.written_sets import FPS, demonstration
from tpgmm_datasets import (
    DatasetError,
    load_lerobot,
    save_lerobot,
)
from tpgmm_torch.exceptions import DependencyError


def test_an_id_is_looked_up_in_the_cache_of_lerobot(root, tmp_path, monkeypatch):
    home = tmp_path / "home"
    shutil.copytree(root, home / "someone" / "bottles")
    monkeypatch.setenv("HF_LEROBOT_HOME", str(home))
    assert len(load_lerobot("someone/bottles")) == 3


def test_an_id_is_fetched_without_videos(root, tmp_path, monkeypatch):
    asked = {}

    def fetch(repo_id, **options):
        asked.update(options, repo_id=repo_id)
        return str(root)

    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.snapshot_download", fetch)
    assert len(load_lerobot("someone/bottles")) == 3
    assert asked["repo_id"] == "someone/bottles"
    assert not any("videos" in pattern for pattern in asked["allow_patterns"])


def test_an_id_out_of_reach_says_how_to_get_it(tmp_path, monkeypatch):
    def fetch(repo_id, **options):
        raise OSError("offline")

    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.snapshot_download", fetch)
    with pytest.raises(DatasetError, match="hf download --repo-type dataset someone/bottles"):
        load_lerobot("someone/bottles")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(DependencyError, match="pip install"):
        load_lerobot("someone/bottles")


def test_an_exchange_that_was_killed_is_pointed_out(tmp_path):
    root = save_lerobot([demonstration(0)], tmp_path / "set", fps=FPS, task="reach")
    root.rename(tmp_path / ".set.0123.previous")
    with pytest.raises(DatasetError, match=r"interrupted.*\.set\.0123\.previous"):
        load_lerobot(root)


def test_a_folder_that_is_not_there_is_refused(root):
    shutil.rmtree(root)
    assert_refused(root, "missing")

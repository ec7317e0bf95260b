"""Models go to a hub and come back; nothing else is fetched, and nothing is run."""

import sys

import pytest
import torch

from tests.support.hub_server import local_hub
from tests.support.refusals import refused
from tests.support.skills import small_bottle
from tpgmm_torch import TaskParameterizedGMM, save
from tpgmm_torch.exceptions import DataError, DependencyError, ModelFileError
from tpgmm_torch.hub import load, push


@pytest.fixture
def hub(monkeypatch, tmp_path):
    with local_hub(monkeypatch, tmp_path / "cache") as hub:
        yield hub


def test_a_model_comes_back_from_the_hub(hub):
    model = small_bottle()
    address = push(model, "lab/shake", measured={"grasp": "0.2 mm"}, license="mit")
    assert address.startswith(f"{hub.url}/lab/shake/commit/")
    files = hub.repositories["lab/shake"]
    assert files.keys() == {"README.md", "config.json", "model.safetensors"}
    card = files["README.md"].decode()
    assert "license: mit" in card
    assert "| grasp | 0.2 mm |" in card
    again = load("lab/shake")
    for one, other in zip(model.means_, again.means_, strict=True):
        assert torch.equal(one, other)


def test_only_the_files_of_a_model_are_fetched(hub, tmp_path):
    push(small_bottle(), "lab/shake")
    hub.repositories["lab/shake"]["evil.py"] = b"raise SystemExit"
    hub.repositories["lab/shake"]["model.pkl"] = b"cos\nsystem\n"
    load("lab/shake")
    fetched = {path.name for path in (tmp_path / "cache").rglob("snapshots/*/*")}
    assert fetched == {"config.json", "model.safetensors"}


def test_what_was_changed_on_the_hub_is_refused(hub):
    push(small_bottle(), "lab/shake")
    files = hub.repositories["lab/shake"]
    files["config.json"] = files["config.json"].replace(b'"l_hand"', b'"r_hand"')
    refused(lambda: load("lab/shake"), ModelFileError, "changed after it was saved")


def test_a_folder_is_taken_as_it_is(tmp_path, hub):
    save(small_bottle(), tmp_path / "model")
    load(tmp_path / "model")
    load(str(tmp_path / "model"))
    assert not hub.paths


@pytest.mark.parametrize("missing", ["./model", "/lab/shake", "model", "a/b/c", "../model"])
def test_a_folder_that_is_missing_is_not_looked_up(missing, hub, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(lambda: load(missing), ModelFileError, "there is no folder")
    assert not hub.paths


def test_a_repository_that_is_missing_is_an_error_of_this_project(hub):
    refused(lambda: load("lab/none"), ModelFileError, "lab/none")


def test_an_id_needs_an_owner_and_a_fitted_model(hub):
    refused(lambda: push(small_bottle(), "shake"), DataError, "owner/name")
    refused(lambda: push(TaskParameterizedGMM(3), "lab/shake"), Exception, "not fitted")
    assert not hub.paths


def test_without_the_package_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    refused(lambda: load("lab/shake"), DependencyError, r"tpgmm-torch\[hub\]")

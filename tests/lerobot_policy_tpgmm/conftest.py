"""A saved policy, and data sets to train on; not to be changed."""

from dataclasses import replace

import pytest

import lerobot_env_bimanual  # noqa: F401  registers the environments
from tests.support.errands import errands
from tests.support.policies import fitted
from tests.support.training import FPS, dataset, handlings_set, slow_waves, waves_set
from tpgmm_datasets import save_lerobot


@pytest.fixture(scope="session")
def saved(tmp_path_factory):
    """The directory of a pretrained policy; not to be changed."""
    path = tmp_path_factory.mktemp("policy") / "saved"
    fitted().save_pretrained(path)
    return path


@pytest.fixture(scope="session")
def waves(tmp_path_factory):
    """Joints alone."""
    return dataset(waves_set(tmp_path_factory.mktemp("waves") / "set"))


@pytest.fixture(scope="session")
def commanded(tmp_path_factory):
    """Joints alone, behind what was commanded."""
    path, shown = tmp_path_factory.mktemp("commanded") / "set", slow_waves()
    actions = [1.1 * one.joints + 0.02 for one in shown]
    save_lerobot(shown, path, fps=FPS, task="wave", actions=actions)
    return dataset(path)


@pytest.fixture(scope="session")
def handlings(tmp_path_factory):
    """Two hands and a cup."""
    return dataset(handlings_set(tmp_path_factory.mktemp("handlings") / "set"))


@pytest.fixture(scope="session")
def errand_set(tmp_path_factory):
    """A hand that takes from a cup to a tray, now sooner, now later."""
    path = tmp_path_factory.mktemp("errands") / "set"
    shown = [replace(one, events={}) for one in errands(6, shift=0.2)]
    save_lerobot(shown, path, fps=20, task="carry")
    return dataset(path)

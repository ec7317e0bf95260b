"""Errors that say where."""

import pickle

import pytest

from tests.support.lerobot_sets import DATA
from tpgmm_datasets import DatasetError, load_lerobot
from tpgmm_datasets.errors import CHECKS


def test_errors_survive_pickling(root):
    (root / DATA).unlink()
    with pytest.raises(DatasetError) as caught:
        load_lerobot(root)
    copy = pickle.loads(pickle.dumps(caught.value))
    assert str(copy) == str(caught.value)
    assert (copy.file, copy.check) == (DATA, "missing")


@pytest.mark.parametrize("check", CHECKS)
def test_what_relax_helps_is_said_with_what_it_costs(check):
    message = str(DatasetError("it is wrong", check=check, file=DATA, episode=3))
    assert f"relax=['{check}'] (--relax {check}) the episode is left out" in message
    assert message == str(DatasetError(message, check=check))
    message = str(DatasetError("it is wrong", check=check, file="meta/info.json"))
    assert ("relax=" in message) == (check != "missing")

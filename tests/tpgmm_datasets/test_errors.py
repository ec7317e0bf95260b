"""Errors that say where."""

import pickle

import pytest

from tests.support.lerobot_sets import DATA
from tpgmm_datasets import DatasetError, load_lerobot


def test_errors_survive_pickling(root):
    (root / DATA).unlink()
    with pytest.raises(DatasetError) as caught:
        load_lerobot(root)
    copy = pickle.loads(pickle.dumps(caught.value))
    assert str(copy) == str(caught.value)
    assert (copy.file, copy.check) == (DATA, "missing")

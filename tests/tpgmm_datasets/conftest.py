"""A small data set of three episodes in layout v3.0."""

import pytest

from tests.support.lerobot_sets import write


@pytest.fixture
def root(tmp_path):
    write(tmp_path / "set")
    return tmp_path / "set"

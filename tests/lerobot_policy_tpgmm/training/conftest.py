"""The data sets that policies of these tests are trained on; not to be changed."""

import pytest

from tests.support.training import dataset, handlings_set, waves_set


@pytest.fixture(scope="session")
def waves(tmp_path_factory):
    """Joints alone."""
    return dataset(waves_set(tmp_path_factory.mktemp("waves") / "set"))


@pytest.fixture(scope="session")
def handlings(tmp_path_factory):
    """Two hands and a cup."""
    return dataset(handlings_set(tmp_path_factory.mktemp("handlings") / "set"))

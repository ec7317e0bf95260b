"""A saved policy that several files look at."""

import pytest

import lerobot_env_bimanual  # noqa: F401  registers the environments
from tests.support.policies import fitted


@pytest.fixture(scope="session")
def saved(tmp_path_factory):
    """The directory of a pretrained policy; not to be changed."""
    path = tmp_path_factory.mktemp("policy") / "saved"
    fitted().save_pretrained(path)
    return path

"""Demonstrations of a small skill."""

import pytest

from tests.support import skills


@pytest.fixture(scope="package")
def bottles():
    return skills.generator().demonstrations(2)

"""A small data set of the skill, and a model of it."""

import pytest

from tests.support.command_line import UPPER_BODY, output
from tpgmm_datasets import save_lerobot
from tpgmm_datasets.bottle.skill import BottleShaking


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "bottle"
    demonstrations = BottleShaking(rate=20).demonstrations(3)
    save_lerobot(demonstrations, folder, fps=20, task="shake")
    return folder


@pytest.fixture(scope="session")
def bottle_model(dataset, tmp_path_factory):
    """Folder of a model, and what fitting it printed."""
    folder = tmp_path_factory.mktemp("fit") / "model"
    options = ("--n-components", 6, "--reg-covar", 1e-5, "--fusion", "covariance")
    return folder, output("fit", dataset, *UPPER_BODY, *options, "--out", folder)

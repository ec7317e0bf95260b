"""The rate at which an environment takes actions, and whether a policy gives as many."""

import pytest
import torch

from lerobot_env_bimanual.control_rate import rate_processors
from lerobot_policy_tpgmm.observations import CONTROL_RATE, check_rate
from tests.support.policies import act, batch, changed, fitted
from tpgmm_torch.exceptions import DataError


def with_rate(rate):
    return {CONTROL_RATE: torch.full((2, 1), float(rate))}


@pytest.mark.parametrize("rate", [100, 99.95, 100.05])
def test_the_same_rate_is_accepted(rate):
    check_rate(with_rate(rate), 100.0)
    check_rate({}, 100.0)  # most environments do not tell


@pytest.mark.parametrize("rate", [50, 99.8, 100.2, 200])
def test_another_rate_is_refused(rate):
    message = rf"takes {rate:g} actions per second, the policy gives 100: --policy.control_fps="
    with pytest.raises(DataError, match=message):
        check_rate(with_rate(rate), 100.0)


def test_a_policy_looks_at_it():
    before, _ = rate_processors(50)
    with pytest.raises(DataError, match=r"takes 50 actions per second, the policy gives 2.\d+"):
        act(fitted(), before(batch()), 1)
    same = changed(fitted(), control_fps=50.0)
    assert torch.equal(act(same, before(batch()), 3), act(same, batch(), 3))

"""Episodes from shuffled batches: what does not belong is refused."""

import pytest
import torch

from tests.support.policies import STATE
from tests.support.training import WAVES, epoch, fresh
from tpgmm_torch.exceptions import DataError


def change_row(batch: dict, key: str, value: float, row: int = 3) -> dict:
    values = batch[key].clone()
    values[row] = value
    return {**batch, key: values}


def test_frames_that_change_are_refused(waves):
    policy, [batch, *_] = fresh(waves, **WAVES), epoch(waves, 10)
    policy.forward(batch)
    policy.forward(batch)
    number = int(batch["episode_index"][3])
    with pytest.raises(DataError, match=f"of episode {number} has other values"):
        policy.forward(change_row(batch, STATE, 0.5))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: change_row(b, STATE, torch.nan), "observation.state holds NaN"),
        (lambda b: change_row(b, "action", torch.inf), "action holds NaN or inf"),
        (lambda b: change_row(b, "timestamp", 7.0), "timestamp 7 s. Resample the set"),
        (lambda b: change_row(b, "index", 4000), "no frame 4000 in episode"),
        (lambda b: change_row(b, "episode_index", 9), "in episode 9"),
        (lambda b: {k: v for k, v in b.items() if k != "index"}, "needs 'index'"),
        (lambda b: {k: v for k, v in b.items() if k != STATE}, "needs .observation.state"),
    ],
)
def test_bad_batches_are_refused(waves, change, message):
    policy, [batch, *_] = fresh(waves, **WAVES), epoch(waves, 10)
    with pytest.raises(DataError, match=message):
        policy.forward(change(batch))

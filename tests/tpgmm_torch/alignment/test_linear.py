"""Laws of linear time normalisation."""

import numpy as np
import pytest

from tpgmm_torch.alignment import LinearTimeNormalization
from tpgmm_torch.data.demonstrations import Demonstration


@pytest.mark.parametrize("duration, expected", [("mean", 2.0), ("median", 1.5), (1.0, 1.0)])
def test_linear_normalization_scales_durations_and_events(duration, expected):
    family = [
        Demonstration(
            np.linspace(5, 5 + t, 31), np.arange(31.0)[:, None], events={"half": 5 + t / 2}
        )
        for t in (1.0, 1.5, 3.5)
    ]
    for aligned in LinearTimeNormalization(duration).fit_transform(family):
        assert (float(aligned.time[0]), aligned.duration) == pytest.approx((0, expected))
        assert aligned.events["half"] == pytest.approx(expected / 2)
        assert aligned.joints[:, 0].tolist() == pytest.approx(list(range(31)))

"""Laws of linear time normalisation."""

import numpy as np
import pytest
import torch

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


def ramp(start, end, n):
    return Demonstration(np.linspace(start, end, n), np.arange(float(n))[:, None])


def test_the_grid_has_the_median_number_of_steps_from_zero():
    family = [ramp(0, 1, 11), ramp(3, 5, 21), ramp(0, 6, 61)]
    transformer = LinearTimeNormalization().fit(family)
    np.testing.assert_allclose(transformer.time_, np.linspace(0, 3, 21))
    assert transformer.time_.dtype == torch.float64
    for path, one in zip(transformer.paths_, family, strict=True):
        np.testing.assert_allclose(path, np.linspace(0, len(one) - 1, 21), atol=1e-12)
    even = LinearTimeNormalization().fit([ramp(0, 1, 11), ramp(0, 1, 14)])
    assert len(even.time_) == 12  # 12.5, rounded to even
    assert len(LinearTimeNormalization(n_steps=5).fit(family).time_) == 5


def test_instants_are_proportional_also_where_time_steps_are_not():
    time = np.array([0.0, 1.0, 4.0])
    uneven = Demonstration(time, time[:, None])
    [aligned] = LinearTimeNormalization(2.0, n_steps=5).fit_transform([uneven])
    np.testing.assert_allclose(aligned.joints[:, 0], 2 * aligned.time, atol=1e-12)


@pytest.mark.parametrize(
    "parameters",
    [{"duration": 0}, {"duration": "longest"}, {"n_steps": 1}, {"interpolation": 3}],
)
def test_parameters_that_are_none_are_named(parameters):
    with pytest.raises(ValueError, match=next(iter(parameters))):
        LinearTimeNormalization(**parameters).fit([ramp(0, 1, 3)])

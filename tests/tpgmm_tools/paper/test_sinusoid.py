"""A sinusoid is found, and its residual is the noise."""

import numpy as np
import pytest
import torch

from tpgmm_tools.paper.sinusoid import sinusoid


@pytest.mark.parametrize("frequency", [0.4, 0.667, 1.9, 7.3])
@pytest.mark.parametrize("phase", [0.0, 1.0, -2.5])
def test_a_sinusoid_is_found_again(frequency, phase):
    time = np.linspace(2.0, 6.5, 120)
    found = sinusoid(time, 0.3 + 0.25 * np.sin(2 * np.pi * frequency * time + phase))
    assert found.frequency == pytest.approx(frequency, rel=1e-6)
    assert found.amplitude == pytest.approx(0.25, rel=1e-5)
    assert found.offset == pytest.approx(0.3, abs=1e-5)
    assert np.cos(found.phase - phase) == pytest.approx(1, abs=1e-6)
    assert found.residual < 1e-5


def test_what_a_sinusoid_leaves_is_the_noise():
    time = torch.linspace(0, 4.5, 450, dtype=torch.float64)
    noise = 0.02 * np.random.default_rng(0).standard_normal(450)
    found = sinusoid(time, torch.sin(5 * time) + torch.from_numpy(noise))
    assert found.frequency == pytest.approx(5 / (2 * np.pi), rel=2e-3)
    assert found.amplitude == pytest.approx(1, rel=5e-3)
    assert found.residual == pytest.approx(0.02, rel=0.1)

"""Axes of forces that do no work, against hand-computed shares."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.pressing import FRICTION, PRESS, slides, wipes
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators import Wrench
from tpgmm_torch.training.local_data import Motion
from tpgmm_torch.training.operator_completion import shares_of_work, with_force_axes

HAND = Wrench("hand", "board")


def motions(demonstrations):
    return [Motion.of(one, slides()) for one in demonstrations]


def test_friction_works_and_a_press_does_not():
    shares, sizes = shares_of_work(HAND, motions(wipes()))
    np.testing.assert_allclose(sizes, [FRICTION * PRESS, 0, PRESS], atol=1e-9)
    assert shares[0] > 0.95
    assert shares[2] < 0.05
    assert with_force_axes([HAND], motions(wipes())) == (Wrench("hand", "board", [2]),)


def test_given_axes_are_kept():
    given = Wrench("hand", "board", [0])
    assert with_force_axes([given], motions(wipes())) == (given,)


def test_pushing_a_damper_is_work():
    shown = wipes()[0]
    time = np.asarray(shown.time)
    way = 0.05 * np.sin(np.pi * time / time[-1])
    joints = torch.from_numpy(np.stack((0 * way, 0 * way, 0.3 - way), -1))
    wrench = torch.zeros(len(time), 6).double()
    wrench[:, 2] = torch.from_numpy(-200 * np.gradient(way, time))
    pushed = replace(shown, joints=joints, wrenches={"hand": wrench})
    with pytest.raises(DataError, match=r"no force of 'hand' .* z 1\.00 at"):
        with_force_axes([HAND], motions([pushed]))

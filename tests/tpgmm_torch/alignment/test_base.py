"""Playing demonstrations on another clock, and what all alignments share."""

import numpy as np
import pytest
import torch
from sklearn.base import clone

from tests.support.motions import DEMONSTRATIONS, turning
from tpgmm_torch.alignment import DynamicTimeWarping, LinearTimeNormalization
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import (
    DataError,
    NotFittedError,
    ShapeError,
    UnknownNameError,
)
from tpgmm_torch.robots.tracked_poses import Poses


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_moving_frames_and_recorded_poses_turn_along_great_arcs(interpolation):
    coarse, fine = np.linspace(0, 2, 9), np.linspace(0, 1, 65)
    transformer = LinearTimeNormalization(
        n_steps=65, duration=1.0, robot=Poses(["hand"]), interpolation=interpolation
    )
    [aligned] = transformer.fit_transform([turning(coarse, coarse / 2)])
    exact = turning(fine, fine)
    arcs = aligned.frames["moving"].orientation
    torch.testing.assert_close(arcs, exact.frames["moving"].orientation, rtol=0, atol=1e-12)
    torch.testing.assert_close(aligned.joints[:, 3:], arcs, rtol=0, atol=1e-12)
    error = (aligned.joints[:, :3] - exact.joints[:, :3]).abs().max()
    assert error < (1e-3 if interpolation == "cubic" else 2e-2)


@pytest.mark.parametrize("transformer", [DynamicTimeWarping(), LinearTimeNormalization()])
def test_n_steps_sets_the_grid(transformer):
    aligned = clone(transformer).set_params(n_steps=57).fit_transform(DEMONSTRATIONS[:2])
    assert [len(d) for d in aligned] == [57, 57]
    torch.testing.assert_close(aligned[0].time.diff(), aligned[0].time.diff()[:1].expand(56))


@pytest.mark.parametrize("transformer", [DynamicTimeWarping(), LinearTimeNormalization()])
def test_errors_say_what_is_wrong_with_the_input(transformer):
    with pytest.raises(NotFittedError, match="call fit"):
        clone(transformer).transform(DEMONSTRATIONS)
    for wrong in (DEMONSTRATIONS[0], [], [1], 5):
        with pytest.raises(DataError, match="expected"):
            clone(transformer).fit_transform(wrong)
    with pytest.raises(DataError, match="one time step"):
        clone(transformer).fit([Demonstration([0.0], [[1.0]])])
    fitted = clone(transformer).fit(DEMONSTRATIONS[:2])
    with pytest.raises(UnknownNameError, match="'a' is not in the demonstration"):
        fitted.transform([Demonstration([0.0, 1.0], np.eye(2), joint_names=("x", "y"))])
    with pytest.raises(ShapeError, match="the robot has 7"):
        clone(transformer).set_params(robot=Poses(["hand"])).fit_transform(
            [Demonstration([0.0, 1.0], np.eye(2))]
        )

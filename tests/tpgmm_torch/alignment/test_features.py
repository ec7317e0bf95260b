"""What demonstrations are compared by."""

import numpy as np
import pytest
import torch

from tests.support.motions import DEMONSTRATIONS, Arm
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import (
    DataError,
    UnknownNameError,
)


def test_features_are_named_and_constant_ones_left_out():
    transformer = DynamicTimeWarping(0, robot=Arm()).fit(DEMONSTRATIONS[:2])
    assert transformer.feature_names_ == ("joints", "directions", "elbow", "hand")
    chosen = ["hand in bottle", "joints"]
    transformer = DynamicTimeWarping(0, features=chosen, robot=Arm()).fit(DEMONSTRATIONS[:2])
    assert transformer.feature_names_ == tuple(chosen)
    still = [
        Demonstration(d.time, d.joints * torch.tensor([0.0, 1, 0, 1, 1]), d.frames)
        for d in DEMONSTRATIONS[:2]
    ]
    assert "elbow" not in DynamicTimeWarping(0, robot=Arm()).fit(still).feature_names_


def test_nothing_to_align_by_is_an_error():
    still = Demonstration(np.arange(5.0), np.ones((5, 2)))
    with pytest.raises(DataError, match="nothing to align by"):
        DynamicTimeWarping().fit([still, still])


def test_frames_unknown_to_fit_are_an_error():
    fitted = DynamicTimeWarping(0, features=["elbow in bottle"], robot=Arm())
    fitted.fit(DEMONSTRATIONS[:2])
    bare = Demonstration(DEMONSTRATIONS[0].time, DEMONSTRATIONS[0].joints, None, tuple("abcde"))
    with pytest.raises(UnknownNameError, match="'elbow in bottle'"):
        fitted.transform([bare])

"""Demonstrations that are unlike the others are dropped, with one warning that names them."""

import warnings
from dataclasses import replace

import pytest
import torch

from tests.support.skills import HANDLING, HANDS, handlings
from tpgmm_datasets import drop_outliers
from tpgmm_torch import Frame
from tpgmm_torch.exceptions import PlausibilityWarning, UnknownNameError


def misplaced(demonstration):
    """The cup was seen in a wrong place."""
    cup = demonstration.frames["cup"]
    there = cup.position + torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64)
    return replace(demonstration, frames={"cup": Frame(there, cup.orientation)})


def test_one_is_dropped_and_named_once():
    shown = handlings(8)
    shown[5] = misplaced(shown[5])
    with pytest.warns(PlausibilityWarning, match=r"1 of 8 .* demonstration 5 \(") as caught:
        rest = drop_outliers(shown, HANDLING, HANDS)
    assert len(caught) == 1 and caught[0].filename == __file__
    assert all(one is other for one, other in zip(rest, [*shown[:5], *shown[6:]], strict=True))


def test_demonstrations_that_are_alike_are_kept():
    shown = handlings(6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(drop_outliers(shown, HANDLING, HANDS)) == 6
    with pytest.raises(UnknownNameError, match="'cup'"):
        drop_outliers([replace(one, frames={}) for one in shown], HANDLING, HANDS)

"""Alignments by name."""

from typing import get_args

import pytest

from tpgmm_tools.cli.options import AlignmentMethod
from tpgmm_torch.alignment import (
    DynamicTimeWarping,
    EventAlignment,
    LinearTimeNormalization,
)
from tpgmm_torch.alignment.text import METHODS, parse_alignment
from tpgmm_torch.exceptions import DataError


def test_names_stand_for_alignments():
    found = {method: parse_alignment(method, features=["speed"]) for method in METHODS}
    assert found.pop("none") is None
    kinds = {method: type(one) for method, one in found.items()}
    assert kinds == {
        "dtw": DynamicTimeWarping,
        "barycenter": DynamicTimeWarping,
        "linear": LinearTimeNormalization,
        "events": EventAlignment,
        "events+dtw": EventAlignment,
    }
    assert (found["dtw"].reference, found["barycenter"].reference) == ("medoid", "barycenter")
    assert found["events"].within is None
    assert found["events+dtw"].within.features == ["speed"]
    with pytest.raises(DataError, match=r"one of \['dtw', .*got 'warp'"):
        parse_alignment("warp")


def test_the_command_line_knows_them_all():
    """And the one that first finds where to anchor."""
    choices, _ = get_args(AlignmentMethod)
    assert set(get_args(choices)) == {*METHODS, "parts"}

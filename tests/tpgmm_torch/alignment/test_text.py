"""Alignments by name."""

from typing import get_args

from tests.support.refusals import refused
from tpgmm_tools.arguments.options import Alignments
from tpgmm_torch.alignment.text import METHODS, parse_alignment
from tpgmm_torch.exceptions import DataError


def test_names_stand_for_alignments():
    assert {method: repr(parse_alignment(method)) for method in METHODS} == {
        "dtw": "DynamicTimeWarping()",
        "barycenter": "DynamicTimeWarping(reference='barycenter')",
        "linear": "LinearTimeNormalization()",
        "events": "EventAlignment()",
        "events+dtw": "EventAlignment(within=DynamicTimeWarping())",
        "none": "None",
    }
    assert parse_alignment("events+dtw", features=["speed"]).within.features == ["speed"]
    refused(lambda: parse_alignment("warp"), DataError, r"one of \['dtw', .*got 'warp'")


def test_the_command_line_has_them_all():
    """And the one that first finds where to anchor."""
    assert set(get_args(Alignments)) == {*METHODS, "parts"}

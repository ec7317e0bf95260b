"""Choices by name: alignments."""

from typing import get_args

from tests.support.refusals import refused
from tpgmm_tools.arguments.options import Alignments
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.structure.choices import ALIGNMENTS, aligner


def test_names_stand_for_alignments():
    assert {name: repr(aligner(name)) for name in ALIGNMENTS if name != "parts"} == {
        "dtw": "DynamicTimeWarping()",
        "barycenter": "DynamicTimeWarping(reference='barycenter')",
        "linear": "LinearTimeNormalization()",
        "events": "EventAlignment()",
        "events+dtw": "EventAlignment(within=DynamicTimeWarping())",
        "none": "None",
    }
    assert aligner("events+dtw", features=["speed"]).within.features == ["speed"]
    refused(lambda: aligner("warp"), DataError, r"one of \['dtw', .*got 'warp'")


def test_the_command_line_has_them_all():
    assert set(get_args(Alignments)) == {*ALIGNMENTS}

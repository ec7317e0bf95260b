"""Operators as text."""

from dataclasses import dataclass

import pytest

from tests.support.refusals import refused
from tpgmm_torch import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.text import default_operators, format_operator, parse_operator

OPERATORS = [
    Canonical(),
    AbsolutePosition("l_hand"),
    RelativePosition("l_hand", "bottle"),
    AbsoluteOrientation("l_hand"),
    RelativeOrientation("l_hand", "r_hand"),
    Stack(RelativePosition("l_hand", "bottle"), AbsoluteOrientation("r_hand"), Canonical()),
    RelativePosition("bottle", "tray"),
    RelativeOrientation("r_hand", "bottle", held=True),
    Stack(RelativePosition("lid", "bottle", held=True), RelativePosition("l_hand", "lid")),
    Canonical(tolerance=0.02),
    Canonical(joints=("left_*", "waist_yaw")),
    Canonical(0.1, ("left_*",)),
    RelativePosition("l_hand", "bottle", tolerance=1e-5),
    Stack(AbsoluteOrientation("l_hand", tolerance=0.1), Canonical(tolerance=2.0)),
    RelativeOrientation("r_hand", "bottle", held=True, tolerance=0.1, geometry="tangent"),
    Stack(AbsoluteOrientation("l_hand", geometry="tangent"), AbsoluteOrientation("r_hand")),
]


@pytest.mark.parametrize("operator", OPERATORS, ids=format_operator)
def test_the_text_of_an_operator_stands_for_it(operator):
    assert parse_operator(format_operator(operator)) == operator


def test_a_pose_is_position_and_orientation():
    both = Stack(RelativePosition("l_hand", "bottle"), RelativeOrientation("l_hand", "bottle"))
    assert parse_operator(" pose:l_hand@bottle ") == both
    assert parse_operator("pose:l_hand + position:r_hand").operators == (
        AbsolutePosition("l_hand"),
        AbsoluteOrientation("l_hand"),
        AbsolutePosition("r_hand"),
    )


@pytest.mark.parametrize(
    "text",
    ["", "canonical +", "pos:l_hand", "position:", "position:a@", "position:a@b@c",
     "pose:a@held:", "parameters", "parameters@a[0]", "canonical~", "canonical:",
     "canonical:a,", "canonical~-1", "canonical~0.1~0.2"],
)  # fmt: skip
def test_what_is_no_operator_is_refused_and_explained(text):
    refused(lambda: parse_operator(text), DataError, "A term is 'canonical', or")


def test_a_pose_has_two_tolerances():
    with pytest.raises(DataError, match=r"position \[m\] and an orientation \[rad\]"):
        parse_operator("pose:l_hand@bottle~0.01")


def test_an_operator_of_ones_own_goes_by_its_repr():
    @dataclass(frozen=True)
    class Height(AbsolutePosition):
        floor: float = 0.0

    class Mine(Operator):
        dimension = linearize = coordinates = links = None

        def __repr__(self):
            return "Mine()"

    assert format_operator(Mine()) == "Mine()"
    assert format_operator(Height("hand", floor=0.1)) == repr(Height("hand", floor=0.1))


@pytest.mark.parametrize(("links", "frames", "expected"), [
    ([], ["bottle"], ["canonical"]),
    (["hand"], [], ["pose:hand", "canonical"]),
    (
        ["left", "right"],
        ["bottle", "cup"],
        [
            "pose:left@bottle + pose:right@bottle + pose:left@cup + pose:right@cup",
            "canonical",
        ],
    ),
])  # fmt: skip
def test_by_default_all_links_are_seen_from_all_frames(links, frames, expected):
    assert default_operators(links, frames) == [parse_operator(text) for text in expected]

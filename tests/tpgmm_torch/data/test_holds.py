"""What may be said of who holds what, and when."""

import copy
import math
import pickle

import pytest

from tests.support.refusals import refused
from tpgmm_torch import Hold
from tpgmm_torch.data.holds import check_holds
from tpgmm_torch.exceptions import DataError, UnknownNameError

FRAMES, LINKS = ("bottle", "tray"), ("l_hand", "r_hand")
HOLDS = {
    "bottle@l_hand": Hold("bottle", "l_hand"),
    "bottle@l_hand:4.3-": Hold("bottle", "l_hand", 4.3),
    "bottle@l_hand:-9.1": Hold("bottle", "l_hand", end=9.1),
    "bottle@l_hand:0.1-1e-05": Hold("bottle", "l_hand", 0.1e-5, 1e-5),
    "bottle@l_hand:-1.5-0.0": Hold("bottle", "l_hand", -1.5, 0.0),
}


@pytest.mark.parametrize("hold", HOLDS.values(), ids=str)
def test_the_text_of_a_hold_stands_for_it(hold):
    assert Hold.parse(str(hold)) == hold
    assert eval(repr(hold), {"Hold": Hold, "inf": math.inf}) == hold
    for other in (copy.deepcopy(hold), pickle.loads(pickle.dumps(hold))):
        assert other == hold and hash(other) == hash(hold)


def test_texts_are_read_as_they_are_written():
    for text in ("bottle@l_hand", "bottle@l_hand:4.3-", "bottle@l_hand:-9.1"):
        assert str(HOLDS[text]) == text
        assert Hold.parse(f" {text} ") == HOLDS[text]
    assert Hold.parse("bottle@l_hand:4-9") == Hold("bottle", "l_hand", 4, 9)
    assert Hold.parse("bottle@l_hand:-") == Hold("bottle", "l_hand")


@pytest.mark.parametrize(
    "text", ["", "bottle", "bottle@", "@hand", "a@b@c", "bottle@hand:soon-", "bottle@hand:4.3"]
)
def test_what_is_no_hold_is_refused_and_explained(text):
    refused(lambda: Hold.parse(text), DataError, r"FRAME@LINK:BEGIN-END.*'bottle@l_hand:4\.3-'")


@pytest.mark.parametrize("times", [(4.0, 3.0), (4.0, 4.0), (math.inf, math.inf)])
def test_the_end_is_after_the_beginning(times):
    with pytest.raises(DataError, match=r"bottle@l_hand is held from .* the end must be after"):
        Hold("bottle", "l_hand", *times)


@pytest.mark.parametrize(("hold", "message"), [
    (("", "l_hand"), "the frame of a hold is a name, got ''"),
    (("bottle", None), "the link of a hold is a name, got None"),
    (("bottle", "bottle"), "'bottle' cannot hold itself"),
    (("bottle", "l_hand", math.nan), "the begin of bottle@l_hand is a number"),
    (("bottle", "l_hand", 1.0, "late"), "the end of bottle@l_hand is a number"),
])  # fmt: skip
def test_names_are_names_and_times_are_times(hold, message):
    refused(lambda: Hold(*hold), DataError, message)


def test_holds_are_put_in_the_order_of_time():
    first, second = Hold("bottle", "l_hand", 1, 2), Hold("bottle", "r_hand", 2, 3)
    other = Hold("tray", "r_hand", 1.5)
    assert check_holds([second, other, first], FRAMES, LINKS) == (first, other, second)
    assert check_holds([], FRAMES, LINKS) == ()


@pytest.mark.parametrize(
    ("hold", "message"),
    [
        (Hold("cup", "l_hand", 1), r"frame 'cup' is not in the demonstration \(hold cup@"),
        (Hold("tray", "tail"), r"link 'tail' is not in the robot .*\['l_hand', 'r_hand'\]"),
    ],
)
def test_an_unknown_frame_or_link_is_named_with_those_that_exist(hold, message):
    refused(lambda: check_holds([hold], FRAMES, LINKS), UnknownNameError, message)


def test_one_link_is_the_holder():
    both = [Hold("bottle", "l_hand", 1, 3), Hold("bottle", "r_hand", 2)]
    with pytest.raises(DataError, match=r"twice at once, bottle@l_hand:1.*held=True"):
        check_holds(both, FRAMES, LINKS)
    with pytest.raises(DataError, match=r"holds are Hold objects, got 'bottle@l_hand'"):
        check_holds(["bottle@l_hand"], FRAMES, LINKS)

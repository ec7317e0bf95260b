"""Clocks as text."""

import pytest

from tpgmm_torch.control.clock_text import format_clock, parse_clock
from tpgmm_torch.control.clocks import Clock, EvenClock, WaitingClock
from tpgmm_torch.control.localizing_clock import LocalizingClock
from tpgmm_torch.exceptions import DataError


@pytest.mark.parametrize(
    ("text", "clock"),
    [
        ("even", EvenClock()),
        ("even:speed=0.5", EvenClock(0.5)),
        ("waiting", WaitingClock()),
        ("waiting:tolerance=3,lag=0.05", WaitingClock(tolerance=3, lag=0.05)),
        ("waiting:arrivals=4.5/7", WaitingClock(arrivals=(7, 4.5))),
        ("localizing", LocalizingClock()),
        (
            "localizing:floor=0.01,initial=anywhere",
            LocalizingClock(floor=0.01, initial="anywhere"),
        ),
    ],
)
def test_texts_and_clocks_are_each_others_inverse(text, clock):
    assert parse_clock(text) == parse_clock(clock) == clock
    assert format_clock(clock) == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sundial", r"no 'sundial'; there are \['even', 'waiting'.*waiting:tolerance=3"),
        ("", r"no ''; there are"),
        ("even:tolerance=3", r"'tolerance' is no option; 'even' has \['speed'\].*NAME=VALUE"),
        ("waiting:", r"'' is no option; 'waiting' has \['speed', 'tolerance'"),
        ("waiting:lag=1,lag=2", r"'lag' is given twice"),
        ("waiting:arrivals=4,5", r"'5' is no option"),
        ("waiting:arrivals=4/x", r"arrivals takes numbers joined by '/', got '4/x'"),
        (
            "waiting:arrivals=nan",
            r"arrivals of WaitingClock are times in seconds, got \(nan,\)",
        ),
        ("waiting:lag=soon", r"lag takes a number, got 'soon'"),
        ("waiting:lag=-1", r"lag of WaitingClock must be positive, got -1.0"),
        ("localizing:initial=here", r"one of \['beginning', 'anywhere'\], got 'here'"),
        ("even:speed=nan", r"speed of EvenClock must be positive, got nan"),
        (3, r"one of \['even', 'waiting', 'localizing'\], as text or as an object, got 3"),
        (EvenClock, "as text or as an object, got <class"),
    ],
)
def test_texts_that_are_no_clock_are_refused(text, message):
    with pytest.raises(DataError, match=message):
        parse_clock(text)


def test_a_clock_of_somebodys_own_is_its_repr():
    class Sundial(Clock):
        def start(self, skill, joints, frames, begin=None, end=None):
            raise NotImplementedError

        def __repr__(self):
            return "Sundial()"

    assert format_clock(Sundial()) == "Sundial()"


@pytest.mark.parametrize("speed", ["1", None, True])
def test_a_setting_that_is_no_number_is_refused(speed):
    with pytest.raises(DataError, match="speed of EvenClock is a number, got"):
        EvenClock(speed)

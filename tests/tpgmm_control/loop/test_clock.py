"""Clocks as text, and settings that are refused."""

import pytest

from tpgmm_control import Clock
from tpgmm_torch.exceptions import DataError


@pytest.mark.parametrize(
    ("text", "clock"),
    [
        ("even", Clock("even")),
        ("even:speed=0.5", Clock("even", speed=0.5)),
        ("waiting", Clock("waiting")),
        ("localizing", Clock()),
        ("localizing:initial=anywhere", Clock(initial="anywhere")),
        ("waiting:speed=2,arrivals=2.5/4", Clock("waiting", speed=2, arrivals=(4, 2.5))),
    ],
)
def test_texts_and_clocks_are_each_others_inverse(text, clock):
    assert Clock.parse(text) == clock
    assert str(clock) == text
    assert Clock.parse(clock) is clock


@pytest.mark.parametrize(
    "text",
    [
        "sundial", "even:tolerance=3", "even:speed", "even:speed=fast", "even:speed=0", 3,
        "even:speed=1,speed=2", "localizing:initial=nowhere", "even:arrivals=a/b", None,
        "even:speed=nan", "even:kind=waiting",
    ],
)  # fmt: skip
def test_texts_that_are_no_clock_are_refused(text):
    with pytest.raises(DataError, match="clock"):
        Clock.parse(text)

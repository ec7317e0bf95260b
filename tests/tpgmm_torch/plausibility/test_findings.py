"""One summed-up warning, or one error; every finding stays in the report."""

import warnings

import pytest

from tpgmm_torch.exceptions import DataError, PlausibilityError, PlausibilityWarning
from tpgmm_torch.plausibility.findings import Finding, Report, listed

SLOW = Finding("time", "unlikely", "a step is 30 s", "Is it in milliseconds?", ("t",), (1,), 30)
DEGREES = Finding("units", "error", "q = 90 cannot be", "Convert it", ("q",), (), 88.0)


def report(*findings):
    return Report.of(findings, "4 demonstrations")


def test_errors_come_first_and_everything_is_numbered():
    both = report(SLOW, DEGREES)
    assert [f.check for f in both] == ["units", "time"] and both.errors() == (DEGREES,)
    assert str(both) == (
        "4 demonstrations: 2 things are impossible: (1) units: q = 90 cannot be. Convert it; "
        "(2) time: a step is 30 s. Is it in milliseconds?"
    )
    assert str(report(SLOW)).startswith("4 demonstrations: one thing is implausible: (1) time")
    assert str(report()) == "4 demonstrations: nothing implausible"


def test_what_is_unlikely_is_one_warning_at_the_line_that_asked():
    with pytest.warns(PlausibilityWarning) as caught:
        report(SLOW, SLOW).act(stacklevel=1)
    assert len(caught) == 1 and caught[0].filename == __file__


@pytest.mark.parametrize(
    ("findings", "plausibility"), [((DEGREES, SLOW), "warn"), ((SLOW,), "error")]
)
def test_what_cannot_be_or_must_not_be_is_an_error(findings, plausibility):
    with pytest.raises(PlausibilityError, match="time: a step is 30 s") as caught:
        report(*findings).act(plausibility)
    assert isinstance(caught.value, DataError)


def test_nothing_is_said_of_nothing_or_when_it_is_ignored():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(report().act("error")) == 0
        assert len(report(SLOW, DEGREES).act("ignore")) == 2


def test_long_reports_are_cut_in_the_message_alone():
    many = report(*[SLOW] * 11)
    assert str(many).endswith("; and 3 more") and len(many) == 11
    assert listed(["a", "b"]) == "a, b" and listed(list("abcde")) == "a, b, c and 2 more"

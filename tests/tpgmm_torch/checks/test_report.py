"""One summed-up warning, or one error; every finding stays in the report."""

import warnings

import pytest

from tests.support.refusals import refused
from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.exceptions import DataError, PlausibilityError, PlausibilityWarning

SLOW = Finding("time", "a step is 30 s", "Is it in milliseconds?", ("t",), (1,), 30)
DEGREES = Finding("units", "q = 90 cannot be", "Convert it", ("q",), value=88, impossible=True)


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


def test_an_unlikely_thing_is_one_warning_at_the_line_that_asked():
    with pytest.warns(PlausibilityWarning) as caught:
        report(SLOW, SLOW).act()
    assert len(caught) == 1 and caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(report().act()) == 0
        refused(lambda: report(SLOW).act(), PlausibilityWarning)


def test_an_impossible_thing_is_an_error():
    with pytest.raises(PlausibilityError, match="time: a step is 30 s") as caught:
        report(DEGREES, SLOW).act()
    assert isinstance(caught.value, DataError)

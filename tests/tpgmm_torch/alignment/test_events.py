"""Laws of alignment anchored at events."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.pipeline import make_pipeline

from tpgmm_torch.alignment import EventAlignment, LinearTimeNormalization
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.exceptions import DataError, NotFittedError


def shown(begin=0.0, end=10.0, n=501, **events):
    """Joints are the phase between the anchors: 0, 1, ... at start, events, end."""
    time = np.linspace(begin, end, n)
    anchors = [begin, *events.values(), end]
    return Demonstration(
        time, np.interp(time, anchors, range(len(anchors)))[:, None], events=events
    )


FAMILY = [
    shown(close=2.0, open=8.0),
    shown(5.0, 12.0, 401, close=9.0, open=10.0),
    shown(0.0, 6.0, 301, close=3.0, open=4.5),
]


@pytest.mark.parametrize("duration", ["mean", "median", 1.0])
def test_events_are_at_one_instant_and_each_part_is_stretched_evenly(duration):
    transformer = EventAlignment(duration=duration)
    aligned = transformer.fit_transform(FAMILY)
    assert transformer.events_ == ("close", "open")
    parts = np.array([[2, 6, 2], [4, 1, 2], [3, 1.5, 1.5]])
    lengths = np.median(parts, axis=0) if duration == "median" else parts.mean(axis=0)
    if duration == 1.0:
        lengths /= lengths.sum()
    instants = np.cumsum(lengths)
    assert list(transformer.instants_.values()) == pytest.approx(instants[:2])
    step = instants[-1] / 400
    for one in aligned:
        assert (float(one.time[0]), float(one.time[-1])) == pytest.approx((0, instants[-1]))
        assert len(one) == 401
        assert list(one.events.values()) == pytest.approx(instants[:2], abs=step)
        phase = np.interp(one.time, [0, *instants], range(4))
        np.testing.assert_allclose(one.joints[:, 0], phase, atol=0.02)


def test_without_motion_of_the_events_it_is_linear():
    family = [shown(0, end, close=end / 4) for end in (4.0, 6.0)]
    expected = LinearTimeNormalization().fit_transform(family)
    for one, other in zip(EventAlignment().fit_transform(family), expected, strict=True):
        np.testing.assert_allclose(one.time, other.time)
        np.testing.assert_allclose(one.joints, other.joints, atol=1e-9)


def test_others_are_aligned_onto_the_same_instants():
    transformer = EventAlignment(["close"]).fit(FAMILY)
    assert transformer.events_ == ("close",)
    [one] = transformer.transform([shown(1.0, 4.0, close=1.5)])
    step = float(one.time[1])
    assert one.events["close"] == pytest.approx(transformer.instants_["close"], abs=step)
    again = clone(transformer).fit(FAMILY).transform(FAMILY[:1])[0]
    np.testing.assert_allclose(again.joints, transformer.transform(FAMILY[:1])[0].joints)
    situation = Situation([0.0])
    assert transformer.transform([situation]) == [situation]
    with pytest.raises(NotFittedError):
        EventAlignment().transform(FAMILY)


def test_start_and_end_are_anchors_anyway():
    named = EventAlignment(["start", "close", "open", "end"]).fit(FAMILY)
    assert named.events_ == ("close", "open")
    np.testing.assert_allclose(named.paths_[1], EventAlignment().fit(FAMILY).paths_[1])


def test_it_is_a_step_of_a_pipeline():
    pipeline = make_pipeline(EventAlignment(), LinearTimeNormalization(1.0))
    assert [one.duration for one in pipeline.fit_transform(FAMILY)] == [1.0] * 3


@pytest.mark.parametrize(
    "family, events, told",
    [
        ([shown(close=2.0), shown(close=3.0), shown()], None, r"'close' is missing .*\[2\]"),
        ([shown(), shown()], None, "no events to align at"),
        (FAMILY, ["grasp"], r"'grasp' is missing in demonstrations \[0, 1, 2\].*'close'"),
        (FAMILY, ["open", "close"], "'close' at 2 s is not after 'open' at 8 s in demon.* 0"),
        (
            [*FAMILY, Demonstration([0.0, 9.0], [[0], [1]], events={"close": 4, "open": 2})],
            None,
            "'open' at 2 s is not after 'close' at 4 s in demonstration 3",
        ),
        ([shown(close=0.0), shown(close=1.0)], None, "'close' at 0 s is not after 'start'"),
    ],
)
def test_events_that_are_missing_or_out_of_order_are_refused(family, events, told):
    with pytest.raises(DataError, match=told):
        EventAlignment(events).fit(family)


def test_what_is_transformed_needs_the_events_too():
    with pytest.raises(DataError, match=r"has no event 'open'; it has \['close'\]"):
        EventAlignment().fit(FAMILY).transform([shown(close=2.0)])

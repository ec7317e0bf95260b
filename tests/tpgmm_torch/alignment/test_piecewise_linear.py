"""Laws of linear time normalisation and of alignment anchored at events."""

import numpy as np
import pytest
import torch
from sklearn.base import clone

from tests.support.refusals import refused
from tpgmm_torch.alignment import DynamicTimeWarping, EventAlignment, LinearTimeNormalization
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError, NotFittedError, PlausibilityWarning


@pytest.mark.parametrize("duration, expected", [("mean", 2.0), ("median", 1.5)])
def test_linear_normalization_scales_durations_and_events(duration, expected):
    family = [
        Demonstration(
            np.linspace(5, 5 + t, 31), np.arange(31.0)[:, None], events={"half": 5 + t / 2}
        )
        for t in (1.0, 1.5, 3.5)
    ]
    for aligned in LinearTimeNormalization(duration).fit_transform(family):
        assert (float(aligned.time[0]), aligned.duration) == pytest.approx((0, expected))
        assert aligned.events["half"] == pytest.approx(expected / 2)
        assert aligned.joints[:, 0].tolist() == pytest.approx(list(range(31)))


def ramp(start, end, n):
    return Demonstration(np.linspace(start, end, n), np.arange(float(n))[:, None])


def test_the_grid_has_the_median_number_of_steps_from_zero():
    family = [ramp(0, 1, 11), ramp(3, 5, 21), ramp(0, 6, 61)]
    transformer = LinearTimeNormalization().fit(family)
    np.testing.assert_allclose(transformer.time_, np.linspace(0, 3, 21))
    assert transformer.time_.dtype == torch.float64
    for path, one in zip(transformer.paths_, family, strict=True):
        np.testing.assert_allclose(
            path, np.linspace(*one.time[[0, -1]].tolist(), 21), atol=1e-12
        )
    even = LinearTimeNormalization().fit([ramp(0, 1, 11), ramp(0, 1, 14)])
    assert len(even.time_) == 12  # 12.5, rounded to even


def test_instants_are_proportional_also_where_time_steps_are_not():
    time = np.array([0.0, 1.0, 4.0, 5.0, 6.0])
    uneven = Demonstration(time, time[:, None])
    [aligned] = LinearTimeNormalization().fit_transform([uneven])
    np.testing.assert_allclose(aligned.joints[:, 0], aligned.time, atol=1e-12)


def test_no_duration_is_refused():
    with pytest.raises(ValueError, match="duration"):
        LinearTimeNormalization("longest").fit([ramp(0, 1, 3)])


def show(begin=0.0, end=10.0, n=501, **events):
    """Joints are the phase between the anchors: 0, 1, ... at start, events, end."""
    time = np.linspace(begin, end, n)
    anchors = [begin, *events.values(), end]
    return Demonstration(
        time, np.interp(time, anchors, range(len(anchors)))[:, None], events=events
    )


FAMILY = [
    show(close=2.0, open=8.0),
    show(5.0, 12.0, 401, close=9.0, open=10.0),
    show(0.0, 6.0, 301, close=3.0, open=4.5),
]


@pytest.mark.parametrize("duration", ["mean", "median"])
def test_events_are_at_one_instant_and_each_part_is_stretched_evenly(duration):
    transformer = EventAlignment(duration=duration)
    aligned = transformer.fit_transform(FAMILY)
    assert transformer.events_ == ("close", "open")
    parts = np.array([[2, 6, 2], [4, 1, 2], [3, 1.5, 1.5]])
    lengths = np.median(parts, axis=0) if duration == "median" else parts.mean(axis=0)
    instants = np.cumsum(lengths)
    assert list(transformer.instants_.values()) == pytest.approx(instants[:2])
    for one in aligned:
        assert (float(one.time[0]), float(one.time[-1])) == pytest.approx((0, instants[-1]))
        assert len(one) == 401
        assert list(one.events.values()) == pytest.approx(instants[:2], abs=instants[-1] / 400)
        phase = np.interp(one.time, [0, *instants], range(4))
        np.testing.assert_allclose(one.joints[:, 0], phase, atol=0.02)


def test_others_are_aligned_onto_the_same_instants():
    transformer = EventAlignment(["close"]).fit(FAMILY)
    assert transformer.events_ == ("close",)
    [one] = transformer.transform([show(1.0, 4.0, close=1.5)])
    step = float(one.time[1])
    assert one.events["close"] == pytest.approx(transformer.instants_["close"], abs=step)
    again = clone(transformer).fit(FAMILY).transform(FAMILY[:1])[0]
    np.testing.assert_allclose(again.joints, transformer.transform(FAMILY[:1])[0].joints)
    refused(lambda: EventAlignment().transform(FAMILY), NotFittedError)


def test_start_and_end_are_anchors_anyway():
    named = EventAlignment(["start", "close", "open", "end"]).fit(FAMILY)
    assert named.events_ == ("close", "open")
    np.testing.assert_allclose(named.paths_[1], EventAlignment().fit(FAMILY).paths_[1])


@pytest.mark.parametrize("family, events, told", [
    ([show(close=2.0), show(close=3.0), show()], None, r"'close' is missing .*\[2\]"),
    ([show(), show()], None, "no events to align at"),
    (FAMILY, ["grasp"], r"'grasp' is missing in demonstrations \[0, 1, 2\].*'close'"),
    (FAMILY, ["open", "close"], "'close' at 2 s is not after 'open' at 8 s in demon.* 0"),
    (
        [*FAMILY, Demonstration([0.0, 9.0], [[0], [1]], events={"close": 4, "open": 2})],
        None,
        "'open' at 2 s is not after 'close' at 4 s in demonstration 3",
    ),
    ([show(close=0.0), show(close=1.0)], None, "'close' at 0 s is not after 'start'"),
])  # fmt: skip
def test_events_that_are_missing_or_out_of_order_are_refused(family, events, told):
    refused(lambda: EventAlignment(events).fit(family), DataError, told)


def make_paced(close, pace, seed=0):
    """A way whose speed differs between the anchors; the third joint says where on it."""
    time = np.linspace(0, 6, 301)
    part, fraction = np.divmod(np.interp(time, [0, close, 6], [0, 1, 2]), 1)
    warped = part + fraction**pace  # 0, 1 and 2 at the anchors
    joints = np.stack([np.sin(3 * warped), np.cos(5 * warped), warped], 1)
    joints += 1e-4 * np.random.default_rng(seed).standard_normal(joints.shape)
    return Demonstration(time, joints, events={"close": close})


PACES = [make_paced(2.0, 1.0, 1), make_paced(3.5, 1.5, 2), make_paced(2.8, 0.7, 3)]


def spread(aligned):
    """Mean deviation of where on the way demonstrations are at one time."""
    return float(np.std([one.joints[:, 2] for one in aligned], axis=0).mean())


@pytest.mark.parametrize("reference", ["medoid", "barycenter", 1])
def test_parts_are_warped_and_events_stay_where_they_are(reference):
    evenly = EventAlignment().fit_transform(PACES)
    within = DynamicTimeWarping(reference, smoothing=0.05)
    transformer = EventAlignment(within=within)
    aligned = transformer.fit_transform(PACES)
    for one, other in zip(aligned, evenly, strict=True):
        np.testing.assert_allclose(one.time, other.time)
        assert one.events["close"] == pytest.approx(other.events["close"], abs=0.011)
    at = int((aligned[0].time - transformer.instants_["close"]).abs().argmin())
    places = [float(one.joints[at, 2]) for one in aligned]
    assert places == pytest.approx([1.0] * 3, abs=0.01)
    assert spread(aligned) < 0.7 * spread(evenly)
    assert within.robot is None and not hasattr(within, "time_")  # parts are clones
    assert transformer.fallback_ == {} and len(transformer.parts_) == 2
    for path, one in zip(transformer.paths_, PACES, strict=True):
        assert path[[0, -1]].tolist() == one.time[[0, -1]].tolist()
        assert (np.diff(path) > 0).all()


def test_parts_that_are_short_or_still_stay_even_and_a_fallback_is_reported():
    time = np.linspace(0, 4, 201)
    still = [
        Demonstration(
            time,
            np.interp(time, [0, 2, 2.04, 4], [0, 1, 1, 1])[:, None] ** [[pace, 1]],
            events={"close": 2.0, "open": 2.04},
        )
        for pace in (1.0, 1.5)
    ]
    transformer = EventAlignment(within=DynamicTimeWarping(min_gain=None)).fit(still)
    assert [part is None for part in transformer.parts_] == [False, True, True]
    # joints that do not agree on a warp: each part gains by one and loses by the other
    rng = np.random.default_rng(0)
    wild = [
        Demonstration(time, rng.standard_normal((201, 4)).cumsum(0), events={"close": 2.0})
        for _ in range(3)
    ]
    transformer = EventAlignment(within=DynamicTimeWarping(features=["speed"]))
    with pytest.warns(PlausibilityWarning, match="from 'start' to 'close': its diff") as caught:
        transformer.fit(wild)
    assert len(caught) == 1
    assert transformer.fallback_.keys() <= {(i, part) for i in range(3) for part in range(2)}

"""Laws of alignment anchored at events."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.pipeline import make_pipeline

from tpgmm_torch.alignment import (
    DynamicTimeWarping,
    EventAlignment,
    LinearTimeNormalization,
)
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.exceptions import DataError, NotFittedError, PlausibilityWarning


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


# Warped between the anchors


def paced(close, pace, seed=0):
    """A way whose speed differs between the anchors; the joints say where on it."""
    time = np.linspace(0, 6, 301)
    phase = np.interp(time, [0, close, 6], [0, 1, 2])
    part, fraction = np.divmod(phase, 1)
    warped = part + fraction**pace  # 0, 1 and 2 at the anchors
    joints = np.stack([np.sin(3 * warped), np.cos(5 * warped), warped], 1)
    joints += 1e-4 * np.random.default_rng(seed).standard_normal(joints.shape)
    return Demonstration(time, joints, events={"close": close})


PACES = [paced(2.0, 1.0, 1), paced(3.5, 1.5, 2), paced(2.8, 0.7, 3)]


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
        assert path[0] == 0 and path[-1] == len(one) - 1 and bool((path.diff() > 0).all())


def test_others_are_warped_as_those_of_the_fit():
    transformer = EventAlignment(within=DynamicTimeWarping()).fit(PACES)
    for one, path in zip(PACES, transformer.paths_, strict=True):
        np.testing.assert_allclose(transformer._path(one), path, atol=1e-9)
    [one] = transformer.transform([paced(4.0, 1.2, 4)])
    at = int((one.time - transformer.instants_["close"]).abs().argmin())
    assert float(one.joints[at, 2]) == pytest.approx(1.0, abs=0.01)


def test_parts_that_are_short_or_still_stay_even_and_what_does_not_pay_is_told():
    time = np.linspace(0, 4, 201)
    still = [
        Demonstration(
            time,
            np.interp(time, [0, 2, 2.04, 4], [0, 1, 1, 1])[:, None] ** [[pace, 1]],
            events={"close": 2.0, "open": 2.04},
        )
        for pace in (1.0, 1.5)
    ]
    transformer = EventAlignment(within=DynamicTimeWarping(fallback=False)).fit(still)
    assert [part is None for part in transformer.parts_] == [False, True, True]
    # joints that do not agree on a warp: what helps one spoils the other
    rng = np.random.default_rng(0)
    wild = [
        Demonstration(time, rng.standard_normal((201, 4)).cumsum(0), events={"close": 2.0})
        for _ in range(3)
    ]
    transformer = EventAlignment(within=DynamicTimeWarping(features=["speed"]))
    with pytest.warns(PlausibilityWarning) as caught:
        transformer.fit(wild)
    [told] = caught
    assert "from 'start' to 'close': its difference" in str(told.message)
    assert transformer.fallback_.keys() <= {(i, part) for i in range(3) for part in range(2)}


def test_open_ends_within_parts_are_refused():
    with pytest.raises(DataError, match="no open end"):
        EventAlignment(within=DynamicTimeWarping(open_end=True)).fit(PACES)

"""Times, durations and events."""

from dataclasses import replace

import numpy as np

from tpgmm_torch import Demonstration
from tpgmm_torch.plausibility.check import summarize
from tpgmm_torch.plausibility.clock import check_clock, check_one_clock

TIME = np.arange(100) / 50


def recorded(n=6, stretch=1.0, **events):
    shares = np.linspace(-0.02, 0.02, n)
    return [
        Demonstration(
            TIME * stretch,
            np.sin(TIME)[:, None],
            events={name: (at + share) * TIME[-1] for name, at in events.items()}
            if stretch == 1
            else {},
        )
        for share in shares
    ]


def found(items):
    return [f.check for f in check_clock(summarize(items, None))]


def test_a_common_clock_is_plausible():
    assert found(recorded(grasp=0.3, lift=0.4)) == []
    assert found(recorded(1)) == []


def test_steps_tell_of_units():
    for stretch, odd in ((0.5, False), (20, False), (1000, True), (50, True), (1e-6, True)):
        assert found(recorded(stretch=stretch)) == ["time"] * odd


def test_durations_of_a_factor_of_two_are_usual_and_of_five_are_not():
    items = recorded()
    for factor, odd in ((1.5, False), (5.0, True)):
        items[2] = replace(items[2], time=items[0].time * factor)
        assert found(items) == ["durations"] * odd
    spread = [replace(d, time=d.time * (1 + n / 3)) for n, d in enumerate(recorded())]
    assert found(spread) == []


def test_a_hole_is_found_and_a_slow_start_is_not():
    items = recorded()
    holes = items[1].time.clone()
    holes[50:] += 0.7
    items[1] = replace(items[1], time=holes)
    assert found(items) == ["gaps"]


def test_events_elsewhere_missing_or_in_another_order():
    good = recorded(grasp=0.3, lift=0.4)
    late = [*good[:5], replace(good[5], events={"grasp": 1.6, "lift": 1.7})]
    assert found(late) == ["events"]
    turned = [*good[:5], replace(good[5], events={"grasp": 0.8, "lift": 0.6})]
    assert found(turned) == ["events"]
    lost = [*good[:5], replace(good[5], events={"grasp": 0.6})]
    assert found(lost) == ["events"]
    rare = [*(replace(d, events={}) for d in good[:4]), *good[4:]]
    assert found(rare) == []


def test_only_what_is_learned_together_needs_one_clock():
    items = [replace(d, time=d.time * (1 + n / 10)) for n, d in enumerate(recorded())]
    assert found(items) == []
    [finding] = check_one_clock(summarize(items, None))
    assert finding.check == "alignment" and "last from" in finding.message
    shifted = [replace(d, time=d.time + n) for n, d in enumerate(recorded())]
    [finding] = check_one_clock(summarize(shifted, None))
    assert "begin at different times" in finding.message
    assert list(check_one_clock(summarize(recorded(), None))) == []

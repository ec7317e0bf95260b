"""Whether times are seconds of one clock: steps, durations, events."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tpgmm_torch.plausibility.findings import Finding, listed
from tpgmm_torch.plausibility.outliers import FEWEST, outliers
from tpgmm_torch.plausibility.summaries import EpisodeSummary

__all__ = ["SLOWEST_STEP", "check_clock", "check_one_clock"]

#: No robot is recorded more rarely [s]; a set in milliseconds is.
SLOWEST_STEP = 0.5
#: Nor more often [s].
QUICKEST_STEP = 1e-5
#: Durations within this factor are like each other, whatever the others are.
LIKE = 1.6
#: Events within this share of the duration are at the same place.
NEAR = 0.15
#: An aligned set is on one clock to this share of its duration.
ONE_CLOCK = 0.05


def check_clock(episodes: Sequence[EpisodeSummary]) -> Iterator[Finding]:
    """Seconds, gaps, durations and events.

    Parameters
    ----------
    episodes : sequence of EpisodeSummary

    Yields
    ------
    Finding
    """
    steps = np.array([e.step for e in episodes if e.n_steps > 1])
    if len(steps):
        yield from _seconds(float(np.median(steps)))
        yield from _rates(episodes)
    yield from _gaps(episodes)
    yield from _durations(episodes)
    yield from _events(episodes)


def check_one_clock(episodes: Sequence[EpisodeSummary]) -> Iterator[Finding]:
    """Whether demonstrations are aligned: what is learned at one time is one thing.

    Parameters
    ----------
    episodes : sequence of EpisodeSummary

    Yields
    ------
    Finding
    """
    durations = np.array([e.duration for e in episodes])
    begins = np.array([e.begin for e in episodes])
    typical = float(np.median(durations))
    if np.ptp(durations) > ONE_CLOCK * typical:
        yield Finding(
            "alignment",
            "unlikely",
            f"the demonstrations last from {durations.min():.4g} to {durations.max():.4g} s: "
            "at one time they show different things",
            "Align them first: DynamicTimeWarping().fit_transform(demonstrations)",
            value=float(np.ptp(durations)),
        )
    elif np.ptp(begins) > ONE_CLOCK * typical:
        yield Finding(
            "alignment",
            "unlikely",
            f"the demonstrations begin at different times, from {begins.min():.6g} to "
            f"{begins.max():.6g} s",
            "Let each begin at 0, or align them: "
            "DynamicTimeWarping().fit_transform(demonstrations)",
            value=float(np.ptp(begins)),
        )


def _seconds(step: float) -> Iterator[Finding]:
    if step >= SLOWEST_STEP or step < QUICKEST_STEP:
        slow = step >= SLOWEST_STEP
        hint = "milliseconds, or numbers of frames" if slow else "another unit"
        yield Finding(
            "time",
            "unlikely",
            f"time is in seconds, and a typical step of it is {step:.3g} s",
            f"Is it in {hint}? Convert it; duration, speeds and 'blend' depend on it",
            value=step,
        )


def _rates(episodes: Sequence[EpisodeSummary]) -> Iterator[Finding]:
    """One recording at a rate far from the others'."""
    steps = np.array([e.step for e in episodes])
    typical = float(np.median(steps))
    odd = [
        i
        for i, e in enumerate(episodes)
        if e.n_steps > 1 and not typical / 20 <= e.step <= 20 * typical
    ]
    if odd:
        places = [f"{steps[i]:.3g} s in demonstration {i}" for i in odd]
        yield Finding(
            "time",
            "unlikely",
            f"steps of time are {typical:.3g} s, but {listed(places)}",
            "Is its time in milliseconds?",
            episodes=tuple(odd),
            value=float(max(steps[odd])),
        )


def _gaps(episodes: Sequence[EpisodeSummary]) -> Iterator[Finding]:
    odd = [
        i
        for i, e in enumerate(episodes)
        if e.longest > max(10 * e.step, 0.25, 0.02 * e.duration)
    ]
    if odd:
        places = [
            f"{episodes[i].longest:.3g} s after {episodes[i].gap:.4g} s of demonstration {i}"
            for i in odd
        ]
        yield Finding(
            "gaps",
            "unlikely",
            f"nothing was recorded for {listed(places)}",
            "Leave the episode out, or cut it",
            episodes=tuple(odd),
            value=max(episodes[i].longest for i in odd),
        )


def _durations(episodes: Sequence[EpisodeSummary]) -> Iterator[Finding]:
    durations = np.array([max(e.duration, 1e-9) for e in episodes])
    typical = float(np.median(durations))
    odd = outliers(np.log(durations), floor=np.log(LIKE))
    if odd:
        places = [f"{durations[i]:.4g} s in demonstration {i}" for i in odd]
        yield Finding(
            "durations",
            "unlikely",
            f"demonstrations last about {typical:.4g} s, but {listed(places)}",
            "Is it the same skill, whole, and at the same rate?",
            episodes=tuple(odd),
            value=float(durations[odd[0]]),
        )


def _events(episodes: Sequence[EpisodeSummary]) -> Iterator[Finding]:
    names = dict.fromkeys(name for e in episodes for name in e.events)
    places: list[str] = []
    about: list[int] = []
    odd_names: list[str] = []
    for name in names:
        there = [i for i, e in enumerate(episodes) if name in e.events]
        lost = [i for i in range(len(episodes)) if i not in there]
        phases = np.array([episodes[i].events[name] for i in there])
        typical = float(np.median(phases))
        ends = [
            i
            for i, phase in zip(there, phases, strict=True)
            if len(there) >= FEWEST
            and min(phase, 1 - phase) < 0.005 < 0.05 < min(typical, 1 - typical)
        ]
        wrong = sorted({*ends, *(there[i] for i in outliers(phases, floor=NEAR))})
        places += [
            f"{name!r} at {episodes[i].events[name]:.0%} of demonstration {i}, usually at "
            f"{typical:.0%}"
            for i in wrong
        ]
        if lost and len(lost) < len(there):
            places.append(f"{name!r} missing in {listed([str(i) for i in lost])}")
            wrong = sorted({*wrong, *lost})
        about += wrong
        odd_names += [name] if wrong else []
    yield from _order(episodes, list(names))
    if places:
        yield Finding(
            "events",
            "unlikely",
            f"events are not where they usually are: {listed(places)}",
            "Was the event detected rightly? Give it by hand, or leave the episode out",
            tuple(odd_names),
            tuple(dict.fromkeys(sorted(about))),
        )


def _order(episodes: Sequence[EpisodeSummary], names: list[str]) -> Iterator[Finding]:
    """Events that come in another order than usual."""
    for k, first in enumerate(names):
        for second in names[k + 1 :]:
            both = [
                i for i, e in enumerate(episodes) if first in e.events and second in e.events
            ]
            ahead = [i for i in both if episodes[i].events[first] > episodes[i].events[second]]
            early, late = first, second
            if 2 * len(ahead) > len(both):
                ahead, early, late = [i for i in both if i not in ahead], second, first
            if len(both) >= 4 and 0 < len(ahead) <= len(both) / 4:
                yield Finding(
                    "events",
                    "unlikely",
                    f"{early!r} comes before {late!r}, but not in demonstration "
                    f"{listed([str(i) for i in ahead])}",
                    "Was the event detected rightly? Give it by hand, or leave the episode out",
                    (early, late),
                    tuple(ahead),
                )

"""What can go wrong: as text, drawn from seeds, and by itself."""

import math

import numpy as np
import pytest

from lerobot_env_bimanual.disturbances import (
    CONDITIONS,
    Biased,
    Course,
    Displaced,
    IrregularTicks,
    Live,
    Moved,
    NoisyPose,
    PoseLost,
    StartedMidway,
    Stopped,
    displace_pose,
    generators,
    parse_condition,
)
from tpgmm_torch.exceptions import DataError, UnknownNameError

COURSE = Course(grasp=4.0, latest=8.5, end=12.0)
POSE = np.array([0.3, 0.02, 0.12, 1.0, 0.0, 0.0, 0.0])


def anywhere(_step):
    return True


def drawn(disturbance, seed):
    return disturbance.draw(np.random.default_rng(seed), COURSE, anywhere)


@pytest.mark.parametrize(
    ("text", "disturbances"),
    [
        ("nominal", ()),
        ("stopped", (Stopped(3.0),)),
        ("stopped-10", (Stopped(10.0),)),
        ("pushed-back", (Displaced(-2.0),)),
        ("pushed-back-1.5", (Displaced(-1.5),)),
        ("pushed-back-1.5@6", (Displaced(-1.5, moment=6.0),)),
        ("started-midway@6.5", (StartedMidway(6.5),)),
        ("stopped-3@3", (Stopped(3.0, moment=3.0),)),
        ("pushed-ahead-3", (Displaced(3.0),)),
        ("moved-slowly", (Moved(seconds=1.0),)),
        ("pose-stale", (PoseLost(stale=True),)),
        ("pose-noise+live+stopped-2", (Stopped(2.0), Live(), NoisyPose())),
    ],
)
def test_a_condition_has_a_text(text, disturbances):
    assert parse_condition(text) == disturbances
    assert parse_condition(disturbances) == disturbances


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("rain", UnknownNameError, r"'rain' is not in the conditions .*'stopped'"),
        ("stopped-", UnknownNameError, "'stopped-'"),
        ("", UnknownNameError, "''"),
        ("live-3", DataError, "live takes no seconds, got 3"),
        ("pose-noise@3", DataError, "pose-noise takes no moment, got 3"),
        ("stopped-0", DataError, "the seconds of stopped is above 0, got 0"),
        ("stopped-2+stopped-3", DataError, "names stopped twice"),
    ],
)
def test_what_is_no_condition_is_refused(text, error, message):
    with pytest.raises(error, match=message):
        parse_condition(text)


@pytest.mark.parametrize("text", CONDITIONS)
def test_moments_are_drawn_from_the_seed_whatever_else_happens(text):
    def moments(condition, seed):
        parts = parse_condition(condition)
        rng = np.random.default_rng(seed)
        rngs = generators(parts, rng)
        after = rng.random()
        assert after == np.random.default_rng(seed).random()
        found = {}
        for part, own in zip(parts, rngs, strict=True):
            part = part.draw(own, COURSE, anywhere)
            found[type(part).__name__] = getattr(part, "moment", None)
        return found

    alone, again = moments(text, 3), moments(text, 3)
    assert alone == again
    other = "irregular-ticks" if "live" in text or text == "nominal" else "live"
    if text != "irregular-ticks":
        both = moments(other if text == "nominal" else f"{text}+{other}", 3)
        assert alone.items() <= both.items()
    for name, moment in alone.items():
        if moment is not None:
            assert 0.5 <= moment <= COURSE.end
            assert (moments(text, 4)[name] != moment) == ("@" not in text)


def test_the_same_moments_for_stops_of_all_lengths():
    short, long = (drawn(Stopped(seconds), 5).moment for seconds in (1.0, 10.0))
    assert short == long
    assert Stopped(10.0).delay == 10.0
    assert drawn(Stopped(2.0, moment=7.0), 5).moment == 7.0


def test_a_shove_leaves_a_past_and_enough_future():
    back = [drawn(Displaced(-2.0), seed).moment for seed in range(200)]
    ahead = [drawn(Displaced(2.0), seed).moment for seed in range(200)]
    assert 2.5 <= min(back) < 3 and 11.5 < max(back) <= COURSE.end
    assert 0.5 <= min(ahead) < 1 and 6 < max(ahead) <= COURSE.latest - 2
    part = Displaced(-2.0, moment=4.0)
    assert [part.shove(0.0, 3.9), part.shove(3.9, 4.0), part.shove(4.0, 4.1)] == [0, -2, 0]


@pytest.mark.parametrize("seconds", [0.0, 1.0])
def test_an_object_is_moved_to_a_place_that_is_meant(seconds):
    for seed in range(50):
        meant = lambda step: displace_pose(POSE, step)[0] <= 0.31  # noqa: E731
        part = Moved(seconds=seconds).draw(np.random.default_rng(seed), COURSE, meant)
        end = part.moment + seconds
        assert end <= COURSE.grasp - 1.5 + 1e-12
        assert part.displacement(part.moment - 1e-3) is None
        assert part.displacement(end + 0.2) is None
        moved = displace_pose(POSE, part.displacement(end + 1e-6))
        assert moved[0] <= 0.31
        assert np.linalg.norm(moved[:3] - POSE[:3]) == pytest.approx(0.04)
        assert 2 * np.degrees(abs(np.arctan2(moved[6], moved[3]))) == pytest.approx(20)
        if seconds:
            half = part.displacement(part.moment + seconds / 2)
            np.testing.assert_allclose(half, part.step / 2)


def test_noise_has_its_sizes_about_each_axis_and_differs_from_tick_to_tick():
    rng = np.random.default_rng(0)
    poses = np.concatenate((POSE, displace_pose(POSE, np.array([0.1, 0, 0, 0, 0, 0.5]))))
    seen = np.array([NoisyPose().observe(poses, poses, 0.0, rng) for _ in range(4000)])
    assert np.std(seen[:, [0, 1, 2, 7, 8, 9]], axis=0) == pytest.approx(0.005, rel=0.06)
    turns = 2 * np.degrees(seen[:, 4:7])  # small, from no rotation
    assert np.std(turns, axis=0) == pytest.approx(2.0, rel=0.06)
    assert np.linalg.norm(seen.reshape(-1, 2, 7)[..., 3:], axis=-1) == pytest.approx(1.0)


def test_a_bias_is_one_of_each_object_and_stays_for_the_episode():
    poses = np.concatenate((POSE, displace_pose(POSE, np.array([0.1, 0, 0, 0, 0, 0.5]))))
    errors = []
    for seed in range(30):
        part = drawn(Biased(), seed)
        error = part.observe(poses, poses, 0.0, None) - poses
        np.testing.assert_array_equal(part.observe(poses, poses, 9.0, None) - poses, error)
        errors += error.reshape(2, 7).tolist()
    errors = np.array(errors)
    assert np.linalg.norm(errors[:, :3], axis=1) == pytest.approx(0.005)
    chords = np.linalg.norm(errors[:, 3:], axis=1)
    assert 4 * np.degrees(np.arcsin(chords / 2)) == pytest.approx(2.0)
    assert np.abs(errors.mean(axis=0)).max() < 0.003  # to all sides, 60 different ones
    assert len(np.unique(errors[:, 0])) == 60


@pytest.mark.parametrize("stale", [False, True])
def test_a_lost_pose_is_nan_or_repeated(stale):
    part, last = PoseLost(0.5, stale, moment=2.0), POSE + 0.1
    for time in (1.99, 2.5):
        np.testing.assert_array_equal(part.observe(POSE, last, time, None), POSE)
    for time in (2.0, 2.49):
        lost = part.observe(POSE, last, time, None)
        np.testing.assert_array_equal(lost, last if stale else np.full(7, math.nan))


def test_ticks_come_early_and_late_and_some_not_at_all():
    rng = np.random.default_rng(0)
    periods = np.array([IrregularTicks().period(rng) for _ in range(5000)])
    assert periods.min() == pytest.approx(0.5, abs=0.01)
    assert periods.max() == pytest.approx(2.5, abs=0.02)
    assert periods.mean() == pytest.approx(1.1, abs=0.02)
    assert (periods > 1.5).mean() == pytest.approx(0.1, abs=0.02)


def test_a_displaced_pose():
    half = np.sqrt(0.5)
    pose = np.array([1.0, 2.0, 3.0, half, 0, 0, half])
    out = displace_pose(pose, np.array([0.1, 0, 0, np.pi / 2, 0, 0]))
    # a quarter about the pose's own x axis, after a quarter about z
    np.testing.assert_allclose(out, [1.1, 2, 3, 0.5, 0.5, 0.5, 0.5], atol=1e-12)
    assert pose[0] == 1

"""Progress of simulated servos that lag, sag, stop, slip, are pushed, or read late."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from tpgmm_control.loop.clock import Clock
from tpgmm_control.loop.locate import Mode, Progress, Seen

END, FASTEST = 6.0, 2.0


def path(time: np.ndarray) -> np.ndarray:
    """Three joints that move, rest from 2 to 3 s, and move on, (..., 3)."""

    def ease(begin: float, end: float) -> np.ndarray:
        u = np.clip((time - begin) / (end - begin), 0.0, 1.0)
        return u**3 * (10 - 15 * u + 6 * u**2)

    there, on = ease(0, 2), ease(3, END - 0.5)
    return np.stack((0.9 * there, -0.6 * there + 0.5 * on, 0.4 * there - 0.8 * on), -1)


@dataclass
class Loop:
    """Robots with servos of second order, and references within a bound of speed."""

    clock: Clock = field(default_factory=Clock)
    lag: float = 0.08
    dt: float = 0.02
    n_robots: int = 1
    find: Callable[[np.ndarray], float | None] = lambda posture: None

    def __post_init__(self) -> None:
        start = path(np.zeros(self.n_robots))
        self.robots = [Progress.start(self.clock, 0.0, END, row) for row in start]
        self.reference = self.first = self.joints = start
        self.now, self.log = 0.0, list[tuple[float, Progress, np.ndarray, np.ndarray]]()

    def tick(self, dt=None, stuck=False, sag=0.0, offset=0.0, put=np.nan) -> None:
        """A tick, in which some joints may be stuck, sag, read wrongly, or be put elsewhere."""
        dt = self.dt if dt is None else dt
        to = self.reference + sag
        left, behind = np.exp(-2 * dt / self.lag), self.first - to
        joints = to + left * (self.joints - to + 2 * dt / self.lag * behind)
        self.joints = np.where(stuck, self.joints, joints)
        self.first = np.where(stuck, self.joints, to + left * behind)
        self.joints, self.first = (
            np.where(np.isnan(put), x, put) for x in (self.joints, self.first)
        )
        goals = []
        for robot, sent, y in zip(
            self.robots, self.reference, self.joints + offset, strict=True
        ):
            robot.advance(sent, Seen(dt, y), self.find)
            goals.append(robot.lead(path(robot.time), careful=False))
        step = np.array(goals) - self.reference
        self.reference = self.reference + np.clip(step, -FASTEST * dt, FASTEST * dt)
        self.now += dt
        self.log.append((self.now, self.progress.copy(), self.reference, self.joints))

    def run(self, seconds: float, **happens) -> None:
        for _ in range(round(seconds / self.dt)):
            self.tick(**happens)

    def finish(self, **happens) -> float:
        """Run to the end; the time that it took."""
        while min(robot.time for robot in self.robots) < END:
            assert self.now < 30
            self.tick(**happens)
        return self.now

    @property
    def progress(self) -> Progress:
        """Progress of the first robot."""
        return self.robots[0]

    @property
    def worst(self) -> float:
        """The greatest distance of a reference from the path of the undisturbed skill."""
        whole = path(np.linspace(0, END, 601))
        return max(np.abs(whole - reference).max(-1).min() for _, _, reference, _ in self.log)


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.04])
@pytest.mark.parametrize("lag", [0.02, 0.08, 0.2, 0.4])
def test_a_robot_that_follows_is_not_slowed(lag, dt):
    loop = Loop(lag=lag, dt=dt)
    assert loop.finish() < END + 0.05 + lag  # as long as that is not known
    assert not any(progress.waits for _, progress, _, _ in loop.log)


@pytest.mark.parametrize("seconds", [1.0, 3.0, 10.0])
@pytest.mark.parametrize("begin", [0.8, 1.2, 4.0])
def test_a_robot_that_is_stopped_is_waited_for(begin, seconds):
    loop = Loop()
    loop.run(begin)
    before = np.abs(loop.reference - loop.joints).max()
    loop.run(seconds, stuck=True)
    assert loop.progress.mode is Mode.HELD
    assert loop.progress.waits
    assert np.abs(loop.reference - loop.joints).max() < before + 0.05
    assert loop.progress.time < begin + 0.4
    assert loop.finish() == pytest.approx(END + seconds, abs=0.6)
    assert not loop.progress.servo.judgement.excess.max() > 1


@pytest.mark.parametrize("begin", [0.0, 1.0, 2.5, 4.0])
@pytest.mark.parametrize("size", [0.05, 0.1, -0.2, 0.35])
@pytest.mark.parametrize("kind", ["sag", "offset"])
def test_an_offset_is_reported_and_not_followed(kind, size, begin):
    loop = Loop()
    loop.run(begin)
    off = np.array([0.0, size, 0.0])
    assert loop.finish(**{kind: off}) < END + 3
    assert loop.progress.servo.offset.mean[1] == pytest.approx(size, abs=0.04)
    assert loop.worst < 1.6 * abs(size)


def test_a_robot_that_was_displaced_is_not_fought_and_goes_on():
    loop = Loop()
    loop.run(1.4)
    there = loop.joints + np.array([0.2, -0.3, 0.2])
    loop.run(1.0, put=there)
    assert loop.progress.probe.displaced
    assert np.abs(loop.reference - there).max() < 0.06
    loop.finish()
    assert np.abs(loop.joints - path(np.array([END]))).max() < 0.02


def test_a_robot_at_another_place_of_the_skill_goes_on_there():
    places = []

    def find(posture):
        places.append(posture)
        return 0.8

    loop = Loop(find=find)
    loop.run(1.6)
    loop.run(0.4, put=path(np.array([0.8])))
    moved = [progress for _, progress, _, _ in loop.log if progress.relocalized]
    assert len(moved) == 1
    assert moved[0].time == 0.8
    assert np.abs(places[0] - path(np.array([0.8]))).max() < 0.02
    assert loop.finish() == pytest.approx(END + 0.8 + 0.4, abs=0.5)


@pytest.mark.parametrize("kind", ["waiting", "even"])
def test_other_clocks_stay_at_their_time(kind):
    loop = Loop(Clock(kind), find=lambda posture: 0.8)
    loop.run(1.6)
    loop.run(0.4, put=path(np.array([0.8])))
    times = np.array([progress.time for _, progress, _, _ in loop.log])
    assert (np.diff(times) >= 0).all()
    if kind == "even":
        assert loop.progress.time == pytest.approx(2.0)


def test_a_long_tick_is_caught_up_gently():
    loop = Loop(dt=0.01)
    loop.run(1.0)
    loop.tick(dt=0.3)
    steps = []
    for _ in range(100):
        before = loop.progress.time
        loop.tick()
        steps.append(loop.progress.time - before)
    assert max(steps) <= 1.5 * 0.013
    assert loop.progress.time == pytest.approx(loop.now, abs=0.02)


def test_arrivals_are_not_passed_before_a_joint_is_there():
    loop = Loop(Clock(arrivals=(2.0,)))
    loop.run(4.0, stuck=[False, True, False])
    assert loop.progress.time <= 2.0
    loop = Loop(Clock(arrivals=(2.0,)), lag=0.3)
    loop.run(2.2)
    assert loop.progress.time == 2.0
    assert loop.finish() > END + 0.2


def test_where_nothing_is_measured_time_goes_on_evenly():
    loop = Loop()
    loop.run(1.0, offset=np.nan)
    assert loop.progress.time == pytest.approx(1.0)
    loop = Loop(Clock(speed=2.0))
    loop.progress.advance_unseen(0.5)
    assert loop.progress.time == 1


def test_robots_of_a_batch_are_each_as_if_alone():
    happens = [{}, {"stuck": True}, {"put": path(np.array([0.3]))}, {"sag": [0, 0.2, 0]}]
    alone, together = [Loop() for _ in happens], Loop(n_robots=len(happens))
    for loop, happened in zip(alone, happens, strict=True):
        loop.run(1.2)
        loop.run(1.0, **happened)
        loop.run(1.0)
    row = np.arange(len(happens))[:, None]
    together.run(1.2)
    put, sag = np.where(row == 2, happens[2]["put"], np.nan), (row == 3) * [0, 0.2, 0]
    together.run(1.0, stuck=row == 1, put=put, sag=sag)
    together.run(1.0)
    for row, loop in enumerate(alone):
        assert together.robots[row].time == pytest.approx(loop.progress.time, abs=1e-12)
        np.testing.assert_allclose(together.reference[row], loop.reference[0], atol=1e-12)


def test_a_copy_looks_ahead_and_leaves_progress_as_it_is():
    loop = Loop()
    loop.run(1.2)
    now, ahead = loop.progress, loop.progress.copy()
    before = (now.time, now.mode, now.timing.off, now.servo.readings.median.tolist())
    for _ in range(100):
        ahead.advance(loop.reference[0], Seen(0.02, loop.joints[0] + 0.3), loop.find)
        ahead.lead(path(ahead.time), careful=True)
    assert ahead.mode is not Mode.RUNNING
    assert before == (now.time, now.mode, now.timing.off, now.servo.readings.median.tolist())
    assert not now.probe.stuck.any()

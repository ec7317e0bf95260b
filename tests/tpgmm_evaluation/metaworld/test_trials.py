"""Trials, in an environment that is none."""

import time

import numpy as np
import pytest

from tpgmm_evaluation.metaworld.trials import try_out


class Hall:
    """A hand that an action moves; 5 is where it shall be."""

    def reset(self, seed):
        self.place = float(seed)
        return self.observation(), {}

    def observation(self):
        return {"agent_pos": np.full(4, self.place), "environment_state": np.zeros(21)}

    def step(self, action):
        self.place += action
        solved = self.place >= 5
        return self.observation(), 0.0, solved, False, {"is_success": solved}


class Walker:
    """Goes on by one, or stands where it began at 0; all of it takes its time."""

    control = "displacement"

    def begin(self, first):
        busy(0.06)

    def act(self, episode, step, observed):
        busy(0.01)
        return float(observed[0] > 0)


def busy(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_an_episode_ends_with_success_or_rest_and_says_what_acting_took():
    env = Hall()
    first, second, third = try_out(env, Walker(), [1, 3, 0])
    assert env.control == "displacement"
    assert [first["success"], second["success"], third["success"]] == [True, True, False]
    assert [first["steps"], second["steps"], third["steps"]] == [4, 2, 40]
    for episode in (first, second, third):
        expected = 0.02 + 0.01 * episode["steps"]
        assert episode["acting_seconds"] == pytest.approx(expected, rel=0.2)

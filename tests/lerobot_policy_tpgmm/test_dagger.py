"""A person takes over while LeRobot's ``dagger`` strategy runs the policy; then it goes on."""

import json
import math
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.dataset import DatasetRecordConfig
from lerobot.rollout import context as rollout_context
from lerobot.rollout.configs import DAggerStrategyConfig, RolloutConfig
from lerobot.rollout.strategies import dagger

from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.lerobot_commands import PLUGINS
from tests.support.policies import pose
from tests.support.skills import bottle_demonstrations, small_bottle
from tpgmm_torch import Situation
from tpgmm_torch.exceptions import PlausibilityWarning

NAMES = small_bottle().kinematics_.joint_names
JOINTS = [f"{name}.pos" for name in NAMES]
POSE_NAMES = [f"bottle_{part}.pos" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
RATE, LONG = 20, 13.6
#: From when to when a person leads the robot [s].
BEGIN, END = 2.0, 4.0


def reproduce(model, shown):
    time = torch.linspace(0, LONG, round(LONG * RATE) + 1, dtype=torch.float64)
    [trajectory] = model.predict([Situation(shown.joints[0], shown.frames, time)])
    return trajectory.joints


class Person:
    """Leads the robot along the skill, but lifts an elbow on the way; presses the keys."""

    name, is_connected, feedback_features = "person", True, {}

    def __init__(self, path):
        self.path, self.ticks, self.led = path, 0, 0
        self.events = None

    def connect(self):
        pass

    def disconnect(self):
        pass

    def tick(self):
        """Once for each observation: pause, correct, pause, go on, stop."""
        self.ticks += 1
        keys = {40: "pause_resume", 44: "correction", 86: "correction", 90: "pause_resume"}
        if self.ticks in keys:
            self.events.request_transition(keys[self.ticks])
        if self.ticks == 130:
            self.events.stop_recording.set()

    def get_action(self):
        share = min(self.led / 40, 1.0)
        joints = self.path[round(BEGIN * RATE) + self.led].clone()
        joints[NAMES.index("l_elbow")] -= 0.3 * math.sin(math.pi * share)
        self.led += 1
        return dict(zip(JOINTS, joints.tolist(), strict=True))


def test_a_person_corrects_and_the_policy_goes_on(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(PLUGINS)
    from lerobot_robot_bimanual import BimanualConfig

    shown = bottle_demonstrations()[5]
    model, path = small_bottle(), reproduce(small_bottle(), shown)
    start = dict(zip(JOINTS, shown.joints[0].tolist(), strict=True))
    start |= dict(zip(POSE_NAMES, pose(shown.frames["bottle"]).tolist(), strict=True))
    (tmp_path / "start.json").write_text(json.dumps(start))
    names = {"state_names": list(start), "action_names": JOINTS}
    saved = TPGMMPolicy.from_estimator(model, fps=RATE, **names)
    saved.save_pretrained(tmp_path / "policy")

    policy = PreTrainedConfig.from_pretrained(tmp_path / "policy")
    policy.pretrained_path = tmp_path / "policy"
    person = Person(path)
    monkeypatch.setattr(rollout_context, "make_teleoperator_from_config", lambda _: person)
    monkeypatch.setattr(dagger, "precise_sleep", lambda _: None)
    monkeypatch.setattr(dagger, "log_say", lambda *_: None)
    given = "local/rollout_corrections", "shake", tmp_path / "set", RATE
    config = RolloutConfig(
        robot=BimanualConfig(start=tmp_path / "start.json", log=tmp_path / "log.json"),
        teleop=SimpleNamespace(type="person"), policy=policy, fps=RATE, task="shake",
        strategy=DAggerStrategyConfig(num_episodes=2, smooth_handover=False),
        dataset=DatasetRecordConfig(*given, push_to_hub=False),
        play_sounds=False, return_to_initial_position=False,
    )  # fmt: skip
    context = rollout_context.build_rollout_context(config, Event())
    strategy = dagger.DAggerStrategy(config.strategy)
    person.events = strategy._events
    robot = context.hardware.robot_wrapper.inner
    observe = robot.get_observation
    robot.get_observation = lambda: (person.tick(), observe())[1]
    strategy.setup(context)
    with pytest.warns(PlausibilityWarning, match="start posture"):  # in the midst of the skill
        strategy.run(context)
    strategy.teardown(context)

    sent = json.loads((tmp_path / "log.json").read_text())
    moved = np.array([[action[name] for name in JOINTS] for action in sent])
    assert person.led > 35
    # it went on from where the person left, without a jump, along the skill
    after = moved[-35:]
    assert np.abs(np.diff(moved[-40:], axis=0)).max() < 0.2
    places = np.abs(path.numpy()[None] - after[:, None]).max(-1).argmin(1) / RATE
    assert END - 0.5 < places[-1] < END + 3.0

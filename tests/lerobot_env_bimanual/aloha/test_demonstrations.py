"""What the scripted expert does, recorded, and TP-GMM from a few of those episodes."""

import pytest
import torch

from lerobot_env_bimanual.aloha.demonstrations import record_aloha
from lerobot_env_bimanual.aloha.expert import AlohaExpert
from lerobot_env_bimanual.aloha.robot import (
    GRIPPERS,
    JOINTS,
    aloha_operators,
    aloha_robot,
)
from lerobot_env_bimanual.aloha.state import AlohaStateEnv
from tpgmm_datasets import DatasetError, describe_lerobot, load_lerobot
from tpgmm_torch import Frame, Situation, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, PlausibilityWarning


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return record_aloha(tmp_path_factory.mktemp("aloha") / "set", 6, seed=20)


def test_recording_holds_what_was_measured_and_commanded(recorded):
    found = describe_lerobot(recorded)
    assert found.problems == ()
    assert found.fps == 50
    measured = load_lerobot(recorded, robot=aloha_robot())
    with pytest.warns(PlausibilityWarning, match="never move.*: left_arm_waist"):
        references = load_lerobot(recorded, robot=aloha_robot(), joints="action")
    env = AlohaStateEnv()
    for seed, (state, action) in enumerate(zip(measured, references, strict=True), start=20):
        start = env.reset(seed=seed)[0]
        pose = torch.cat((state.frame("cube").position, state.frame("cube").orientation))
        assert pose.numpy() == pytest.approx(start["environment_state"], abs=1e-6)
        plan = AlohaExpert().plan(*start.values())
        assert action.joints.numpy() == pytest.approx(plan, abs=1e-6)
        assert state.joints[0].numpy() == pytest.approx(start["agent_pos"], abs=1e-6)
        after = env.step(plan[0])[0]["agent_pos"]
        assert state.joints[1].numpy() == pytest.approx(after, abs=1e-6)
        held = state.joints[180, [JOINTS.index(name) for name in GRIPPERS]]
        assert held[1] == pytest.approx(0.6, abs=0.05)  # the cube is between the fingers
    with pytest.raises(DatasetError, match="exists"):
        record_aloha(recorded, 1)


def test_a_failed_demonstration_is_not_recorded(tmp_path):
    with pytest.raises(DataError, match="seed 20"):  # no time to lift the cube
        record_aloha(tmp_path / "set", 1, seed=20, duration=3.0)
    assert not (tmp_path / "set").exists()


def test_tpgmm_learns_to_hand_the_cube_over(recorded):
    robot = aloha_robot()
    with pytest.warns(PlausibilityWarning, match="never move"):  # not all are needed
        demonstrations = load_lerobot(recorded, robot=robot, joints="action")
    model = TaskParameterizedGMM(10, aloha_operators("transfer_cube"), robot, random_state=0)
    model.fit(demonstrations)
    env = AlohaStateEnv()
    situations = []
    for seed in range(1000, 1004):
        start, _ = env.reset(seed=seed)
        pose = start["environment_state"]
        frames = {"cube": Frame(pose[:3], pose[3:])}
        situations.append(Situation(start["agent_pos"], frames))
    solved = 0
    for seed, trajectory in enumerate(model.predict(situations, candidates=False), 1000):
        env.reset(seed=seed)
        solved += 4 in [env.step(reference)[1] for reference in trajectory.joints.numpy()]
    assert solved >= 3

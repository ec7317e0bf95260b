"""The command that records demonstrations with cameras."""

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_env_bimanual import record as module
from lerobot_env_bimanual.record import EXPERTS, expert, main
from lerobot_env_bimanual.rendering import offscreen
from tpgmm_datasets import load_lerobot
from tpgmm_torch.exceptions import UnknownNameError
from tpgmm_vision.cell import read_cell

DRAWN = pytest.mark.skipif(offscreen() is None, reason="nothing can be drawn here")
pytestmark = [DRAWN, pytest.mark.slow]

SMALL = ["--size", "160", "120", "--fps", "25"]


def opened(path):
    return LeRobotDataset("local/set", root=path, video_backend="pyav")


def test_demonstrations_are_recorded_as_they_are_done(tmp_path, capfd):
    command = ["--task", "carry_and_put", "--n", "1", "--true-poses", "--cameras", "front,side"]
    assert main([*command, *SMALL, "--out", str(tmp_path / "set")]) == 0
    assert capfd.readouterr().err == "episode 1 of 1\n"  # encoders say nothing
    read = opened(tmp_path / "set")
    [shown] = load_lerobot(tmp_path / "set")
    cell = read_cell(tmp_path / "set" / "cell.json")
    assert {one.key for one in cell.cameras.values()} == set(read.meta.video_keys)
    assert list(cell.objects) == list(shown.frames) == ["bottle", "tray"]
    bottle, tray = (shown.frame(name).position.numpy() for name in cell.objects)
    away = bottle[-1, :2] - tray.reshape(-1, 3)[0, :2]
    assert np.linalg.norm(away) < 0.005 < np.ptp(bottle[:, 2])
    # what is recorded can be done once more: references of the set, sent to the environment
    env = expert("carry_and_put").environment(fps=25)
    frames = {name: shown.frame(name) for name in cell.objects}
    first = {name: one[0] if one.batch_shape else one for name, one in frames.items()}
    poses = {name: np.append(one.position, one.orientation) for name, one in first.items()}
    env.reset(seed=0, options={"joints": shown.joints[0].numpy(), **poses})
    for row in range(len(read)):
        observation, *_ = env.step(read.hf_dataset[row]["action"].numpy())
    np.testing.assert_allclose(observation["agent_pos"], shown.joints[-1], atol=0.01)


def test_poses_are_left_out_unless_they_are_asked_for(tmp_path):
    command = ["--task", "bottle_shaking", "--n", "1", "--codec", "pictures"]
    assert main([*command, *SMALL, "--out", str(tmp_path / "set")]) == 0
    assert "observation.environment_state" not in opened(tmp_path / "set").features
    assert main([*command, *SMALL, "--out", str(tmp_path / "set")]) == 1


def test_a_calibration_is_an_ordinary_episode(tmp_path, monkeypatch):
    monkeypatch.setattr(module.calibration, "DRAWN", 2000)
    command = ["--task", "calibration", "--n", "3", "--offset-deg", "1", "--hand", "l_hand"]
    assert main([*command, "--fps", "10", "--out", str(tmp_path / "set")]) == 0
    read, cell = opened(tmp_path / "set"), read_cell(tmp_path / "set" / "cell.json")
    assert read.num_episodes == 1 and not cell.objects
    assert set(cell.joint_offsets) == {one for one in cell.joints if not one.startswith("r_")}
    offsets = np.array([cell.joint_offsets.get(name, 0.0) for name in cell.joints])
    assert 0.2 < np.degrees(np.abs(offsets[offsets != 0]).mean()) < 3
    states = np.stack([read.hf_dataset[row]["observation.state"] for row in range(len(read))])
    still = np.abs(np.diff(states, axis=0)).max(axis=1) < 2e-3
    assert 3 * 3 <= still.sum() < len(still) - 10, "it stands in each posture, and moves"


def test_what_is_not_there_is_refused(tmp_path, capsys):
    with pytest.raises(UnknownNameError, match="pour"):
        expert("fly")
    others = {*module.TASKS, *module.SUITE, *module.MORE}
    assert set(EXPERTS) == {"bottle_shaking", "carry_and_put"} | others
    out = ["--out", str(tmp_path / "set")]
    for wrong in ("pour --cameras top", "pour --n 0", "bottle_shaking --robot g1"):
        assert main(["--task", *wrong.split(), *out]) == 1
    assert main(["--task", "pour", "--cameras", "", *out]) == 1
    for wrong in (["--task", "pour", "--offset-deg", "1", *out], ["--help"]):
        with pytest.raises(SystemExit):
            main(wrong)
    printed = capsys.readouterr()
    assert "front" in printed.err
    assert "upper_body, and bi_so101 for cup_on_saucer" in " ".join(printed.out.split())
    assert list(tmp_path.iterdir()) == []


def test_failures_are_not_kept(tmp_path, monkeypatch, capsys):
    able = expert("bottle_shaking")
    turns = iter((True, False, False))

    def motion(seed):
        shown = able.motion(seed)
        if next(turns):
            shown.joints[:] = shown.joints[:1]  # it stands
        return shown

    poor = module.Expert(able.environment, motion, able.objects)
    monkeypatch.setattr(module, "expert", lambda *_: poor)
    command = ["--task", "bottle_shaking", "--n", "1", *SMALL]
    assert main([*command, "--out", str(tmp_path / "set")]) == 0
    assert opened(tmp_path / "set").num_episodes == 1
    assert "failed" in capsys.readouterr().err

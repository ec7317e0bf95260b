"""The policy in LeRobot's own commands, from ``tpgmm fit`` on."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support import planted_poses
from tests.support.command_line import output, run
from tests.support.lerobot_commands import lerobot
from tests.support.policies import STATE, act, batch, changed, fitted, pose, situations
from tests.support.skills import bottle_demonstrations, generator, small_bottle
from tpgmm_control import rollout as reproduced
from tpgmm_datasets import save_lerobot
from tpgmm_torch import Demonstration
from tpgmm_torch.data.pose_names import POSE_PARTS

NAMES = fitted().kinematics.joint_names
PARTS = [f"bottle_{part}.pos" for part in POSE_PARTS]
POSE = dict(zip(PARTS, pose(bottle_demonstrations()[5].frames["bottle"]).tolist(), strict=True))

BOTTLE = (
    "--robot", "upper_body", "--link", "l_hand", "--link", "r_hand", "--n-components", 30,
    "--format", "lerobot",
)  # fmt: skip


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    """A policy of the paper's skill, from ten demonstrations of 20 steps per second."""
    folder = tmp_path_factory.mktemp("fitted")
    shaking = replace(generator(), steady_rhythm=True)
    save_lerobot(shaking.demonstrations(10, seed=0), folder / "set", fps=20, task="shake")
    printed = output("fit", folder / "set", *BOTTLE, "--out", folder / "policy")
    saved, following = printed.splitlines()[-2:]
    assert saved.endswith(f" {folder / 'policy'}")
    assert f"tpgmm report {folder / 'policy'} --dataset" in following
    return folder / "policy"


def test_names_units_and_rate_of_the_data_set_go_along(directory):
    config = TPGMMPolicy.from_pretrained(directory).config
    assert tuple(config.state_names) == tuple(config.action_names) == NAMES
    assert config.environment_names[3] == "bottle.qw"
    assert config.fps == 20 and config.frames == {"bottle": [*range(7)]}
    assert config.units is None  # it is in radians


def test_a_data_set_in_degrees_makes_a_policy_in_degrees(tmp_path):
    names = [f"{name}.pos" for name in NAMES[::-1]]
    degrees = [
        Demonstration(d.time, d.joints.flip(-1).rad2deg(), d.frames, names)
        for d in bottle_demonstrations()[:3]
    ]
    units = dict.fromkeys(names, "raw")
    save_lerobot(degrees, tmp_path / "set", fps=20, task="shake", units=units)
    arguments = (
        "fit", tmp_path / "set", "--robot", "upper_body", "--link", "l_hand", "--link",
        "r_hand", "--units", "deg", "--rate", 5, "--alignment", "none", "--tol", 0.1,
        "--format", "lerobot", "--out",
    )  # fmt: skip
    output(*arguments, tmp_path / "policy")
    policy = TPGMMPolicy.from_pretrained(tmp_path / "policy")
    assert policy.config.state_names == names and policy.config.fps == 5
    observed = {**batch(), STATE: batch()[STATE].flip(-1).rad2deg()}
    first = act(policy, observed, 1)[:, 0]
    torch.testing.assert_close(first, observed[STATE], rtol=0, atol=1e-3)
    (tmp_path / "policy" / "config.json").write_text("{}")
    assert "exists and is not a tpgmm policy" in run(*arguments, tmp_path / "policy").stderr


@pytest.mark.slow
def test_lerobot_eval_runs_it(directory, tmp_path):
    done = lerobot(
        "eval", f"--policy.path={directory}", "--env.type=bottle_shaking", "--env.fps=20",
        "--env.mode=kinematic", "--eval.n_episodes=2", "--eval.batch_size=2",
        "--eval.use_async_envs=false", f"--output_dir={tmp_path / 'out'}", home=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    outcome = json.loads((tmp_path / "out" / "eval_info.json").read_text())["overall"]
    assert outcome["n_episodes"] == 2 and outcome["pc_success"] == 100


def joints_named(values):
    """Joints as the robot calls them."""
    return dict(zip((f"{name}.pos" for name in NAMES), values.tolist(), strict=True))


def rollout(path, start, home, *more):
    """What was sent to the robot, tick by tick, by name."""
    (home / "start.json").write_text(json.dumps(start))
    done = lerobot(
        "rollout", "--strategy.type=base", f"--policy.path={path}", "--robot.type=bimanual",
        f"--robot.start={home / 'start.json'}", f"--robot.log={home / 'log.json'}",
        "--duration=2", "--return_to_initial_position=false", "--task=shake", *more, home=home,
    )  # fmt: skip
    return done, home / "log.json"


def test_lerobot_rollout_moves_a_robot_of_other_order_and_units(tmp_path):
    observed = {key: value[:1] for key, value in batch().items()}
    policy = changed(fitted(), control_fps=20.0)
    policy.save_pretrained(tmp_path / "policy")
    degrees = observed[STATE][0].double().rad2deg()
    start = dict(reversed(joints_named(degrees).items())) | POSE
    done, log = rollout(
        tmp_path / "policy", start, tmp_path, "--fps=20", "--policy.units=deg",
        "--duration=4", "--robot.stuck_after=15",
        f"--policy.state_names={json.dumps(list(start))}",
        f"--policy.action_names={json.dumps(list(start)[:17])}",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "'r_wrist_roll.pos'" in done.stderr and "20 per second (--fps)" in done.stderr
    assert re.search(r"robot 0 at 1\..* of the skill: waiting: joint '.*' is", done.stderr)
    sent = json.loads(log.read_text())
    assert len(sent) >= 12 and list(sent[0]) == list(start)[:17]
    time = torch.arange(len(sent), dtype=torch.float64) / 20
    given = situations(observed, time)
    [wanted] = reproduced(small_bottle().skill, given, bounds="robot", blend=1.0)
    for index, name in enumerate(NAMES):
        moved = np.array([action[f"{name}.pos"] for action in sent])
        # later this coarse model makes much of the last bit in which followed frames differ
        follows = wanted.joints[:12, index].rad2deg()
        np.testing.assert_allclose(moved[:12], follows, atol=1e-2)
    assert np.ptp([action["l_elbow.pos"] for action in sent]) > 1  # degrees


def test_lerobot_rollout_sends_chunks_that_a_thread_makes(tmp_path):
    observed = {key: value[:1] for key, value in batch().items()}
    changed(fitted(), control_fps=20.0).save_pretrained(tmp_path / "policy")
    start = joints_named(observed[STATE][0]) | POSE
    done, log = rollout(
        tmp_path / "policy", start, tmp_path, "--fps=20", "--inference.type=rtc",
        "--inference.queue_threshold=30", f"--policy.state_names={json.dumps(list(start))}",
        f"--policy.action_names={json.dumps(list(start)[:17])}",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "RTC inference error" not in done.stderr
    sent = json.loads(log.read_text())
    assert len(sent) >= 12
    moved = np.array([list(action.values()) for action in sent])
    time = torch.arange(100, dtype=torch.float64) / 20
    given = situations(observed, time)
    [wanted] = reproduced(small_bottle().skill, given, bounds="robot", blend=1.0)
    # whenever a chunk comes, it goes on from what was sent before, or from where it would be
    # by now if the thread was late: a few ticks on
    step = np.abs(np.diff(moved, axis=0)).max()
    assert step < 5 * float(wanted.joints.diff(dim=0).abs().max())
    # it begins at the skill's first instants; which one, a thread's delay decides
    first = np.abs(wanted.joints[:60].numpy() - moved[0]).max(axis=1)
    assert first.min() < 0.05
    assert np.ptp(moved, axis=0).max() > 0.05


def test_the_cell_of_a_tracked_set_goes_along(tmp_path):
    shaking = replace(generator(), steady_rhythm=True)
    save_lerobot(shaking.demonstrations(4, seed=0), tmp_path / "set", fps=20, task="shake")
    cell = planted_poses.cell_content()
    (tmp_path / "set" / "meta" / "cell.json").write_text(json.dumps(cell | {"source": "tags"}))
    output("fit", tmp_path / "set", *BOTTLE, "--rate", 5, "--out", tmp_path / "policy")
    config = TPGMMPolicy.from_pretrained(tmp_path / "policy").config
    assert config.cell == cell | {"source": "tags"}
    assert planted_poses.KEY in config.input_features

"""The first own skill, as the guide makes it: two SO-101 arms, a cup, no Python."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.command_line import output
from tests.support.first_skill import AT, FPS, GRASP, bimanual, record
from tests.support.lerobot_commands import lerobot
from tpgmm_datasets.tables import demonstrations_from_frame, read_table
from tpgmm_torch import Frame

GUIDE = Path(__file__).parents[2] / "docs" / "howto" / "own_data.md"
#: A place of the cup that was not shown.
CUP = Frame([0.23, 0.015, 0.03], [np.cos(0.05), 0, 0, np.sin(0.05)])
HALF = 0.5


def commands() -> list[list[str]]:
    """Those of the guide's section, as words."""
    [section] = re.findall(
        r"^\(four-commands\)=\n(.*?)^## What", GUIDE.read_text(), re.M | re.S
    )
    lines = "".join(re.findall(r"^```bash\n(.*?)^```", section, re.M | re.S))
    return [line.replace("'", "").split() for line in lines.replace("\\\n", " ").splitlines()]


def misses(joints: torch.Tensor, step: int) -> list[float]:
    """How far each hand is from where it takes the cup [m]."""
    state = bimanual().state(joints[step])
    return [
        float((state.position(link) - CUP.transform(torch.tensor(place).double())).norm())
        for link, place in GRASP.items()
    ]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder in which all commands of the section were run."""
    folder = tmp_path_factory.mktemp("first")
    record(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for program, *words in commands():
            if program == "tpgmm":
                output(*words)
            else:
                done = lerobot(program.removeprefix("lerobot-"), *words, home=folder / "home")
                assert done.returncode == 0, done.stderr[-3000:]
    return folder


def test_the_section_has_four_commands_and_those_of_lerobot():
    known = [words[1] for words in commands() if words[0] == "tpgmm"]
    assert known == ["dataset", "fit", "view", "reproduce", "dataset"]


def test_the_cup_is_grasped_where_it_was_not_shown(made, monkeypatch):
    robot, home = bimanual(), [0.0, -0.6, 0.6, 0.6, 0.0, 1.2] * 2
    pose = {"position": CUP.position.tolist(), "orientation": CUP.orientation.tolist()}
    joints = dict(zip(robot.joint_names, home, strict=True))
    monkeypatch.chdir(made)
    Path("new.json").write_text(json.dumps([{"joints": joints, "frames": {"cup": pose}}]))
    output("reproduce", "out/cups_model", "--situations", "new.json", "--out", "out/new.csv")
    [motion] = demonstrations_from_frame(read_table("out/new.csv"))
    step = int((motion.time - (AT + HALF / 2)).abs().argmin())
    assert max(misses(motion.reordered(robot.joint_names).joints, step)) < 1e-3


def test_a_policy_that_lerobot_trained_grasps_it_too(made):
    robot = bimanual()
    grippers = [i for i, name in enumerate(robot.joint_names) if "gripper" in name]
    lower, upper = robot.lower[grippers], robot.upper[grippers]
    policy = TPGMMPolicy.from_pretrained(made / "out/train/checkpoints/last/pretrained_model")
    policy.reset()
    stored = torch.rad2deg(torch.tensor([0.0, -0.6, 0.6, 0.6, 0.0, 1.2] * 2).double())
    stored[grippers] = 100 * (1.2 - lower) / (upper - lower)
    environment = torch.cat((CUP.position, CUP.orientation)).float()
    way = []
    for _ in range(round((AT + HALF / 2) * FPS)):
        observed = {
            "observation.state": stored.float()[None],
            "observation.environment_state": environment[None],
        }
        stored = policy.select_action(observed)[0].double()
        way.append(torch.deg2rad(stored))
    assert max(misses(torch.stack(way), -1)) < 1e-3

"""The first own skill, as the tutorial makes it: two SO-101 arms, a cup, no Python."""

import json
import re
import shlex
from pathlib import Path

import draccus
import pytest
import torch

from tests.support.command_line import output
from tests.support.first_skill import AT, GRASP, bimanual, record
from tests.support.lerobot_commands import lerobot
from tpgmm_datasets.tables import demonstrations_from_frame, read_table
from tpgmm_torch import Frame

pytestmark = pytest.mark.slow

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorials" / "so101.md"
#: A place of the cup that was not shown: where the tutorial puts it.
CUP = Frame([0.23, 0.015, 0.03])
HALF = 0.5


def commands() -> list[list[str]]:
    """Those of the tutorial, as words."""
    lines = "".join(re.findall(r"^```bash\n(.*?)^```", TUTORIAL.read_text(), re.M | re.S))
    return [shlex.split(line) for line in lines.replace("\\\n", " ").splitlines()]


def misses(joints: torch.Tensor) -> float:
    """How far the worse hand is from where it takes the cup [m]."""
    state = bimanual().state(joints)
    return max(
        float((state.position(link) - CUP.transform(torch.tensor(place).double())).norm())
        for link, place in GRASP.items()
    )


def roll_out(words: list[str], folder: Path) -> None:
    """Run ``lerobot-rollout`` with a simulated robot in place of the arms."""
    [table] = (folder / "recordings" / "cups" / "data").rglob("*.parquet")
    info = json.loads((folder / "recordings" / "cups" / "meta" / "info.json").read_text())
    names = info["features"]["observation.state"]["names"]
    start = dict(zip(names, read_table(table)["observation.state"][0].tolist(), strict=True))
    (folder / "start.json").write_text(json.dumps(start))
    kept = [word for word in words if not word.startswith("--robot.")]
    simulated = ["--robot.type=bimanual", "--robot.start=start.json", "--robot.log=log.json"]
    done = lerobot("rollout", *kept, *simulated, home=folder / "home")
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder in which the commands of the tutorial were run, up to the arms."""
    folder = tmp_path_factory.mktemp("first")
    record(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for program, *words in commands():
            if program == "tpgmm":
                output(*words)
            elif program == "lerobot-rollout":
                roll_out(words, folder)
    return folder


def test_the_tutorial_has_six_commands_and_no_python():
    done = [words[:2] if words[0] == "tpgmm" else words[:1] for words in commands()]
    assert [" ".join(words) for words in done] == [
        "pip",
        "lerobot-record",
        "tpgmm dataset",
        "tpgmm fit",
        "tpgmm report",
        "lerobot-rollout",
    ]
    assert "```python" not in TUTORIAL.read_text()


def test_lerobot_understands_how_the_tutorial_records():
    from lerobot.robots import bi_so_follower
    from lerobot.scripts.lerobot_record import RecordConfig
    from lerobot.teleoperators import bi_so_leader

    assert bi_so_follower and bi_so_leader  # they register themselves
    [words] = [words for words in commands() if words[0] == "lerobot-record"]
    settings = draccus.parse(RecordConfig, args=words[1:])
    assert str(settings.dataset.root) == "recordings/cups"
    assert settings.dataset.fps == 30
    assert settings.robot.left_arm_config.use_degrees  # the unit of the other commands


def test_the_cup_is_grasped_where_it_was_not_shown(made, monkeypatch):
    robot, home = bimanual(), [0.0, -0.6, 0.6, 0.6, 0.0, 1.2] * 2
    pose = {"position": CUP.position.tolist(), "orientation": CUP.orientation.tolist()}
    joints = dict(zip(robot.joint_names, home, strict=True))
    monkeypatch.chdir(made)
    Path("new.json").write_text(json.dumps([{"joints": joints, "frames": {"cup": pose}}]))
    output("reproduce", "out/policy", "--situations", "new.json", "--out", "out/new.csv")
    [motion] = demonstrations_from_frame(read_table("out/new.csv"))
    step = int((motion.time - (AT + HALF / 2)).abs().argmin())
    assert misses(motion.reorder(robot.joint_names).joints[step]) < 1e-3


def test_the_robot_that_lerobot_moves_grasps_it_too(made):
    sent = json.loads((made / "log.json").read_text())
    robot = bimanual()
    values = torch.tensor([[*action.values()] for action in sent]).double()
    joints = torch.deg2rad(values)
    grippers = [i for i, name in enumerate(robot.joint_names) if "gripper" in name]
    lower, upper = robot.lower[grippers], robot.upper[grippers]
    joints[:, grippers] = lower + values[:, grippers] / 100 * (upper - lower)
    assert [*sent[0]] == [f"{name}.pos" for name in robot.joint_names]
    open_at_the_cup = [misses(posture) for posture in joints if posture[grippers[0]] > 1.0]
    assert min(open_at_the_cup) < 1e-3


def test_the_report_is_a_page_about_the_cup(made):
    assert "cup" in (made / "out" / "report.html").read_text()

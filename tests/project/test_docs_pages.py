"""What the pages print is right: their Python runs, their commands work, and names exist."""

import re
import shlex
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from typing import get_type_hints

import pytest
import typer
from packaging.requirements import Requirement
from typer.testing import CliRunner

from tests.support import first_skill, recorded_cell
from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_datasets.bottle.skill import TASK, BottleShaking, bottle_operators
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_tools.cli.application import app
from tpgmm_torch import TaskParameterizedGMM, save
from tpgmm_torch.alignment import DynamicTimeWarping

ROOT = Path(__file__).parents[2]
PAGES = [
    path
    for path in (
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *sorted(ROOT.glob("policies/*.md")),
        *sorted(ROOT.glob("docs/**/*.md")),
    )
    if not {"_build", "gallery"} & set(path.relative_to(ROOT).parts)
]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TARGETS = re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
PROJECTS = {
    project["name"]: project
    for path in (ROOT / "pyproject.toml", *ROOT.glob("*/pyproject.toml"))
    for project in [tomllib.loads(path.read_text("utf-8"))["project"]]
}


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Language and text of the fenced blocks of a page, in order."""
    yield from BLOCK.findall(page.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Path:
    """A folder with what ``tpgmm demo`` leaves, if shorter, and with recordings of a cup."""
    folder = tmp_path_factory.mktemp("pages")
    skill = BottleShaking(rate=10)
    path = folder / "out" / "demo" / "dataset"
    save_lerobot(skill.demonstrations(5), path, fps=10, task=TASK, robot_type="upper_body")
    demonstrations = load_lerobot(path, robot=skill.robot)
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(demonstrations)
    model = TaskParameterizedGMM(12, bottle_operators(), skill.robot).fit(aligned)
    save(model, folder / "out" / "demo" / "model")
    (folder / "robot.urdf").write_text(upper_body_urdf(), encoding="utf-8")
    first_skill.record(folder)
    return folder


@pytest.fixture(scope="module")
def cell(tmp_path_factory) -> Path:
    """A folder with recordings of an arm, a cup and a board before a camera."""
    folder = tmp_path_factory.mktemp("cell")
    recorded_cell.record(folder, episodes=3)
    return folder


def check_options(program: str, arguments: list[str]) -> None:
    """Options of LeRobot's commands exist; other tests run them, which takes half a minute."""
    from lerobot.configs.dataset import DatasetRecordConfig
    from lerobot.configs.default import DatasetConfig, EvalConfig
    from lerobot.configs.eval import EvalPipelineConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.envs import EnvConfig
    from lerobot.robots import RobotConfig, bi_so_follower, so_follower
    from lerobot.rollout.configs import RolloutConfig, RolloutStrategyConfig
    from lerobot.rollout.inference import InferenceEngineConfig
    from lerobot.scripts.lerobot_record import RecordConfig
    from lerobot.teleoperators import TeleoperatorConfig, bi_so_leader, so_leader

    import lerobot_env_bimanual
    from lerobot_policy_tpgmm import TPGMMConfig

    assert bi_so_follower and bi_so_leader and lerobot_env_bimanual  # they register
    assert so_follower and so_leader  # what pages use
    options = dict(argument.removeprefix("--").split("=", 1) for argument in arguments)
    of_command = {
        "lerobot-eval": EvalPipelineConfig,
        "lerobot-train": TrainPipelineConfig,
        "lerobot-record": RecordConfig,
        "lerobot-rollout": RolloutConfig,
    }
    of_dataset = DatasetRecordConfig if program == "lerobot-record" else DatasetConfig
    groups = {"policy": TPGMMConfig, "eval": EvalConfig, "dataset": of_dataset}
    choices = {
        "env": EnvConfig,
        "robot": RobotConfig,
        "teleop": TeleoperatorConfig,
        "strategy": RolloutStrategyConfig,
        "inference": InferenceEngineConfig,
    }
    for group, registry in choices.items():
        if f"{group}.type" in options:
            groups[group] = registry.get_choice_class(options[f"{group}.type"])
    for option in options:
        group, _, field = option.rpartition(".")
        outer, _, inner = group.partition(".")  # --policy.em.tol
        kind = groups[outer] if outer else of_command[program]
        if inner:
            kind = get_type_hints(kind)[inner]
        known = {f.name for f in fields(kind)}
        assert field in {*known, "type", "path"}, f"{program} has no option --{option}"


def run(command: str) -> None:
    """Do what a line of a shell would, as far as a test can."""
    program, *arguments = shlex.split(command, comments=True)
    if program == "make":
        asked = {argument for argument in arguments if "=" not in argument}
        assert asked <= set(TARGETS), f"no such target: {command}"
    elif program == "pip":
        for requirement in map(Requirement, arguments[1:]):
            if requirement.name != "lerobot":
                known = PROJECTS[requirement.name]["optional-dependencies"]
                assert requirement.extras <= known.keys(), command
    elif program == "python" and arguments[0] == "-m":
        assert find_spec(arguments[1]), f"no such module: {command}"
    elif program == "python":
        assert (ROOT / arguments[0]).is_file(), f"no such script: {command}"
    elif program == "torchrun":
        # test_processes.py starts processes: here one does what each would
        run(shlex.join(arguments[arguments.index("--no-python") + 1 :]))
    elif program.startswith("lerobot-"):
        check_options(program, arguments)
    elif program == "tpgmm" and arguments[0] in ("demo", "compare", "app"):
        # they take minutes, or serve until they are stopped, and other tests run them: here the
        # options are only read
        group = typer.main.get_command(app)
        name, known, rest = group.resolve_command(typer.Context(group), arguments)
        known.make_context(name, rest)
    elif program == "tpgmm":
        done = CliRunner().invoke(app, arguments)
        assert done.exit_code == 0, f"{command}: {done.output}"
    else:
        raise AssertionError(f"a page prints {program!r}, which this test cannot check")


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] if page.name == "cell.md" else [])
        for page in PAGES
        if any(language != "text" for language, _ in blocks(page))
    ],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
# the demo of these tests has so few demonstrations that a fold has only two
@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_code_and_commands_of_a_page_run_from_top_to_bottom(
    page, request, tmp_path, monkeypatch
):
    given = "cell" if page.name == "cell.md" else "demo"
    shutil.copytree(request.getfixturevalue(given), tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    names = {"__name__": page.stem}
    for language, text in blocks(page):
        if language == "python":
            exec(compile(text, str(page), "exec"), names)
        elif language == "bash":
            for command in text.replace("\\\n", " ").splitlines():
                if not command.startswith("#"):
                    run(command)
        else:
            assert language in ("text", "bibtex"), f"{page} has a block of {language}"


def test_the_readme_is_short_and_installs_before_anything_else_of_a_shell():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.split()) <= 700
    first = next(text for language, text in blocks(ROOT / "README.md") if language == "bash")
    assert first.startswith("pip install 'tpgmm-torch[cli]'")


def test_pictures_that_are_kept_as_files_stay_small():
    sizes = [path.stat().st_size for path in (ROOT / "docs" / "images").iterdir()]
    assert max(sizes) <= 300e3
    assert sum(sizes) < 1e6

"""What is installed, and under which names: wheel, containers, versions, constraints."""

import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from itertools import chain
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[2]
#: The folder of each distribution, and its packages.
DISTRIBUTIONS = {
    "tpgmm_torch": (
        ROOT,
        (
            "tpgmm_torch",
            "control/tpgmm_control",
            "datasets/tpgmm_datasets",
            "tools/tpgmm_tools",
            "vision/tpgmm_vision",
        ),
    ),
    "lerobot_policy_tpgmm": (ROOT / "policies", ("lerobot_policy_tpgmm",)),
    "lerobot_env_bimanual": (ROOT / "environments", ("lerobot_env_bimanual",)),
    "tpgmm_evaluation": (ROOT / "evaluation", ("tpgmm_evaluation",)),
}
SHIPPED = {".css", ".html", ".jinja", ".js", ".py", ".typed", ".urdf", ".xml"}
PROJECTS = {
    name: tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for name, (folder, _) in DISTRIBUTIONS.items()
}
PROJECT = PROJECTS["tpgmm_torch"]
EXTRAS = PROJECT["optional-dependencies"]


def run(*command: str | Path) -> str:
    """Run Python from the repository root; its output, or what it printed when it failed."""
    done = subprocess.run(
        [sys.executable, *command],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=os.environ | {"HF_HUB_OFFLINE": "1", "GITHUB_REPOSITORY": "owner/name"},
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


# The containers


@pytest.mark.parametrize(
    "container",
    ["control", "datasets", "tools", "vision", "policies", "environments", "evaluation"],
)
def test_containers_hold_packages_and_no_modules(container):
    assert (ROOT / container).is_dir()
    assert [path.name for path in (ROOT / container).glob("*.py")] == []


def test_hugging_face_datasets_is_importable_from_the_repository_root():
    script = "import datasets; datasets.load_dataset; print(datasets.__file__)"
    found = Path(run("-c", script).strip())
    assert ROOT / "datasets" not in found.parents


# The wheels


@pytest.fixture(scope="module", params=DISTRIBUTIONS)
def wheel(request, tmp_path_factory) -> tuple[str, list[str], str]:
    """A wheel built from this tree: its distribution, the names of its files, its metadata."""
    folder = tmp_path_factory.mktemp("wheel")
    source, _ = DISTRIBUTIONS[request.param]
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", folder, source)
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        [about] = [name for name in names if name.endswith(".dist-info/METADATA")]
        return request.param, names, archive.read(about).decode()


def test_wheel_holds_exactly_the_packages_and_their_data(wheel):
    distribution, names, _ = wheel
    source, packages = DISTRIBUTIONS[distribution]
    expected = {
        f"{package.rpartition('/')[2]}/{path.relative_to(source / package).as_posix()}"
        for package in packages
        for path in (source / package).rglob("*")
        if path.suffix in SHIPPED
    }
    assert {f"{package.rpartition('/')[2]}/py.typed" for package in packages} <= expected
    assert any(name.endswith(".urdf") for name in expected) == (distribution == "tpgmm_torch")
    assert {name for name in names if ".dist-info/" not in name} == expected
    assert len(names) == len(set(names))


def test_wheel_describes_itself(wheel):
    _, names, metadata = wheel
    about = {name.partition("/")[2] for name in names if ".dist-info/" in name}
    about -= {"entry_points.txt"}
    assert about == {"METADATA", "WHEEL", "RECORD", "licenses/LICENSE"}
    assert f"\nVersion: {PROJECT['version']}\n" in metadata
    assert "\nDescription-Content-Type: text/markdown\n" in metadata


def test_wheel_of_the_toolkit_says_where_its_repository_is(wheel):
    distribution, _, metadata = wheel
    if distribution == "tpgmm_torch":
        assert "\nProject-URL: Homepage, https://github.com/owner/name\n" in metadata


def test_command_tpgmm_leads_to_a_function():
    (command,) = importlib.metadata.entry_points(group="console_scripts", name="tpgmm")
    assert callable(command.load())


# The version


def test_version_is_the_same_everywhere():
    version = PROJECT["version"]
    for project in PROJECTS.values():
        assert project["version"] == version
        assert importlib.metadata.version(project["name"]) == version


def test_distributions_ask_for_each_other_in_the_same_version():
    ours = {project["name"] for project in PROJECTS.values()}
    for project in PROJECTS.values():
        extras = project.get("optional-dependencies", {})
        asked = map(Requirement, chain(project.get("dependencies", ()), *extras.values()))
        others = [r for r in asked if r.name in ours and r.name != project["name"]]
        assert {str(r.specifier) for r in others} <= {f"=={PROJECT['version']}"}
        for requirement in others:
            [its] = [p for p in PROJECTS.values() if p["name"] == requirement.name]
            assert requirement.extras <= its["optional-dependencies"].keys()


def test_citation_and_changelog_agree_with_the_version():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    [version] = re.findall(r"^version: (.+)$", citation, re.MULTILINE)
    [day] = re.findall(r"^date-released: (\d{4}-\d{2}-\d{2})$", citation, re.MULTILINE)
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.findall(r"^## \[(\d.*)\] - (\S+)$", changelog, re.MULTILINE)
    assert version == PROJECT["version"]
    assert released[0] == (version, day)  # the newest first


def test_every_distribution_has_its_licence():
    texts = {(folder / "LICENSE").read_text("utf-8") for folder, _ in DISTRIBUTIONS.values()}
    assert len(texts) == 1
    assert {project["license"] for project in PROJECTS.values()} == {"Apache-2.0"}


# Requirements and constraints


def requirements(*extras: str) -> list[Requirement]:
    """Requirements on other projects of the core and of these extras, own extras followed."""
    found = []
    lines = [line for extra in extras for line in EXTRAS[extra]]
    for requirement in map(Requirement, PROJECT["dependencies"] + lines):
        if canonicalize_name(requirement.name) != PROJECT["name"]:
            found.append(requirement)
        else:
            found += requirements(*sorted(requirement.extras))
    return found


def constraints(file: str = "constraints.txt") -> dict[str, str]:
    """Versions by canonical name, from lines of the form ``name==version``."""
    versions = {}
    for line in (ROOT / file).read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            match = re.fullmatch(r"([\w.-]+)==([\w.!+]+)", line)
            assert match, f"{file} has a line that is not name==version: {line!r}"
            name = canonicalize_name(match[1])
            assert name not in versions, f"{file} names {name} twice"
            versions[name] = match[2]
    return versions


@pytest.mark.parametrize("extra", EXTRAS)
def test_constraints_satisfy_every_extra(extra):
    pinned = constraints()
    for requirement in requirements(extra):
        version = pinned.get(canonicalize_name(requirement.name))
        assert version is None or requirement.specifier.contains(version), str(requirement)


def test_the_tests_run_with_the_oldest_lerobot_and_make_newest_with_the_newest():
    ranges = {
        str(requirement.specifier)
        for project in PROJECTS.values()
        for line in chain(
            project.get("dependencies", ()), *project.get("optional-dependencies", {}).values()
        )
        if (requirement := Requirement(line)).name == "lerobot"
    }
    assert ranges == {f"<0.7,>={constraints()['lerobot']}"}


def test_constraints_name_everything_that_the_tests_install():
    assert {"data", "plot", "simulation", "lerobot"} <= EXTRAS.keys()
    needed = {canonicalize_name(requirement.name) for requirement in requirements("test")}
    assert needed - constraints().keys() == set()


def test_everything_that_the_tests_need_is_installed():
    for requirement in requirements("test"):
        installed = importlib.metadata.version(requirement.name)
        assert requirement.specifier.contains(installed), f"{requirement}, found {installed}"


def test_the_build_back_end_and_its_tools_are_among_the_test_requirements():
    needed = {canonicalize_name(requirement.name) for requirement in requirements("test")}
    assert {"build", "hatchling", "packaging"} <= needed


def test_the_oldest_versions_are_those_that_are_promised():
    """Extras that need newer ones of what others need too are not among them."""
    promised = {}
    for requirement in requirements("cli", "collada", "hub", "simulation"):
        for bound in requirement.specifier:
            if bound.operator == ">=":
                promised[canonicalize_name(requirement.name)] = Version(bound.version)
    oldest = constraints("constraints-oldest.txt")
    assert {name: Version(version) for name, version in oldest.items()} == promised


# The hosted workflow


def test_the_hosted_workflow_runs_what_ci_runs_on_every_supported_python():
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))
    check = workflow["jobs"]["check"]
    assert check["strategy"]["matrix"]["python"] == ["3.12", "3.13"]
    assert [step["run"] for step in check["steps"] if "run" in step] == [".ci/run"]
    supported = re.search(
        r"\((\d+), (\d+)\) <= .* < \((\d+), (\d+)\)", (ROOT / "Makefile").read_text()
    )
    assert supported.groups() == ("3", "12", "3", "14")
    wheels = workflow["jobs"]["wheels"]
    assert wheels["strategy"]["matrix"] == check["strategy"]["matrix"]
    commands = "\n".join(step.get("run", "") for step in wheels["steps"])
    assert "make dist" in commands and "tpgmm --version" in commands

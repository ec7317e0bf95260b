"""What is installed, and under which names: wheel, containers, versions, constraints."""

import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "tpgmm_torch": ROOT / "tpgmm_torch",
    "tpgmm_datasets": ROOT / "datasets" / "tpgmm_datasets",
}
SHIPPED = {".py", ".typed", ".urdf"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]


def run(*command: str | Path) -> str:
    """Run Python from the repository root; its output, or what it printed when it failed."""
    done = subprocess.run(
        [sys.executable, *command],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=os.environ | {"HF_HUB_OFFLINE": "1"},
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


# The containers


@pytest.mark.parametrize("container", ["datasets", "policies"])
def test_containers_hold_packages_and_no_modules(container):
    assert (ROOT / container).is_dir()
    assert [path.name for path in (ROOT / container).glob("*.py")] == []


def test_hugging_face_datasets_is_importable_from_the_repository_root():
    script = "import datasets; datasets.load_dataset; print(datasets.__file__)"
    found = Path(run("-c", script).strip())
    assert ROOT / "datasets" not in found.parents


# The wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> list[str]:
    """Names of the files in a wheel built from this tree."""
    folder = tmp_path_factory.mktemp("wheel")
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT)
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        return archive.namelist()


def test_wheel_holds_exactly_the_packages_and_their_data(wheel):
    expected = {
        f"{package}/{path.relative_to(folder).as_posix()}"
        for package, folder in PACKAGES.items()
        for path in folder.rglob("*")
        if path.suffix in SHIPPED
    }
    assert {"tpgmm_torch/py.typed", "tpgmm_datasets/py.typed"} <= expected
    assert any(name.endswith(".urdf") for name in expected)
    assert {name for name in wheel if ".dist-info/" not in name} == expected
    assert len(wheel) == len(set(wheel))


def test_wheel_describes_itself(wheel):
    about = {name.partition("/")[2] for name in wheel if ".dist-info/" in name}
    assert about == {"METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE"}


def test_command_tpgmm_leads_to_a_function():
    (command,) = importlib.metadata.entry_points(group="console_scripts", name="tpgmm")
    assert callable(command.load())


# The version


def test_version_is_the_same_everywhere():
    version = PROJECT["version"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.+)$", citation, re.MULTILINE) == [version]
    assert importlib.metadata.version("tpgmm-torch") == version
    release = Version(version).base_version
    assert release in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


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


def constraints() -> dict[str, str]:
    """Versions by canonical name, from lines of the form ``name==version``."""
    versions = {}
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            match = re.fullmatch(r"([\w.-]+)==([\w.!+]+)", line)
            assert match, f"constraints.txt has a line that is not name==version: {line!r}"
            name = canonicalize_name(match[1])
            assert name not in versions, f"constraints.txt names {name} twice"
            versions[name] = match[2]
    return versions


@pytest.mark.parametrize("extra", EXTRAS)
def test_constraints_satisfy_every_extra(extra):
    pinned = constraints()
    for requirement in requirements(extra):
        version = pinned.get(canonicalize_name(requirement.name))
        assert version is None or requirement.specifier.contains(version), str(requirement)


def test_constraints_name_everything_that_the_tests_install():
    assert {"robots", "data", "plot", "simulation", "lerobot"} <= EXTRAS.keys()
    needed = {canonicalize_name(requirement.name) for requirement in requirements("test")}
    assert needed - constraints().keys() == set()


def test_everything_that_the_tests_need_is_installed():
    for requirement in requirements("test"):
        installed = importlib.metadata.version(requirement.name)
        assert requirement.specifier.contains(installed), f"{requirement}, found {installed}"


def test_the_build_back_end_and_its_tools_are_among_the_test_requirements():
    needed = {canonicalize_name(requirement.name) for requirement in requirements("test")}
    assert {"build", "hatchling", "packaging"} <= needed

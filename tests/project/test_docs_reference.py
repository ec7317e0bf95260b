"""The reference has every public name, formulas are tied to code and tests, links are real."""

import importlib
import re
import sys
from pathlib import Path

import pytest

import tpgmm_control
import tpgmm_datasets
import tpgmm_torch

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
TIES = re.compile(r"^```\{ties\}\n:code: (.+)\n:tests: (.+)\n```$", re.MULTILINE)
FORMULA = re.compile(r"^\$\$(?:.+?)\$\$$", re.MULTILINE | re.DOTALL)
ROLE = re.compile(r"\{(?:py:)?(?:func|class|meth|mod|exc|obj|data)\}`(?:[^`<]*<)?~?([\w.]+)>?`")


@pytest.fixture(scope="module", autouse=True)
def extensions():
    """Make the site's own Sphinx extensions importable."""
    sys.path.insert(0, str(DOCS / "_ext"))
    yield
    sys.path.remove(str(DOCS / "_ext"))


@pytest.fixture(scope="module")
def reference():
    """Return the module that reads the API reference."""
    return importlib.import_module("public_names")


# The API reference


@pytest.mark.parametrize(
    "package", [tpgmm_torch, tpgmm_control, tpgmm_datasets], ids=lambda p: p.__name__
)
def test_pages_by_concept_have_every_name_of_the_package(package, reference):
    wanted = {f"{package.__name__}.{name}" for name in package.__all__}
    assert wanted - reference.documented() == set()


def test_the_page_of_the_plugins_has_what_its_users_need(reference):
    wanted = {
        "lerobot_policy_tpgmm.configuration_tpgmm.TPGMMConfig",
        "lerobot_policy_tpgmm.modeling_tpgmm.TPGMMPolicy",
        "lerobot_policy_tpgmm.processor_tpgmm.make_tpgmm_pre_post_processors",
        "lerobot_env_bimanual.BottleShakingConfig",
        "lerobot_env_bimanual.AlohaStateConfig",
        "lerobot_env_bimanual.bottle.shaking.BottleShakingEnv",
        "lerobot_env_bimanual.aloha.state.AlohaStateEnv",
        "tpgmm_evaluation.compare.compare",
        "tpgmm_evaluation.settings.Settings",
    }
    assert wanted - reference.documented() == set()


def test_pages_document_nothing_that_is_gone(reference):
    assert [name for name in reference.documented() if not reference.exists(name)] == []


def test_names_that_pages_mention_exist(reference):
    wrong = [
        f"{page.name}: {name}"
        for page in DOCS.rglob("*.md")
        if "_build" not in page.parts
        for name in ROLE.findall(page.read_text(encoding="utf-8"))
        if name.startswith(reference.PACKAGES) and not reference.exists(name)
    ]
    assert wrong == []


def test_every_command_has_its_help_on_the_page_of_the_command_line():
    import typer

    from tpgmm_tools.cli import application

    page = (DOCS / "api" / "command_line.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^```\{help-of\} (.+)$", page, re.MULTILINE))
    group = typer.main.get_command(application.app)
    context = typer.Context(group)
    names = group.list_commands(context)
    commands = {name: group.resolve_command(context, [name])[1] for name in names}
    known = {name for name, command in commands.items() if not hasattr(command, "commands")} | {
        f"{name} {inner}"
        for name, command in commands.items()
        for inner in getattr(command, "commands", ())
    }
    assert known - shown == set()


# Mathematics


def test_every_formula_is_followed_by_what_computes_and_tests_it():
    text = (DOCS / "explanation" / "mathematics.md").read_text(encoding="utf-8")
    formulas = list(FORMULA.finditer(text))
    assert len(formulas) > 20
    for formula in formulas:
        after = text[formula.end() :].lstrip()
        assert TIES.match(after), f"no ties below {formula[0]}"


def test_ties_lead_to_functions_and_tests_that_exist(reference):
    ties = importlib.import_module("ties")
    text = (DOCS / "explanation" / "mathematics.md").read_text(encoding="utf-8")
    for code, tests in TIES.findall(text):
        assert [name for name in code.split(", ") if not reference.exists(name)] == []
        assert [test for test in tests.split(", ") if not ties.test_exists(test)] == []


def test_a_test_that_is_gone_is_noticed():
    ties = importlib.import_module("ties")
    assert ties.test_exists(
        "project/test_docs_reference.py::test_a_test_that_is_gone_is_noticed"
    )
    for gone in (
        "project/test_docs_reference.py::test_gone",
        "test_gone.py::test",
        "project/test_layers.py",
    ):
        assert not ties.test_exists(gone)


# Links


def test_links_of_the_built_site_are_checked(tmp_path):
    sitelinks = importlib.import_module("sitelinks")
    (tmp_path / "sub").mkdir()
    (tmp_path / "picture.png").touch()
    (tmp_path / "index.html").write_text(
        '<h1 id="top"></h1><a href="#top"></a><a href="sub/page.html#here"></a>'
        '<img src="picture.png"><a href="https://example.org/nowhere"></a>'
    )
    (tmp_path / "sub" / "page.html").write_text(
        '<a id="here" href="../index.html"></a><a href="../index.html#gone"></a>'
        '<a href="#"></a><a href="gone.html"></a><img src="../gone.png"><a href="../sub"></a>'
    )
    assert list(sitelinks.broken_links(tmp_path)) == [
        "sub/page.html: ../index.html#gone",
        "sub/page.html: gone.html",
        "sub/page.html: ../gone.png",
        "sub/page.html: ../sub",
    ]


def test_objects_of_other_projects_that_are_linked_exist():
    assert importlib.import_module("inventories").missing() == []


def test_inventories_can_be_read_by_sphinx(tmp_path):
    from sphinx.util.inventory import InventoryFile

    inventories = importlib.import_module("inventories")
    mapping = inventories.write(tmp_path)
    site, path = mapping["torch"]
    entries = InventoryFile.loads(Path(path).read_bytes(), uri=site)
    found = entries.data["py:class"]["torch.Tensor"]
    assert found.uri.startswith(f"{site.rstrip('/')}/tensors.html#torch.Tensor")


# The architecture page


def test_the_picture_of_the_rooms_shows_every_room(tmp_path):
    sys.path.insert(0, str(DOCS / "pictures"))
    try:
        architecture = importlib.import_module("architecture")
    finally:
        sys.path.remove(str(DOCS / "pictures"))
    rooms = [room for floor in architecture.floors() for room in floor]
    core = Path(tpgmm_torch.__file__).parent
    assert sorted(rooms) == sorted(
        path.stem
        for path in core.iterdir()
        if path.stem not in ("__init__", "__pycache__", "py")
        and (path.suffix == ".py" or (path / "__init__.py").is_file())
    )
    architecture.draw(tmp_path)
    assert (tmp_path / "rooms.svg").stat().st_size > 1000

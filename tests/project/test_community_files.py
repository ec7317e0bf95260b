"""Files for those who come to the repository: well formed, and true where that can be told."""

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "docs" / "paper"


def test_every_citation_of_the_paper_has_its_entry_and_every_entry_is_cited():
    text = (PAPER / "paper.md").read_text(encoding="utf-8")
    entries = re.findall(
        r"^@\w+\{([\w-]+),", (PAPER / "paper.bib").read_text("utf-8"), re.MULTILINE
    )
    assert set(re.findall(r"@([a-z][\w-]*)", text)) == set(entries)
    assert len(entries) == len(set(entries))


def test_the_paper_has_what_joss_asks_for():
    text = (PAPER / "paper.md").read_text(encoding="utf-8")
    head = yaml.safe_load(text.split("---")[1])
    assert {"title", "tags", "authors", "affiliations", "date", "bibliography"} <= head.keys()
    assert (PAPER / head["bibliography"]).is_file()
    for heading in ("Summary", "Statement of need", "State of the field", "References"):
        assert f"\n# {heading}\n" in text
    for picture in re.findall(r"\]\(([^)]+\.png)\)", text):
        assert (PAPER / picture).is_file()
    assert 250 <= len(text.split()) <= 1750


@pytest.mark.parametrize("name", ["bug", "wish"])
def test_issue_templates_ask_in_a_form_that_can_be_shown(name):
    form = yaml.safe_load((ROOT / ".github" / "ISSUE_TEMPLATE" / f"{name}.yml").read_text())
    assert {"name", "description", "body"} <= form.keys()
    for field in form["body"]:
        assert field["type"] in ("textarea", "input", "dropdown", "checkboxes", "markdown")
        assert field["id"] and field["attributes"]["label"]


TARGETS = re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)


@pytest.mark.parametrize(
    "name", ["AGENTS.md", "CODE_OF_CONDUCT.md", "CONTRIBUTING.md", "SECURITY.md"]
)
def test_commands_that_are_named_exist(name):
    asked = re.findall(r"`make ([a-z-]+)", (ROOT / name).read_text(encoding="utf-8"))
    assert set(asked) <= set(TARGETS)


@pytest.mark.parametrize("path", sorted((ROOT / ".github/workflows").glob("*.yml")), ids=str)
def test_workflows_call_targets_that_exist(path):
    jobs = yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]
    commands = [step.get("run", "") for job in jobs.values() for step in job["steps"]]
    called = [
        word
        for command in commands
        for names in re.findall(r"^make ((?:[a-z-]+ )+|[a-z-]+)", command, re.MULTILINE)
        for word in names.split()
    ]
    assert set(called) <= set(TARGETS)
    assert all(0 < job["timeout-minutes"] <= 90 for job in jobs.values())


def test_the_map_fits_one_screen_and_names_folders_that_exist():
    text = (ROOT / "AGENTS.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    folders = re.findall(r"^\| `([a-z]+)/`", text, re.MULTILINE)
    assert len(folders) > 6
    assert all((ROOT / folder).is_dir() for folder in folders)
    for path in re.findall(r"`((?:docs|tests|evaluation)/[\w/]+\.(?:md|py))`", text):
        assert (ROOT / path).is_file() or "PACKAGE" in path, path


def test_hooks_before_a_commit_run_what_quality_runs():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    entries = [hook["entry"] for repo in hooks["repos"] for hook in repo["hooks"]]
    assert "make quality" in entries

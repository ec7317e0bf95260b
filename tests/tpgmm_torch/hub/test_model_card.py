"""A card says of a model what the model says."""

import html
import re
from dataclasses import replace

import numpy as np
import pytest
from markdown_it import MarkdownIt

from tests.support.skills import small_bottle, waves
from tests.support.two_ways import Handles, fitted
from tpgmm_torch import Canonical, Frame, Situation, TaskParameterizedGMM
from tpgmm_torch.hub import describe
from tpgmm_torch.skills.sequence import Sequence
from tpgmm_torch.skills.via_point import ViaPoint
from tpgmm_torch.skills.via_points import ViaPoints
from tpgmm_torch.skills.ways import Ways


def rows(text: str, title: str) -> list[list[str]]:
    """Cells of the tables of a section."""
    section = text.partition(f"## {title}\n")[2].partition("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def test_the_skill_and_its_limits_are_those_of_the_model():
    model = small_bottle()
    card = describe(model)
    skill = dict(row[:2] for row in rows(card, "The skill"))
    assert skill["frames that it needs"] == "bottle"
    assert skill["Gaussians"] == str(len(model.weights_))
    assert skill["joints"] == ", ".join(model.kinematics_.joint_names)
    [bottle] = [row for row in rows(card, "Where it fails") if row[0] == "bottle"]
    shown = model.summary_.frames["bottle"]
    assert bottle[1] == f"{shown.low[0]:.3f} to {shown.high[0]:.3f}"
    assert skill["demonstrations"] == str(model.summary_.n_demonstrations)
    learned = dict(row for row in rows(card, "How it was learned"))
    assert learned["converged"] == ("yes" if model.converged_ else "no")


def test_what_matters_changes_from_the_object_to_the_joints():
    model = small_bottle()
    heading, _, *spans = rows(describe(model), "What matters, and when")
    shares = np.array([[float(cell.removesuffix(" %")) for cell in row[1:]] for row in spans])
    assert len(heading) == 1 + len(model.operators_)
    np.testing.assert_allclose(shares.sum(1), 100, atol=1)
    joints = heading.index("`canonical`") - 1
    assert shares[:, joints].argmin() < shares[:, joints].argmax()
    # the same as the shares of a reproduction where the objects are in the middle
    shown = model.summary_
    middle = (np.array(shown.start_low) + np.array(shown.start_high)) / 2
    bottle = Frame(shown.frames["bottle"].place.mean, shown.frames["bottle"].orientation)
    [trajectory] = model.predict([Situation(joints=middle, frames={"bottle": bottle})])
    wanted = 100 * trajectory.candidates[joints].share.mean(-1)
    first = wanted[: len(np.array_split(np.arange(len(wanted)), len(spans))[0])].mean()
    assert shares[0, joints] == pytest.approx(float(first), abs=0.51)


def test_settings_other_than_the_defaults_are_told_and_no_others():
    card = describe(TaskParameterizedGMM(3, tol=0.25).fit(waves()))
    learned = dict(row for row in rows(card, "How it was learned"))
    assert learned["`tol`"] == "0.25"
    assert not {"`max_iter`", "`n_components`", "`robot`"} & learned.keys()


def test_text_that_was_given_stays_in_its_cell():
    model = TaskParameterizedGMM(3).fit(waves())
    card = describe(model, measured={"error | of\na <b>hand": 3})
    [*_, row] = rows(card, "Measured")
    assert row == ["error \\| of a &lt;b\\>hand", "3"]


@pytest.mark.parametrize(
    "name",
    [
        "[arm](javascript:alert(1))", "![arm](https://elsewhere/x.png)", "https://elsewhere",
        "www.elsewhere.org", "<img src=x onerror=y>", "&lt;b&gt;", "a`b [c](d:e) `", "a | b",
        "[arm]: https://elsewhere", "me@elsewhere.org", "_arm_", "**arm**", "arm\n# x", "\\",
    ],
)  # fmt: skip
def test_names_are_shown_as_they_are(name):
    names = name, f"x{name}", "c"
    model = TaskParameterizedGMM(3, [Canonical(joints=names[:2])])
    card = describe(model.fit(waves(names=names)))
    assert not re.search(
        r"\w://|www\.|\w@\w", re.sub("`[^`]+`", "", card)
    )  # which hubs make links of
    shown = MarkdownIt("commonmark").enable("table").render(card)
    tags = set(re.findall(r"<(\w+)", shown))
    assert tags <= {"h2", "p", "table", "thead", "tbody", "tr", "th", "td", "code"}
    cells = [html.unescape(cell) for cell in re.findall(r"<td>(.*?)</td>", shown)]
    assert " ".join(name.split()) in cells


def test_of_several_ways_and_parts_each_is_described():
    model = fitted(Handles)
    card = describe(model.best_model_, {"success": "50 of 50"})
    for mode in range(2):
        shown = dict(row[:2] for row in rows(card, f"The skill (way {mode + 1})"))
        assert shown["demonstrations"] == str((model.labels_ == mode).sum())
    assert card.count("## Measured") == card.count("50 of 50") == 1
    part = TaskParameterizedGMM(3).fit(waves()).skill
    late = replace(part, begin=part.end, end=2 * part.end, time=part.time + part.end)
    several = Sequence([part, late])
    card = describe(ViaPoints(several, [ViaPoint.parse("0.5:canonical=a:0.1")]))
    for number in (1, 2):
        assert rows(card, f"What matters, and when (part {number})")
    assert describe(Ways([several, several])).count("## Where it fails (way ") == 4

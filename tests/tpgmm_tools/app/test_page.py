"""The page: what its buttons answer, and the whole of it, served."""

import html
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support import browser, skills
from tests.support.command_line import UPPER_BODY, refusal
from tests.support.worlds import upper_body
from tpgmm_datasets import save_lerobot
from tpgmm_tools.app import page
from tpgmm_torch.data.tables import demonstrations_to_frame, write_table


@pytest.fixture(scope="module")
def bottles():
    return skills.generator().demonstrations(2)


@pytest.fixture(scope="module")
def table(tmp_path_factory, bottles):
    path = tmp_path_factory.mktemp("tables") / "shake.csv"
    write_table(demonstrations_to_frame(bottles), path)
    return str(path)


def test_a_table_becomes_a_moving_picture(table):
    given = page.UPLOADED, [table], "upper_body", None, "l_hand, r_hand", "", 6
    skill, report = page.learned(*given)
    assert report.startswith("Learned 2 demonstrations")
    [place] = page.places_of(skill, 2)
    expected = skill.situations[1].frames["bottle"].position.tolist()
    assert place == ["bottle", *(round(value, 4) for value in expected), 0.0]
    picture, report, files = page.shown_motion(skill, 2, [place])
    inside = html.unescape(re.fullmatch(r'<iframe .* srcdoc="([^"]*)"></iframe>', picture)[1])
    [written] = [Path(file) for file in files if file.endswith("motion.html")]
    assert inside == written.read_text("utf-8")
    assert [Path(file).name for file in files] == ["model.zip", "motion.csv", "motion.html"]
    assert "s of motion" in report


def test_without_a_robot_it_says_that_joints_have_no_place(table):
    skill, _ = page.learned(page.UPLOADED, [table], "none", None, "", "", 4)
    picture, report, files = page.shown_motion(skill, 1, page.places_of(skill, 1))
    assert (picture, files) == ("", [])
    assert report.startswith("**It does not work like this:** the model knows joints only")


def test_other_sources_are_offered_first(bottles):
    more = {"mine": lambda: (bottles, upper_body())}
    skill, _ = page.learned("mine", None, "none", None, "", "", 4, more)
    assert skill.model.kinematics_.links == upper_body().links


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ((None, "none", None, ""), "give one .zip"),
        ((["t"], "none", None, "l_hand"), "need --robot FILE"),
        ((["t"], "upper_body", None, "l_foot"), "l_foot"),
        ((["t"], page.ROBOT_FILE, __file__, "l_hand"), "does not work"),
        ((["/nowhere/x.csv"], "none", None, ""), "/nowhere/x.csv"),
    ],
)
def test_what_can_be_mended_is_said(table, given, complaint):
    files, robot, robot_file, links = given
    files = [table if file == "t" else file for file in files or ()]
    skill, report = page.learned(page.UPLOADED, files, robot, robot_file, links, "", 4)
    assert skill is None
    assert report.startswith("**It does not work like this:** ") and complaint in report


def test_an_error_of_ours_is_not_taken_for_one_of_the_user():
    def broken():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        page.learned("mine", None, "none", None, "", "", 4, {"mine": broken})


def test_before_anything_is_learned_there_is_nothing_to_show():
    assert page.places_of(None, 1) == []
    assert page.shown_motion(None, 1, []) == ("", "Nothing is learned yet.", [])


def test_a_robot_without_a_data_set_is_refused():
    assert "describes DATASET" in refusal("app", *UPPER_BODY)


@pytest.fixture(scope="module")
def served(tmp_path_factory, bottles):
    """The page's address; in a process of its own, as gradio leaves its event loop open."""
    folder = tmp_path_factory.mktemp("served") / "mine"
    save_lerobot(bottles, folder, fps=20, task="shake")
    command = [sys.executable, "-c", "from tpgmm_tools.cli import main; main()", "app"]
    with subprocess.Popen(
        [*command, str(folder), *UPPER_BODY, "--port", "0"],
        stdout=subprocess.PIPE,
        text=True,
        # what a shell starts in the background would else ignore Ctrl-C
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        try:
            line = process.stdout.readline()
            yield re.fullmatch(r"open (http://127\.0\.0\.1:\d+/) in a browser.*\n", line)[1]
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()


def test_the_page_is_served_learns_and_shows(served):
    from gradio_client import Client

    client = Client(served, verbose=False)
    source = client.view_api(return_format="dict")["named_endpoints"]["/learn"]["parameters"][0]
    mine, generated, uploaded = source["type"]["enum"]
    assert mine.endswith("/mine") and (generated, uploaded) == (page.GENERATED, page.UPLOADED)
    asked = mine, [], "none", None, "", "", 6
    report, _, places = client.predict(*asked, api_name="/learn")
    assert report.startswith("Learned 2 demonstrations")
    picture, report, files = client.predict(1, places, api_name="/show")
    assert "srcdoc=" in picture and "s of motion" in report
    assert {Path(file).name for file in files} == {"motion.html", "motion.csv", "model.zip"}
    client.close()


def test_in_a_browser_the_robot_moves_and_nothing_is_fetched_from_elsewhere(served):
    with browser.page(1200, 1000) as shown:
        shown.open(served)
        button = "[...document.querySelectorAll('button')].find(b => b.innerText == '{}')"
        learn, show = button.format("Learn"), button.format("Show")
        shown.wait_for(f"!!{learn}")
        shown.evaluate(f"{learn}.click()")
        shown.wait_for("document.body.innerText.includes('Learned 2 demonstrations')")
        shown.evaluate(f"{show}.click()")
        motion = "document.querySelector('iframe')?.contentDocument"
        shown.wait_for(f"!!{motion}?.querySelector('canvas')")
        shown.evaluate("document.querySelector('iframe').scrollIntoView({block: 'center'})")
        browser.draws(shown)
        assert shown.complaints == []
        assert [
            one for one in shown.requests if not one.startswith((served, "data:", "blob:"))
        ] == []

"""``tpgmm view``."""

import json
import re
import urllib.request

import numpy as np
import pytest

from tests.support import skills
from tests.support.command_line import output, refusal, serve
from tests.support.recordings import Recording
from tpgmm_datasets import save_lerobot
from tpgmm_torch.persistence import save


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Make a folder as ``tpgmm demo`` writes it."""
    folder = tmp_path_factory.mktemp("demo")
    save(skills.small_bottle(), folder / "model")
    demonstrations = skills.generator().demonstrations(2)
    save_lerobot(demonstrations, folder / "dataset", fps=20, task="shake")
    return folder


def test_view_shows_what_the_demo_wrote(demo):
    arguments = "--situation", 1, "--object", "bottle=sphere:0.07"
    text = output("view", demo, "--fps", 2, *arguments)
    page = demo.parent / f"{demo.name}.html"
    assert re.fullmatch(r"[\d.]+ s of motion, [\d.]+ MB, in (.*)\n", text)[1] == str(page)
    recording = Recording(page)
    assert f"{demo.name}, situation 1" in recording.page
    [_, one] = skills.generator().demonstrations(2)
    bottle = recording.pose("/frames/bottle", 0)[:3]
    np.testing.assert_allclose(bottle, one.frames["bottle"].position, atol=1e-6)
    assert recording.props("/frames/bottle/shape")["radius"] == 0.07


def test_view_takes_situations_from_a_file(demo, tmp_path):
    joints = skills.few_bottles()[0].joints[0].tolist()
    frames = {"bottle": {"position": [0.3, 0, 0.15]}}
    file, out = tmp_path / "s.json", tmp_path / "m.html"
    file.write_text(json.dumps([{"joints": joints, "frames": frames}]))
    output("view", demo / "model", "--situations", file, "--fps", 1, "--out", out)
    np.testing.assert_allclose(Recording(out).pose("/frames/bottle", 0)[:3], (0.3, 0, 0.15))


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((".", "--object", "bottle"), "a shape is box:X,Y,Z"),
        ((".", "--object", "mug=sphere:0.1"), "there are shapes for ['mug']"),
        ((".", "--format", "rerun"), "written as one HTML file, not as 'rerun'"),
        (("model",), "give --dataset DATASET or --situations FILE.json"),
        ((".", "--situation", 2), "there are 2 situations, counted from 0; got --situation 2"),
        ((".", "--out", "motion.mp4"), "--out ends in .html, got 'motion.mp4'"),
        ((".", "--meshes", "nowhere"), "--meshes"),
        (("nothing", "--dataset", "x"), "nothing"),
    ],
)
def test_view_refuses_what_it_cannot_show(demo, arguments, complaint):
    assert complaint in refusal("view", demo / arguments[0], *arguments[1:])


def test_live_the_command_serves_until_it_is_interrupted(demo):
    with (
        serve("view", demo, "--live", "--port", 0, "--fps", 2) as url,
        urllib.request.urlopen(url, timeout=60) as answer,
    ):
        assert b"<title>Viser</title>" in answer.read()

"""A motion as one HTML file, which a browser plays without a network."""

import re
import sys

import pytest

from tests.support import browser, skills
from tests.support.browser import draws
from tpgmm_tools.viewing import write_motion
from tpgmm_torch import Situation
from tpgmm_torch.exceptions import DependencyError


def test_a_page_is_one_file_that_names_nothing_else(bottle):
    recording, _, path = bottle
    assert [one.name for one in path.parent.iterdir()] == ["motion.html"]
    assert "<title>&lt;shake&gt; &amp; co</title>" in recording.page
    assert recording.page.count("<b>&lt;shake&gt; &amp; co</b>") == 1
    for word in ("reproduction", "2 standard deviations", "demonstrations"):
        assert word in recording.page
    own = re.sub(r'__VISER_EMBED_DATA__="[^"]+"', "", recording.page)
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=[\"']?https?:", own)
    assert path.stat().st_size < 1.3e6


def test_without_viser_the_error_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(DependencyError, match=r"tpgmm-torch\[view\]"):
        write_motion(tmp_path / "m.html", skills.hands(), skills.new_handling()[0])


@pytest.fixture
def motion(tmp_path):
    demonstrations = skills.few_bottles()
    situation = Situation(demonstrations[1].joints[0], demonstrations[1].frames)
    path = tmp_path / "motion.html"
    write_motion(path, skills.small_bottle(), situation, demonstrations, fps=5)
    return path


def test_the_page_opens_from_disk_draws_the_robot_and_plays(motion):
    with browser.page(600, 600) as page:
        page.open(motion.as_uri())
        page.evaluate("document.getElementById('legend').style.display = 'none'")
        draws(page)
        page.evaluate("document.getElementById('legend').style.display = ''")
        clock = "Number(document.querySelector('input').value)"
        before = page.evaluate(clock)
        page.wait_for(f"{clock} != {before}")
        # folded where there is little room; the marker goes with the time line
        assert page.evaluate("document.getElementById('curves').open") is False
        marker = (
            "parseFloat(document.querySelector('.now').getAttribute('transform')?.slice(10))"
        )
        page.wait_for(f"{clock} > 0 && Math.abs({marker} - {clock}) < 0.5")
        assert page.evaluate("document.querySelectorAll('canvas').length") >= 1
        for word in ("reproduction", "demonstrations"):
            assert page.evaluate(f"document.body.innerText.includes({word!r})")
        outside = [url for url in page.requests if not url.startswith(("data:", "blob:"))]
        assert outside == [motion.as_uri()]
        assert page.complaints == []

"""A motion as one HTML file, which a browser plays without a network, and live."""

import re
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support import browser, skills
from tests.support.browser import draws, yellow
from tests.support.recordings import Recording
from tests.support.worlds import upper_body
from tpgmm_control.loop.rollout import rollout
from tpgmm_tools.viewing import LiveView, write_motion
from tpgmm_torch import Frame, Situation
from tpgmm_torch.exceptions import DependencyError

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    """Write a page; return it, the reproduction in it, and the situation."""
    path = tmp_path_factory.mktemp("view") / "new" / "motion.html"
    shown = skills.few_bottles()
    situation = Situation.of(shown[1])
    model, title = skills.small_bottle(), "<shake> & co"
    return path, write_motion(path, model, situation, shown, fps=2, title=title), situation


def test_a_page_is_one_file_that_names_nothing_else(motion):
    path, _, _ = motion
    page = Recording(path).page
    assert [one.name for one in path.parent.iterdir()] == ["motion.html"]
    assert "<title>&lt;shake&gt; &amp; co</title>" in page
    assert page.count("<b>&lt;shake&gt; &amp; co</b>") == 1
    for word in ("reproduction", "2 standard deviations", "demonstrations", "[N m/rad]"):
        assert word in page
    own = re.sub(r'__VISER_EMBED_DATA__="[^"]+"', "", page)
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=[\"']?https?:", own)
    assert path.stat().st_size < 1.6e6


def test_links_and_objects_are_where_the_reproduction_has_them(motion):
    path, trajectory, situation = motion
    recording = Recording(path)
    assert recording.duration == pytest.approx(float(trajectory.time[-1]) + 1.0)
    bottle = recording.pose("/frames/bottle", 0.0)[:3]
    np.testing.assert_allclose(bottle, situation.frames["bottle"].position, atol=1e-6)
    for now, step in ((0.0, 0), (recording.duration, -1)):
        hand = upper_body().state(trajectory.joints[step]).position("l_hand")
        drawn = recording.pose("/robot/l_hand", now)[:3]
        np.testing.assert_allclose(drawn, hand, atol=2e-5)
    assert recording.props("/frames/bottle/label")["text"] == "bottle"
    assert len(recording.props("/covariance/r_hand")["batched_positions"]) > 20


def test_without_viser_the_error_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(DependencyError, match=r"tpgmm-torch\[cli\]"):
        write_motion(tmp_path / "motion", skills.hands(), skills.new_handling()[0])


def test_the_page_opens_from_disk_draws_the_robot_and_plays(motion):
    path, _, _ = motion
    with browser.page(600, 600) as page:
        page.open(path.as_uri())
        page.evaluate("document.getElementById('legend').style.display = 'none'")
        draws(page)
        page.evaluate("document.getElementById('legend').style.display = ''")
        clock = "Number(document.querySelector('input').value)"
        before = page.evaluate(clock)
        page.wait_for(f"{clock} != {before}")
        # folded where there is little room; the marker goes with the time line
        assert page.evaluate("document.getElementById('curves').open") is False
        now = "document.querySelector('.now').getAttribute('transform')"
        marker = f"parseFloat({now}?.slice(10))"
        page.wait_for(f"{clock} > 0 && Math.abs({marker} - {clock}) < 0.5")
        outside = [url for url in page.requests if not url.startswith(("data:", "blob:"))]
        assert outside == [path.as_uri()]
        assert page.complaints == []


def test_live_an_object_that_is_moved_changes_the_reproduction(capsys):
    model = skills.hands()
    situation, other = (skills.new_handling(seed=s)[0] for s in (7, 8))
    cup = Frame([0.2, 0.1, 0.3], situation.frames["cup"].orientation)
    with LiveView(model, [situation, other], skills.handlings(), port=0) as view:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+", view.url)
        for change, expected in (
            (lambda: None, situation),
            (lambda: view.move_frame("cup", cup), replace(situation, frames={"cup": cup})),
            (lambda: view.show(1), other),
        ):
            change()
            [trajectory] = rollout(model.skill, [expected], bounds="robot", blend=1.0)
            torch.testing.assert_close(view.drawing.trajectory.joints, trajectory.joints)
        start = time.monotonic()
        view.run(0.3)
        assert 0.3 <= time.monotonic() - start < 5
        assert 0.1 < view.clock <= 2.0
    assert capsys.readouterr().out == ""


def test_live_a_controller_leads_the_robot_to_an_object_that_is_moved_meanwhile():
    situation, model = Situation.of(skills.few_bottles()[1]), skills.small_bottle()
    with LiveView(model, [situation], port=0) as view:
        view.start_controller()
        for _ in range(20):
            view.step(0.05)
        assert view.command.status == "running"
        assert view.clock == float(view.command.time) > 0.5
        before, at = view.command.reference, view.clock
        view.hold.value = True
        for _ in range(40):
            view.step(0.05)
        assert view.clock - at < 1.5  # the skill waits for the robot
        assert [line.partition(": ")[2] for line in view.statuses] == ["running", "waiting"]
        assert "joint '" in view._status.content
        view.hold.value = False
        bottle = situation.frames["bottle"]
        view.move_frame("bottle", Frame(bottle.position + 0.05, bottle.orientation))
        for _ in range(30):
            view.step(0.05)
        assert float((view.command.reference - before).abs().max()) > 0.02
        at = view.clock
        view.stop_controller()
        assert view.command is None
        view.step(0.05)
        assert view.clock > at


def seen_at(page, camera, point) -> np.ndarray:
    """Find the pixel at which a point of the scene is seen, (2,)."""
    left, top, width, height = page.evaluate(
        "(r => [r.left, r.top, r.width, r.height])"
        "(document.querySelector('canvas').getBoundingClientRect())"
    )
    forward = camera.look_at - camera.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    up, away = np.cross(right, forward), point - camera.position
    scale = height / 2 / np.tan(camera.fov / 2) / (away @ forward)
    across, along = scale * away @ right, scale * away @ up
    return np.array((left + width / 2 + across, top + height / 2 - along))


def drag_up(view, page, before, by):
    """Move the object that stands at ``before`` by the mouse; say whether it followed."""
    page.open(view.url)
    draws(page)
    page.wait_for("document.body.innerText.includes('time [s]')")
    camera, arrow = view.server.initial_camera, 0.85 * 0.12 * view.drawing.size
    # from within the arrow, in steps that stay on it
    up = by / np.linalg.norm(by)
    start, end = (seen_at(page, camera, before + arrow * up + d) for d in (0 * by, by))
    planned, deadline = view.drawing, time.monotonic() + browser.PATIENCE
    while yellow(page.screenshot()) < 10:  # pressed too early, the mouse turns the camera
        assert time.monotonic() < deadline, "the handle does not react to the mouse"
        page.mouse("mouseMoved", start + time.monotonic() % 2, buttons=0)
    page.mouse("mousePressed", start)
    for share in np.linspace(0, 1, 17):
        page.mouse("mouseMoved", start + share * (end - start))
    page.mouse("mouseReleased", end, buttons=0)
    deadline = time.monotonic() + browser.PATIENCE / 3
    while view.drawing is planned and time.monotonic() < deadline:
        page.mouse("mouseMoved", end, buttons=0)  # which the page notes the release by
    return view.drawing is not planned


def test_live_an_object_is_dragged_and_the_skill_reproduced_for_it():
    situation, up = Situation.of(skills.few_bottles()[1]), np.array((0.0, 0.0, 1.0))
    before = situation.frames["bottle"].position.numpy()
    with (
        LiveView(skills.small_bottle(), [situation], port=0) as view,
        browser.page(800, 700) as page,
    ):
        # a busy browser may lose the capture of the mouse: then the page is opened again
        assert any(drag_up(view, page, before, 0.05 * up) for _ in range(3)), "it did not move"
        moved = view.situation.frames["bottle"].position.numpy() - before
        np.testing.assert_allclose(moved, 0.05 * up, atol=0.005)
        local = (view.url, view.url.replace("http", "ws"), "data:", "blob:")
        assert [url for url in page.requests if not url.startswith(local)] == []
        assert page.complaints == []

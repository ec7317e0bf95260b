"""``tpgmm view`` in a real browser: it draws, it plays, and it needs no network."""

import time

import numpy as np
import pytest

from tests.support import browser, skills
from tpgmm_torch import Situation
from tpgmm_torch.viewing import LiveView, write_motion


def red(picture) -> int:
    """How many pixels have the reproduced path's colour."""
    r, g, b = np.moveaxis(picture, -1, 0)
    return int(((r > 0.6) & (g < 0.4) & (b < 0.4)).sum())


def blue_grey(picture) -> int:
    """How many pixels have the robot's colour, in light and in shade."""
    r, _, b = np.moveaxis(picture, -1, 0)
    return int(((b > r + 0.04) & (b < 0.85) & (r > 0.15)).sum())


def yellow(picture) -> int:
    """How many pixels have the colour of a handle under the mouse."""
    r, g, b = np.moveaxis(picture, -1, 0)
    return int(((r > 0.85) & (g > 0.85) & (b < 0.6)).sum())


def draws(page) -> None:
    """Wait until the robot and the path are in the canvas."""
    end = time.monotonic() + browser.PATIENCE
    while blue_grey(picture := page.screenshot()) < 1000 or red(picture) < 30:
        found = f"{blue_grey(picture)} pixels of the robot, {red(picture)} of the path"
        assert time.monotonic() < end, found


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
        assert page.evaluate("document.querySelectorAll('canvas').length") >= 1
        for word in ("reproduction", "demonstrations"):
            assert page.evaluate(f"document.body.innerText.includes({word!r})")
        outside = [url for url in page.requests if not url.startswith(("data:", "blob:"))]
        assert outside == [motion.as_uri()]
        assert page.complaints == []


def seen_at(page, camera, point) -> np.ndarray:
    """The pixel at which a point of the scene is seen, (2,)."""
    left, top, width, height = page.evaluate(
        "(r => [r.left, r.top, r.width, r.height])"
        "(document.querySelector('canvas').getBoundingClientRect())"
    )
    forward = camera.look_at - camera.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    away = point - camera.position
    scale = height / 2 / np.tan(camera.fov / 2) / (away @ forward)
    return np.array(
        (left + width / 2 + scale * away @ right, top + height / 2 - scale * away @ up)
    )


def test_live_an_object_is_dragged_and_the_skill_reproduced_anew():
    demonstration = skills.few_bottles()[1]
    situation = Situation(demonstration.joints[0], demonstration.frames)
    before, up = situation.frames["bottle"].position.numpy(), np.array((0.0, 0.0, 1.0))
    with (
        LiveView(skills.small_bottle(), [situation], port=0) as view,
        browser.page(800, 700) as page,
    ):
        page.open(view.url)
        draws(page)
        page.wait_for("document.body.innerText.includes('time [s]')")
        camera, size = view.scene.server.initial_camera, view.scene.frames["bottle"].scale
        # from within the arrow, in steps that stay on it: a busy browser may forget the capture
        start, end = (seen_at(page, camera, before + (0.85 * size + d) * up) for d in (0, 0.05))
        planned = view.trajectory
        deadline = time.monotonic() + browser.PATIENCE
        while yellow(page.screenshot()) < 10:  # pressed too early, the mouse turns the camera
            assert time.monotonic() < deadline, "the handle does not feel the mouse"
            page.mouse("mouseMoved", start + time.monotonic() % 2, buttons=0)
        page.mouse("mousePressed", start)
        for share in np.linspace(0, 1, 17):
            page.mouse("mouseMoved", start + share * (end - start))
        page.mouse("mouseReleased", end, buttons=0)
        deadline = time.monotonic() + browser.PATIENCE
        while view.trajectory is planned:
            assert time.monotonic() < deadline, "the object was not moved"
            page.mouse("mouseMoved", end, buttons=0)  # which the page notes the release by
        moved = view.situation.frames["bottle"].position.numpy() - before
        np.testing.assert_allclose(moved, 0.05 * up, atol=0.005)
        assert float((view.trajectory.joints - planned.joints).abs().max()) > 0.02
        local = (view.url, view.url.replace("http", "ws"), "data:", "blob:")
        assert [url for url in page.requests if not url.startswith(local)] == []
        assert page.complaints == []

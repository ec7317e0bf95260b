"""A motion in the browser while the program runs."""

import copy
import re
import time
from dataclasses import replace

import numpy as np
import torch

from tests.support import browser, skills
from tests.support.browser import draws, yellow
from tpgmm_tools.viewing import LiveView
from tpgmm_torch import Frame, Situation


def test_live_a_frame_that_is_moved_is_reproduced_for_anew(capsys):
    model = copy.copy(skills.hands())
    model.summary_ = replace(model.summary_, events={"touch": 0.5})
    situation, other = (skills.new_handling(seed=s)[0] for s in (7, 8))
    with LiveView(model, [situation, other], skills.handlings(), port=0) as view:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+", view.url)
        [expected] = model.predict([situation])
        torch.testing.assert_close(view.trajectory.joints, expected.joints)
        cup = Frame([0.2, 0.1, 0.3], situation.frames["cup"].orientation)
        view.move_frame("cup", cup)
        [expected] = model.predict([replace(situation, frames={"cup": cup})])
        torch.testing.assert_close(view.trajectory.joints, expected.joints)
        assert re.fullmatch(r"\d\.\d s: touch", view.marks.content)
        [plot] = view.plots
        for line, candidate in zip(plot.data[1:], expected.candidates, strict=True):
            np.testing.assert_allclose(line, 100 * candidate.share.mean(-1))
        view.show(1)
        [expected] = model.predict([other])
        torch.testing.assert_close(view.trajectory.joints, expected.joints)
        start = time.monotonic()
        view.run(0.3)
        assert 0.3 <= time.monotonic() - start < 5
        assert 0.1 < view.clock <= 2.0
    assert capsys.readouterr().out == ""


def test_live_a_controller_leads_the_robot_to_an_object_that_is_moved_meanwhile():
    demonstration = skills.few_bottles()[1]
    situation = Situation(demonstration.joints[0], demonstration.frames)
    model = skills.small_bottle()
    with LiveView(model, [situation], port=0) as view:
        untouched = model.controller(situation.joints, situation.frames)
        view.start_controller()
        for _ in range(20):
            view.step(0.05)
            expected = untouched.step(0.05, untouched.reference, situation.frames)
        torch.testing.assert_close(view.command.reference, expected.reference)
        assert view.command.status == "running"
        assert view.clock == float(view.command.time) > 0.5
        bottle = situation.frames["bottle"]
        view.move_frame("bottle", Frame(bottle.position + 0.05, bottle.orientation))
        for _ in range(30):
            view.step(0.05)
            expected = untouched.step(0.05, untouched.reference, situation.frames)
        assert float((view.command.reference - expected.reference).abs().max()) > 0.02
        at, view._hold.value = view.clock, True
        for _ in range(40):
            view.step(0.05)
        assert view.clock - at < 1.5  # the skill waits for the robot
        at = view.clock
        view.stop_controller()
        assert view.command is None
        view.step(0.05)
        assert view.clock > at


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
